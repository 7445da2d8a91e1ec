/* SPDX-License-Identifier: Apache-2.0 */
/* What a frame takes on a wire or on air, to the bit, and holding it back so long: for benches.
 *
 * CAN as ISO 11898-1 has it, with the stuff bits of what is sent; NFC as ISO/IEC 14443-3 Type A at 106 kbit/s.
 */
#define _GNU_SOURCE
#include "host.h"

#include <string.h>
#include <sys/prctl.h>
#include <time.h>

#define SPIN 30000u /* ns before the time, up to which a sleep is trusted */
#define CARRIER 13560000u
#define ETU 128u               /* carrier cycles of a bit at 106 kbit/s */
#define TO_TAG (9 * 128 + 84)  /* frame delays, in carrier cycles */
#define TO_READER 1172

uint64_t host_clock(void)
{
    struct timespec now;
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
}

/* -- a CAN frame ----------------------------------------------------------------------------------------------------- */

typedef struct stuffing {
    unsigned last, run, bits; /* bits: of the fields and those that were stuffed in */
    uint32_t crc;
} stuffing;

static void put(stuffing *at, uint32_t value, unsigned width)
{
    while (width-- > 0) {
        unsigned bit = value >> width & 1;
        at->crc = (bit ^ (at->crc >> 14)) != 0 ? ((at->crc << 1) & 0x7FFF) ^ 0x4599 : (at->crc << 1) & 0x7FFF;
        at->run = bit == at->last ? at->run + 1 : 1;
        at->last = bit;
        at->bits++;
        if (at->run == 5) { /* one bit after five equal ones, itself the first of the next run */
            at->last = 1 - bit;
            at->run = 1;
            at->bits++;
        }
    }
}

static void put_identifier(stuffing *at, uint32_t identifier)
{
    put(at, 0, 1);                /* start of frame */
    put(at, identifier >> 18, 11);
    put(at, 3, 2);                /* SRR, IDE */
    put(at, identifier & 0x3FFFF, 18);
}

static unsigned code_of(unsigned length)
{
    static const uint8_t longer[] = {12, 16, 20, 24, 32, 48, 64};
    unsigned code = 9;
    if (length <= 8) {
        return length;
    }
    while (longer[code - 9] < length) {
        code++;
    }
    return code;
}

uint64_t host_wire_ns(const teds_can_frame *frame, uint32_t bitrate, uint32_t data_bitrate)
{
    stuffing at = {2, 0, 0, 0};
    unsigned slow, crc;
    put_identifier(&at, frame->identifier);
    if (!frame->fd) {
        put(&at, frame->length, 7); /* RTR, two reserved bits, the length */
        for (unsigned i = 0; i < frame->length; i++) {
            put(&at, frame->data[i], 8);
        }
        put(&at, at.crc, 15);
        /* CRC delimiter, acknowledge and its delimiter, end of frame, intermission */
        return (at.bits + 1 + 1 + 1 + 7 + 3) * UINT64_C(1000000000) / bitrate;
    }
    put(&at, 5, 4); /* RRS, FDF, reserved, bit rate switch */
    slow = at.bits + 1 + 1 + 1 + 7 + 3;
    at.bits = 0;
    put(&at, code_of(frame->length), 5); /* ESI, the length's code */
    for (unsigned i = 0; i < frame->length; i++) {
        put(&at, frame->data[i], 8);
    }
    crc = frame->length <= 16 ? 17 : 21; /* with the stuff count of 4 bits, and a fixed stuff bit for every 4 */
    return slow * UINT64_C(1000000000) / bitrate +
           (at.bits + 4 + crc + 1 + (crc + 3) / 4) * UINT64_C(1000000000) / data_bitrate;
}

/* -- an NFC frame ------------------------------------------------------------------------------------------------------ */

static uint64_t of_carrier(uint64_t cycles)
{
    return cycles * UINT64_C(1000000000) / CARRIER;
}

uint64_t host_air_ns(const uint8_t *command, size_t length, size_t answer)
{
    const bool hail = length == 1 && (command[0] == 0x26 || command[0] == 0x52); /* a short frame of 7 bits */
    const bool bare = length == 2 && command[1] == 0x20;                          /* anticollision: no CRC_A */
    const uint64_t there = hail ? 9 : (length + (bare ? 0 : 2)) * 9 + 3;
    const uint64_t back = (answer + (hail || bare ? 0 : 2)) * 9 + 2;
    return of_carrier((there + back) * ETU + TO_TAG + TO_READER);
}

/* -- holding back, and what the node's own part was ---------------------------------------------------------------------- */

void host_hold(uint64_t until)
{
    uint64_t now = host_clock();
    while (now < until) {
        if (until - now > SPIN) {
            const uint64_t wake = until - SPIN;
            struct timespec at;
            at.tv_sec = (time_t)(wake / 1000000000u);
            at.tv_nsec = (long)(wake % 1000000000u);
            (void)clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL);
        }
        now = host_clock();
    }
}

void host_pace_start(host_pace *pace)
{
    pace->on = true;
    pace->heard = host_clock();
    (void)prctl(PR_SET_TIMERSLACK, 1, 0, 0, 0); /* else Linux adds up to 50 us to each sleep */
}

uint64_t host_arrival(struct msghdr *message)
{
    struct timespec stamp, wall;
    uint64_t now;
    for (struct cmsghdr *at = CMSG_FIRSTHDR(message); at != NULL; at = CMSG_NXTHDR(message, at)) {
        if (at->cmsg_level == SOL_SOCKET && at->cmsg_type == SCM_TIMESTAMPNS) {
            int64_t late;
            memcpy(&stamp, CMSG_DATA(at), sizeof stamp);
            (void)clock_gettime(CLOCK_REALTIME, &wall);
            now = host_clock();
            late = (int64_t)(wall.tv_sec - stamp.tv_sec) * 1000000000 + (wall.tv_nsec - stamp.tv_nsec);
            return late > 0 && late < 1000000000 ? now - (uint64_t)late : now;
        }
    }
    return host_clock();
}

/* What came asks for an answer from here on; the time of chip and flash is told apart. */
void host_pace_came(host_pace *pace, uint64_t at)
{
    pace->came = pace->heard = at;
    pace->before = pace->chip + pace->flash;
}

static void turned(host_pace *pace, uint64_t now)
{
    const uint64_t apart = pace->chip + pace->flash - pace->before;
    if (pace->came != 0 && now > pace->came) {
        pace->turned += now - pace->came > apart ? now - pace->came - apart : 0;
        pace->turns++;
    }
    pace->came = 0;
}

void host_pace_frame(host_pace *pace, const teds_can_frame *frame, uint32_t bitrate, uint32_t data_bitrate)
{
    const uint64_t now = host_clock(), wire = host_wire_ns(frame, bitrate, data_bitrate);
    /* a controller has a queue: the next frame is made ready while this one is still on the wire */
    const bool queued = pace->free_at <= now && now - pace->free_at < pace->last;
    turned(pace, now);
    pace->free_at = (queued || pace->free_at > now ? pace->free_at : now) + wire;
    pace->last = wire;
    host_hold(pace->free_at);
}

void host_pace_answer(host_pace *pace, uint64_t due)
{
    const uint64_t now = host_clock();
    if (now > due && pace->came != 0) { /* late is what is beyond the frame delays */
        const uint64_t apart = pace->chip + pace->flash - pace->before;
        pace->turned += now - due > apart ? now - due - apart : 0;
    }
    pace->turns++;
    pace->came = 0;
    host_hold(due);
}
