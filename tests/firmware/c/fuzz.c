/* SPDX-License-Identifier: Apache-2.0 */
/* Fuzzed under ASan and UBSan with cryptography that says yes: whatever comes, nothing is read or written beyond.
 *
 * All of a node is one object, so a sanitizer does not see one array of it run into the next: what says how far each is
 * filled is looked at after each step (holds_together).
 *
 * The first octet of an input says where it goes: CAN frames (length, then id and data), whole commands, a reader, a
 * session that measures, a connection, packets of Manage. With
 * -DTEDS_FUZZ_ALONE it is a program that runs the files named to it, for machines without libFuzzer. */
#include "inside.h"
#include "memory.h"

#include <stdlib.h>
#include <string.h>

int LLVMFuzzerTestOneInput(const uint8_t *octets, size_t length);

/* The port's functions that fail now, by bit; the bits above count the read of flash that fails. */
enum { RANDOM = 1, POINTS = 2, MACS = 4, SEALS = 8, FLASH = 16 };
static unsigned failing;

static int draw(char kind, uint8_t *out, size_t length)
{
    memset(out, kind == 'n' ? 0 : 1, length);
    return failing & RANDOM ? -1 : 0;
}

/* -- cryptography that says yes ------------------------------------------------------------------------------------------ */

static int make(void *user, int use, teds_key_ref *key, uint8_t point[65])
{
    (void)user;
    memset(key, use + 1, sizeof *key);
    memset(point, use + 1, 65);
    point[0] = 4;
    return failing & POINTS ? -1 : 0;
}

static bool good(void *user, const uint8_t point[65])
{
    (void)user;
    return point[0] == 4;
}

static int ecdh(void *user, const teds_key_ref *key, const uint8_t peer[65], uint8_t out[32])
{
    (void)user;
    (void)key;
    memcpy(out, peer, 32);
    return failing & POINTS ? -1 : 0;
}

static int sign(void *user, const teds_key_ref *key, const uint8_t hash[32], uint8_t out[64])
{
    (void)user;
    (void)key;
    memcpy(out, hash, 32);
    memset(out + 32, 1, 32);
    return failing & POINTS ? -1 : 0;
}

static bool verify(void *user, const uint8_t point[65], const uint8_t hash[32], const uint8_t signature[64])
{
    (void)user;
    (void)point;
    (void)hash;
    (void)signature;
    return true;
}

static int hmac(void *user, const uint8_t *key, size_t key_length, const teds_part *parts, size_t count,
                uint8_t out[32])
{
    (void)user;
    (void)key;
    (void)key_length;
    (void)parts;
    (void)count;
    memset(out, 0, 32);
    return failing & MACS ? -1 : 0;
}

static void start(void *user, teds_sha256 *state)
{
    (void)user;
    memset(state, 0, sizeof *state);
}

static void update(void *user, teds_sha256 *state, const uint8_t *octets, size_t length)
{
    (void)user;
    for (size_t i = 0; i < length; i++) {
        state->octets[0] ^= octets[i];
    }
}

static void finish(void *user, teds_sha256 *state, uint8_t out[32])
{
    (void)user;
    (void)state;
    memset(out, 0, 32);
}

static int seal(void *user, const uint8_t key[16], const uint8_t nonce[13], const uint8_t *in, size_t length,
                uint8_t *out, size_t tag_length)
{
    (void)user;
    (void)key;
    (void)nonce;
    memmove(out, in, length);
    memset(out + length, 0, tag_length);
    return failing & SEALS ? -1 : 0;
}

static bool open_sealed(void *user, const uint8_t key[16], const uint8_t nonce[13], const uint8_t *in, size_t length,
                        uint8_t *out, size_t tag_length)
{
    (void)user;
    (void)key;
    (void)nonce;
    (void)tag_length;
    memcpy(out, in, length);
    return true;
}

/* Channel TEDS of the three channels, as memory_put takes them: each fits what the firmware says. */
static size_t channel_teds(const memory_board *own, uint8_t *out)
{
    uint8_t *at = out;
    for (size_t i = 0; i < own->port.channel_count; i++) {
        const teds_channel *each = &own->channels[i];
        const uint8_t teds[23] = {0, 0, 0, 19, 3, 4, 0, 3, 1, 1, 11, 1, each->kind, 18, 6, 40, 1, 0, 41, 1, each->octets};
        const uint8_t head[4] = {each->number, 3, 0, sizeof teds};
        memcpy(at, head, sizeof head);
        memcpy(at + sizeof head, teds, sizeof teds);
        at += sizeof head + sizeof teds;
    }
    return (size_t)(at - out);
}

