/* SPDX-License-Identifier: Apache-2.0 */
/* ISO-TP (ISO 15765-2) for one pair of addresses: messages as frames, without CAN identifiers. */
#ifndef TEDS_SRC_ISOTP_H
#define TEDS_SRC_ISOTP_H

#include "inside.h"

#define TEDS_N_BS TEDS_SECOND /* longest wait for flow control */
enum { TEDS_OUT_IDLE, TEDS_OUT_FIRST, TEDS_OUT_WAITS, TEDS_OUT_RUNS };

/* Begin to send a message; its octets must not change until it was sent. */
void teds_isotp_begin(teds_line *line, const uint8_t *octets, size_t length, bool fd);

/* The next frame, if one may be sent now. */
bool teds_isotp_next(teds_line *line, teds_can_frame *frame, uint64_t now);

/* Handle flow control from the station. */
void teds_isotp_flow(teds_line *line, const uint8_t *data, size_t length, uint64_t now);

/* STmin in ns; reserved values count as the longest. */
uint32_t teds_isotp_gap(uint8_t stmin);

/* Read a single frame; false if it is not one. */
bool teds_isotp_single(const uint8_t *data, size_t length, const uint8_t **body, size_t *octets);

/* Pad a frame: classic frames to 8 octets, FD ones to the next valid length. */
void teds_can_pad(teds_can_frame *frame, size_t used);

#endif
