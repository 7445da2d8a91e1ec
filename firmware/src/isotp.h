/* SPDX-License-Identifier: Apache-2.0 */
/* ISO-TP (ISO 15765-2) for one pair of addresses: messages as frames, without CAN identifiers. */
#ifndef TEDS_SRC_ISOTP_H
#define TEDS_SRC_ISOTP_H

#include "inside.h"

#define TEDS_N_BS TEDS_SECOND /* a flow control is waited for so long */
enum { TEDS_OUT_IDLE, TEDS_OUT_FIRST, TEDS_OUT_WAITS, TEDS_OUT_RUNS };

/* Begin to send a message; its octets stay where they are until it has left. */
void teds_isotp_begin(teds_line *line, const uint8_t *octets, size_t length, bool fd);

/* The next frame, if one may leave now. */
bool teds_isotp_next(teds_line *line, teds_can_frame *frame, uint64_t now);

/* A flow control came. */
void teds_isotp_flow(teds_line *line, const uint8_t *data, size_t length, uint64_t now);

/* STmin in ns; reserved values are the longest one. */
uint32_t teds_isotp_gap(uint8_t stmin);

/* Read a single frame; false if it is none. */
bool teds_isotp_single(const uint8_t *data, size_t length, const uint8_t **body, size_t *octets);

/* Fill a frame up: classic frames have 8 octets, FD ones the next length that FD knows. */
void teds_can_pad(teds_can_frame *frame, size_t used);

#endif