static memory_board *board(bool keyed)
{
    static const uint8_t uuid[10] = {1}, key[16] = {2}, point[65] = {4};
    uint8_t teds[128];
    memory_board *own = memory_new(uuid, 8, 0xFF, draw);
    teds_port *port = &own->port;
    port->p256_make = make;
    port->p256_good = good;
    port->p256_ecdh = ecdh;
    port->p256_sign = sign;
    port->p256_verify = verify;
    port->hmac = hmac;
    port->sha256_start = start;
    port->sha256_update = update;
    port->sha256_finish = finish;
    port->ccm_seal = seal;
    port->ccm_open = open_sealed;
    memory_channel(own, 1, TEDS_SENSOR, 0, 2, 1000);
    memory_channel(own, 2, TEDS_ACTUATOR, 0, 4, 1000);
    memory_channel(own, 3, TEDS_EVENT_SENSOR, 0, 2, 1000);
    memory_nfc(own, 4, 15, 200);
    failing = 0;
    if (memory_start(own) != 0 ||
        memory_put(own, keyed ? 1 : 0, 0x21, 1, 1, key, point, point, teds, channel_teds(own, teds)) != 0) {
        abort();
    }
    return own;
}

/* -- what no input may bring about ---------------------------------------------------------------------------------------- */

static bool streams_hold(const teds_node *node)
{
    for (size_t i = 0; i < TEDS_STREAMS; i++) {
        const teds_stream *each = &node->streams[i];
        if (each->used && (each->fill > sizeof each->filling || each->length > TEDS_MESSAGE || each->session == NULL ||
                           !each->session->used)) {
            return false;
        }
    }
    for (size_t i = 0; i < TEDS_SESSIONS; i++) {
        if (node->sessions[i].drive.at > sizeof node->sessions[i].drive.message ||
            node->sessions[i].drive.octets > TEDS_DRIVE_OCTETS) {
            return false;
        }
    }
    return (node->can.data_stream == NULL || node->can.data_stream->used) && node->can.data_at <= node->can.data_length &&
           node->can.data_length <= sizeof node->can.data;
}

static bool lines_hold(const teds_node *node)
{
    for (size_t i = 0; i < TEDS_CAN_LINES; i++) {
        const teds_line *each = &node->lines[i];
        if (each->source != 0 && (each->out_at > each->out_length ||
                           (each->out_reply != NULL && each->out != each->out_reply->octets && each->out_state != 0))) {
            return false;
        }
    }
    return node->can.rx_line == NULL ||
           (node->can.rx_at < node->can.rx_length && node->can.rx_length <= sizeof node->rx);
}

static void holds_together(const memory_board *board)
{
    const teds_node *node = &board->node;
    bool holds = streams_hold(node) && lines_hold(node) && node->staging_end <= sizeof node->staging &&
                 node->nfc.length <= TEDS_MAX_NDEF &&
                 node->events[0].in <= TEDS_EVENTS && node->events[0].out <= TEDS_EVENTS && !memory_misused(board);
    for (size_t i = 0; i < TEDS_REPLIES; i++) {
        holds = holds && node->replies[i].length <= sizeof node->replies[i].octets;
    }
    if (!holds) {
        abort();
    }
}

static void frames(memory_board *own, const uint8_t *octets, size_t length)
{
    static const uint32_t to[] = {0x18DA21F1, 0x18DA21F2, 0x18DBFFF1, 0x1CFF0021, 0x18FF00F1, 0x18DA21F7, 0x1CFF0022};
    uint64_t now = 0;
    uint32_t identifier;
    uint8_t data[64];
    bool fd;
    while (length >= 2) {
        size_t octets_of_frame = octets[0] & 63;
        octets_of_frame = octets_of_frame + 2 <= length ? octets_of_frame : length - 2;
        now += (uint64_t)octets[1] << 20;
        memory_at(own, now);
        memory_can_rx(own, to[octets[1] % 7], octets + 2, (uint8_t)octets_of_frame, octets[0] >> 7 != 0);
        holds_together(own);
        (void)memory_poll(own);
        for (int i = 0; i < 4 && memory_can_tx(own, &identifier, data, &fd) >= 0; i++) {
            if (octets[0] >> 6 & 1) { /* a station that wants to hear on */
                memory_can_rx(own, 0x18DA21F1, (const uint8_t *)"\x30\x00\x00", 3, fd);
            }
        }
        octets += 2 + octets_of_frame;
        length -= 2 + octets_of_frame;
    }
}

