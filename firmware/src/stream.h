/* SPDX-License-Identifier: Apache-2.0 */
/* Streams (periodic, free-running, of events) and their data messages. */
#ifndef TEDS_SRC_STREAM_H
#define TEDS_SRC_STREAM_H

#include "inside.h"

#if TEDS_OPERATION
teds_handler teds_subscribe, teds_stop;

/* Take the samples that are due. */
void teds_streams_sample(teds_node *node, uint64_t now);

/* The time of the next sample, and of the next data message. */
uint64_t teds_streams_due(teds_node *node);
uint64_t teds_data_due(teds_node *node);

/* Start the streams of a session that wait for the trigger, a moment after this tick. */
void teds_streams_start(teds_node *node, const teds_session *session, uint64_t tick);

/* The reply to a Subscribe was sent: its messages may follow. */
void teds_streams_ready(teds_node *node, teds_session *session);

/* End a session's streams of any of these places. */
void teds_streams_end(teds_node *node, teds_session *session, uint32_t places);

bool teds_streams_running(const teds_node *node);

/* Return the next frame of data messages on CAN; false: none may be sent now. */
bool teds_data_next(teds_node *node, teds_can_frame *frame, uint64_t now);

/* Return a data message over BLE: stream, message; 0: none may be sent now. */
size_t teds_data_notify(teds_node *node, teds_link *link, uint8_t *out, uint64_t now);
#endif

#endif
