/* SPDX-License-Identifier: Apache-2.0 */
/* Frames of one pair of addresses (ISO 15765-2). */
#ifndef TEDS_SRC_ISOTP_H
#define TEDS_SRC_ISOTP_H

#include "inside.h"

enum { TEDS_OUT_IDLE, TEDS_OUT_FIRST, TEDS_OUT_WAITS, TEDS_OUT_RUNS };
void teds_isotp_begin(teds_line *line, const uint8_t *octets, size_t length, bool fd);
bool teds_isotp_next(teds_line *line, teds_can_frame *frame, uint64_t now);
#define TEDS_N_BS TEDS_SECOND /* a flow control is waited for so long */
uint32_t teds_isotp_gap(uint8_t stmin);
void teds_isotp_flow(teds_line *line, const uint8_t *data, size_t length, uint64_t now);
bool teds_isotp_single(const uint8_t *data, size_t length, const uint8_t **body, size_t *octets);
void teds_can_pad(teds_can_frame *frame, size_t used);

#endif