/* Commands: length 2, link, frame. A seal that fits everything lets inner commands in. */
static void commands(memory_board *own, const uint8_t *octets, size_t length)
{
    static uint8_t reply[TEDS_MAX_MESSAGE];
    uint64_t now = 0;
    while (length >= 3) {
        size_t frame = (size_t)(octets[0] & 7) << 8 | octets[1];
        uint8_t *copy; /* of its own, so that the sanitizer sees what is read beyond it */
        frame = frame + 3 <= length ? frame : length - 3;
        copy = malloc(frame > 0 ? frame : 1);
        if (copy == NULL) {
            abort();
        }
        memcpy(copy, octets + 3, frame);
        now += (uint64_t)octets[0] << 24;
        memory_at(own, now);
        if (memory_handle(own, (uint8_t)(0xF1 + octets[2] % 3), octets[2] & 0x40 ? TEDS_AT_NFC : TEDS_CAN,
                          octets[2] >> 7 != 0, copy, frame, reply) > sizeof reply) {
            abort();
        }
        free(copy);
        memory_reply_left(own, 0xF1);
        (void)memory_poll(own);
        holds_together(own);
        octets += 3 + frame;
        length -= 3 + frame;
    }
}

/* A reader: length (bit 7: a whole NDEF message, else a frame), then octets; what it writes gets its CRC mended. */
static void taps(memory_board *own, const uint8_t *octets, size_t length)
{
    uint8_t out[256];
    memory_nfc_field(own, true);
    while (length >= 1) {
        size_t octets_of_it = octets[0] & 127;
        uint8_t *copy;
        octets_of_it = octets_of_it + 1 <= length ? octets_of_it : length - 1;
        copy = malloc(octets_of_it > 0 ? octets_of_it : 1);
        if (copy == NULL) {
            abort();
        }
        memcpy(copy, octets + 1, octets_of_it);
        if (octets[0] >> 7 != 0) {
            if (octets_of_it > 33 && copy[3] == 't') { /* a payload record: its CRC fits */
                teds_put32(copy + 29, teds_crc32(teds_crc32(0, copy + 21, 8), copy + 33, octets_of_it - 33));
            }
            (void)memory_nfc_written(own, copy, octets_of_it);
        } else if (memory_nfc_frame(own, copy, octets_of_it, out) > sizeof out) {
            abort();
        }
        free(copy);
        (void)memory_poll(own);
        holds_together(own);
        octets += 1 + octets_of_it;
        length -= 1 + octets_of_it;
    }
    memory_nfc_field(own, false);
}

/* -- a session that measures, over a connection or the bus ------------------------------------------------------------ */

/* `count` octets of what is left, as a copy of their own. */
static uint8_t *piece(const uint8_t **octets, size_t *length, size_t *count)
{
    uint8_t *copy;
    *count = *count < *length ? *count : *length;
    copy = malloc(*count > 0 ? *count : 1);
    if (copy == NULL) {
        abort();
    }
    memcpy(copy, *octets, *count);
    *octets += *count;
    *length -= *count;
    return copy;
}

static void one_command(memory_board *own, const uint8_t *frame, size_t length, bool air)
{
    static uint8_t reply[TEDS_MAX_MESSAGE];
    if (memory_handle(own, air ? TEDS_LINK_BLE : 0xF1, air ? TEDS_AT_BLE : TEDS_CAN, false, frame, length, reply) >
        sizeof reply) {
        abort();
    }
}

static void inner(memory_board *own, uint32_t counter, const uint8_t *command, size_t length, bool air)
{
    uint8_t frame[6 + 4 + 256 + 32] = {0, 0, TEDS_CLASS_SECURITY, TEDS_SEALED};
    const size_t padding = 16 - length % 16, whole = 4 + length + padding + 16;
    teds_put16(frame + 4, (uint16_t)whole);
    teds_put32(frame + 6, counter);
    memcpy(frame + 10, command, length);
    memset(frame + 10 + length, (int)padding, padding);
    one_command(own, frame, 6 + whole, air);
}

