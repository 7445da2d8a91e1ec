/* SPDX-License-Identifier: Apache-2.0 */
/* ISO 15765-2 for one pair of addresses: segmentation of messages and flow control, without CAN identifiers. Written
 * here (2 KB) instead of using an operating system's: the profile needs a reply per pair of addresses, refusals after a
 * first frame, and frames that can be withdrawn. */
#include "isotp.h"
#include "inside.h"

#define PADDING 0xCC
#define MOST_WAITS 10u

/* Classic frames have 8 octets; FD ones the next length that FD knows. */
void teds_can_pad(teds_can_frame *frame, size_t used)
{
    static const uint8_t lengths[] = {8, 12, 16, 20, 24, 32, 48, 64};
    size_t i = 0;
    while (TEDS_CAN_FD && lengths[i] < used) {
        i++;
    }
    memset(frame->data + used, PADDING, lengths[i] - used);
    frame->length = lengths[i];
}

void teds_isotp_begin(teds_line *line, const uint8_t *octets, size_t length, bool fd)
{
    line->out = octets;
    line->out_length = (uint16_t)length;
    line->out_at = 0;
    line->out_state = TEDS_OUT_FIRST;
    line->out_number = 0;
    line->out_waits = 0;
    line->out_due = 0;
    line->fd = fd && TEDS_CAN_FD;
}

static void put_first_frame(teds_line *line, teds_can_frame *frame, uint64_t now)
{
    const bool fd = TEDS_CAN_FD && line->fd; /* a constant if only classic frames are compiled in */
    const size_t room = fd ? 64 : 8, most_single = fd ? 62 : 7;
    size_t at;
    if (line->out_length <= most_single) {
        at = !fd || line->out_length <= 7 ? 1 : 2;
        frame->data[0] = 0;
        frame->data[at - 1] = (uint8_t)line->out_length;
        memcpy(frame->data + at, line->out, line->out_length);
        teds_can_pad(frame, at + line->out_length);
        line->out_at = line->out_length;
        line->out_state = TEDS_OUT_IDLE;
        return;
    }
    frame->data[0] = (uint8_t)(0x10u | line->out_length >> 8);
    frame->data[1] = (uint8_t)line->out_length;
    memcpy(frame->data + 2, line->out, room - 2);
    frame->length = (uint8_t)room;
    line->out_at = (uint16_t)(room - 2);
    line->out_number = 1;
    line->out_state = TEDS_OUT_WAITS;
    line->out_due = now + TEDS_N_BS;
}

static void put_consecutive_frame(teds_line *line, teds_can_frame *frame, uint64_t now)
{
    const size_t room = TEDS_CAN_FD && line->fd ? 63 : 7;
    size_t left = (size_t)(line->out_length - line->out_at);
    size_t octets = left < room ? left : room;
    frame->data[0] = (uint8_t)(0x20u | line->out_number);
    memcpy(frame->data + 1, line->out + line->out_at, octets);
    teds_can_pad(frame, 1 + octets);
    line->out_at = (uint16_t)(line->out_at + octets);
    line->out_number = (uint8_t)((line->out_number + 1) & 15);
    line->out_due = now + line->out_gap;
    if (line->out_at == line->out_length) {
        line->out_state = TEDS_OUT_IDLE;
    } else if (line->out_block != 0 && --line->out_block == 0) {
        line->out_state = TEDS_OUT_WAITS;
        line->out_due = now + TEDS_N_BS;
    }
}

bool teds_isotp_next(teds_line *line, teds_can_frame *frame, uint64_t now)
{
    frame->fd = TEDS_CAN_FD && line->fd;
    if (line->out_state == TEDS_OUT_FIRST) {
        put_first_frame(line, frame, now);
        return true;
    }
    if (line->out_state == TEDS_OUT_RUNS && now >= line->out_due) {
        put_consecutive_frame(line, frame, now);
        return true;
    }
    return false;
}

/* STmin: 0 to 7F ms, F1 to F9 hundreds of microseconds; reserved ones count as 127 ms. */
uint32_t teds_isotp_gap(uint8_t stmin)
{
    if (stmin >= 0xF1 && stmin <= 0xF9) {
        return (stmin - 0xF0u) * 100000u;
    }
    return (stmin <= 0x7F ? stmin : 0x7Fu) * 1000000u;
}

void teds_isotp_flow(teds_line *line, const uint8_t *data, size_t length, uint64_t now)
{
    if (length < 3 || line->out_state != TEDS_OUT_WAITS) {
        return;
    }
    switch (data[0] & 15) {
    case 0:
        line->out_state = TEDS_OUT_RUNS;
        line->out_block = data[1];
        line->out_gap = teds_isotp_gap(data[2]);
        line->out_due = now;
        line->out_waits = 0;
        break;
    case 1:
        line->out_waits++;
        line->out_due = now + TEDS_N_BS;
        if (line->out_waits > MOST_WAITS) {
            line->out_due = 0; /* abandoned at the next poll */
        }
        break;
    case 2: line->out_due = 0; break; /* overflow */
    default: break;                   /* unknown: ignored */
    }
}

bool teds_isotp_single(const uint8_t *data, size_t length, const uint8_t **body, size_t *octets)
{
    /* frames of more than 8 octets have the length in an extra octet, and only these */
    const size_t start = length > 8 ? 2 : 1;
    if (length < 2 || data[0] >> 4 != 0 || (start == 2 && data[0] != 0)) {
        return false;
    }
    *octets = data[start - 1];
    *body = data + start;
    return *octets >= (start == 2 ? 8u : 1u) && start + *octets <= length;
}
