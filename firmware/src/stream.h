/* SPDX-License-Identifier: Apache-2.0 */
/* Streams, events and the trigger. */
#ifndef TEDS_SRC_STREAM_H
#define TEDS_SRC_STREAM_H

#include "inside.h"

#if TEDS_OPERATION
teds_handler teds_subscribe, teds_stop, teds_arm;
void teds_trigger(teds_node *node, teds_link link, const uint8_t *token, uint64_t tick);
void teds_streams_sample(teds_node *node, uint64_t now);
uint64_t teds_streams_due(teds_node *node);
void teds_streams_end(teds_node *node, teds_session *session, uint32_t places);
void teds_streams_ready(teds_node *node, teds_session *session);
bool teds_streams_running(const teds_node *node);
bool teds_data_next(teds_node *node, teds_can_frame *frame, uint64_t now);
/* A data message over BLE: stream, message; 0: none may leave now. */
size_t teds_data_notify(teds_node *node, teds_link *link, uint8_t *out, uint64_t now);
uint64_t teds_data_due(teds_node *node);
#endif

#endif