/* Open, every channel claimed, a stream and a Drive: what a fuzzer does not find by itself. */
static uint32_t begin_measuring(memory_board *own, bool air)
{
    static const uint8_t operate[] = {0, 0, 4, 1, 0, 17, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 60};
    static const uint8_t drive[] = {0, 0, TEDS_CLASS_SECURITY, TEDS_DRIVE, 0, 1, 2};
    static const uint8_t subscribe[] = {0, 0, TEDS_CLASS_SECURITY, TEDS_SUBSCRIBE, 0, 22, 0, 0, 5, 0, 100, 0, 0, 0, 0, 0,
                                        0x0F, 0x42, 0x40, 0, 0, 0, 0, 0, 0, 0, 0, 1};
    uint8_t open[6 + 89] = {0, 0, TEDS_CLASS_SECURITY, TEDS_OPEN, 0, 89}, acts[25] = {0, 2, 4, 1, 0, 19};
    memset(open + 14, 7, 65);
    open[14] = 4;
    acts[22] = 60;
    teds_put16(acts + 23, 10000);
    one_command(own, open, sizeof open, air);
    inner(own, 1, operate, sizeof operate, air);
    inner(own, 2, acts, sizeof acts, air);
    inner(own, 3, drive, sizeof drive, air);
    inner(own, 4, subscribe, sizeof subscribe, air);
    memory_reply_left(own, air ? TEDS_LINK_BLE : 0xF1);
    return 4;
}

static void leave(memory_board *own, bool air)
{
    uint32_t identifier;
    uint8_t data[512], place;
    bool fd;
    (void)memory_poll(own);
    holds_together(own);
    if (memory_can_tx(own, &identifier, data, &fd) > 64) {
        abort();
    }
    while (air && memory_ble_notify(own, 0, data) > 0) {
    }
    if (memory_ble_data(own, &place, data) > TEDS_BLE_DATA) {
        abort();
    }
}

/* Steps: what (a time, a command, a Drive frame, a trigger, an event, failures, frames of a connection), how much. */
static void measures(memory_board *own, const uint8_t *octets, size_t length, bool air)
{
    uint64_t now = 1000000;
    uint32_t counter;
    memory_at(own, now);
    if (air) {
        memory_ble_connected(own, 0, 247);
        memory_ble_hears(own, 0, true);
    }
    counter = begin_measuring(own, air);
    while (length >= 2) {
        const uint8_t what = octets[0];
        size_t count = octets[1];
        uint8_t *copy;
        octets += 2;
        length -= 2;
        now += (uint64_t)count << (what >> 3);
        memory_at(own, now);
        count = (what & 7) == 0 ? 0 : count;
        copy = piece(&octets, &length, &count);
        switch (what & 7) {
        case 1: inner(own, ++counter, copy, count, air); break;
        case 2: memory_can_rx(own, 0x18EF21F1, copy, (uint8_t)(count < 64 ? count : 64), (what & 8) != 0); break;
        case 3: memory_can_rx(own, 0x18FF00F1, copy, (uint8_t)(count < 8 ? count : 8), false); break;
        case 4: memory_event(own, 3, now, (const uint8_t *)"\x12\x34", true); break;
        case 5:
            failing = count > 0 ? copy[0] : 0;
            memory_fails(own, (failing & FLASH) != 0);
            memory_read_fails(own, (long)(failing >> 5));
            break;
        case 6: memory_ble_written(own, 0, copy, count); break;
        case 7: (what & 8 ? memory_ble_driven : memory_ble_written)(own, what >> 4 & 3, copy, count); break;
        default: break;
        }
        free(copy);
        memory_reply_left(own, air ? TEDS_LINK_BLE : 0xF1);
        leave(own, air);
    }
    failing = 0;
    if (air) {
        memory_ble_disconnected(own, 0);
    }
    leave(own, air);
}

/* -- packets of Manage -------------------------------------------------------------------------------------------------- */

static memory_board *managed;
static uint8_t flags, bent; /* of About; how the manager's answer is bent, 0: not */

/* What reaches the manager is on the list and as long as it says, whatever came; then it is the host port's own server. */
static size_t manager(char what, unsigned argument, uint8_t *packet, size_t length, size_t room)
{
    static const uint8_t listed[][3] = {{8, 0, 6}, {8, 0, 8}, {8, 1, 0}, {8, 1, 6}, {10, 0, 0}, {10, 1, 0}, {10, 1, 1}};
    bool found = false;
    (void)argument;
    if (what == 'a') {
        packet[0] = flags;
        return 41;
    }
    if (what != 'm') {
        return 0;
    }
    for (size_t i = 0; i < sizeof listed / sizeof listed[0]; i++) {
        found = found || (packet[0] == listed[i][0] && packet[4] == 0 && packet[5] == listed[i][1] && packet[7] == listed[i][2]);
    }
    if (!found || packet[1] != 0 || teds_get16(packet + 2) != length - 8 || length < 9) {
        abort();
    }
    length = images_manage(&managed->images, packet, length, packet, room);
    if (bent != 0 && length > 8) {
        packet[8u + bent % (length - 8)] ^= bent;
    }
    return bent == 0xFF ? room + 1 : length;
}

/* Steps: what (a whole packet; the body of a listed one; a time; flags and failures), how much. */
static void manages(memory_board *own, const uint8_t *octets, size_t length)
{
    static const uint8_t about[] = {0, 0, TEDS_CLASS_SECURITY, TEDS_ABOUT, 0, 0};
    static const uint8_t heads[8][3] = {{8, 0, 6}, {8, 0, 8}, {8, 1, 0}, {8, 1, 6}, {10, 0, 0}, {10, 0, 5}, {10, 1, 0}, {10, 1, 1}};
    uint8_t open[6 + 89] = {0, 0, TEDS_CLASS_SECURITY, TEDS_OPEN, 0, 89}, command[256];
    uint64_t now = 1000000;
    uint32_t counter = 0;
    managed = own;
    flags = TEDS_FIRMWARE_SIGNED;
    bent = 0;
    memory_at(own, now);
    (void)memory_images(own, about, sizeof about, false);
    memory_firmware(own, manager, 0);
    memset(open + 14, 7, 65);
    open[14] = 4;
    one_command(own, open, sizeof open, false);
    inner(own, ++counter, about, sizeof about, false);
    while (length >= 2) {
        const uint8_t what = octets[0];
        size_t count = octets[1];
        uint8_t *copy;
        octets += 2;
        length -= 2;
        count = count < 240 ? count : 240;
        copy = piece(&octets, &length, &count);
        memset(command, 0, 14);
        command[2] = TEDS_CLASS_SECURITY;
        command[3] = TEDS_MANAGE;
        switch (what & 3) {
        case 0:
            memcpy(command + 6, copy, count);
            break;
        case 1:
            command[6] = heads[what >> 2 & 7][0];
            teds_put16(command + 8, (uint16_t)count);
            command[11] = heads[what >> 2 & 7][1];
            command[13] = heads[what >> 2 & 7][2];
            memcpy(command + 14, copy, count);
            count += 8;
            break;
        case 2:
            now += (uint64_t)count << (what >> 2 & 31);
            memory_at(own, now);
            (void)memory_poll(own);
            break;
        default:
            flags = (uint8_t)(TEDS_FIRMWARE_SIGNED | (what >> 2 & 3) << 2);
            bent = count > 0 ? copy[0] : 0;
            memory_fails(own, (what >> 4 & 1) != 0);
            inner(own, ++counter, about, sizeof about, false);
            break;
        }
        free(copy);
        if ((what & 3) < 2) {
            teds_put16(command + 4, (uint16_t)count);
            inner(own, ++counter, command, 6 + count, false);
        }
        memory_reply_left(own, 0xF1);
        holds_together(own);
        if (own->node.managed.upload_of != NULL && !own->node.managed.upload_of->used) {
            abort();
        }
    }
}

int LLVMFuzzerTestOneInput(const uint8_t *octets, size_t length)
{
    memory_board *own;
    if (length < 2) {
        return 0;
    }
    own = board((octets[0] & 0x2A) != 0);
    if (octets[0] & 0x20) {
        manages(own, octets + 1, length - 1);
    } else if (octets[0] & 8) {
        measures(own, octets + 1, length - 1, (octets[0] & 16) != 0);
    } else if (octets[0] & 4) {
        taps(own, octets + 1, length - 1);
    } else if (octets[0] & 1) {
        frames(own, octets + 1, length - 1);
    } else {
        commands(own, octets + 1, length - 1);
    }
    memory_free(own);
    return 0;
}

#ifdef TEDS_FUZZ_ALONE
#include <stdio.h>

int main(int count, char **names)
{
    static uint8_t octets[65536];
    for (int i = 1; i < count; i++) {
        FILE *file = fopen(names[i], "rb");
        size_t length;
        if (file == NULL) {
            return 1;
        }
        length = fread(octets, 1, sizeof octets, file);
        (void)fclose(file);
        (void)LLVMFuzzerTestOneInput(octets, length);
    }
    (void)printf("fuzz: %d inputs of the corpus\n", count - 1);
    return 0;
}
#endif
