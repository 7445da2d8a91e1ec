/* SPDX-License-Identifier: Apache-2.0 */
/* ISO-TP, Announce and Claim as the bus sees them: frames in, frames out, time in the test's hands. */
#include "check.h"
#include "isotp.h"
#include "inside.h"
#include "memory.h"

#include <string.h>

#define MS UINT64_C(1000000)
#define OWN 0x21u
#define TO_NODE (0x18DA0000u | OWN << 8 | 0xF1u)

static uint64_t now;
static uint8_t serial;

static int draw(char kind, uint8_t *out, size_t length)
{
    memset(out, 0, length);
    if (kind != 'n') {
        out[31] = ++serial;
    }
    return 0;
}

static memory_board *fresh(void)
{
    static const uint8_t uuid[10] = {1, 2, 3, 4, 5, 6, 7, 8, 9, 10}, none[65] = {0};
    memory_board *board = memory_new(uuid, 8, 0xFF, draw);
    now = 100 * MS;
    if (board != NULL && memory_start(board) == 0) {
        (void)memory_put(board, 0, OWN, 0, 0, none, none, none, none, 0);
    }
    return board;
}

static void in(memory_board *board, uint32_t identifier, const char *octets, uint8_t length, bool fd)
{
    memory_at(board, now);
    memory_can_rx(board, identifier, (const uint8_t *)octets, length, fd);
}

/* The next frame that leaves by now; its length, -1: none. */
static int out(memory_board *board, uint32_t *identifier, uint8_t data[64])
{
    bool fd;
    memory_at(board, now);
    (void)memory_poll(board);
    return memory_can_tx(board, identifier, data, &fd);
}

static int silent(memory_board *board)
{
    uint32_t identifier;
    uint8_t data[64];
    return out(board, &identifier, data) < 0;
}

/* A Read of the Security TEDS: its first frame, then `frames` more after a flow control. */
static void asks_for_much(memory_board *board)
{
    in(board, TO_NODE, "\x10\x0c\x05\x00\x00\x01\x02\x00", 8, false);
}

static void rest_of_question(memory_board *board)
{
    in(board, TO_NODE, "\x21\x05\x80\x00\x00\x00\x00\xcc", 8, false);
}

static void a_long_answer_waits_for_flow_control(void)
{
    memory_board *board = fresh();
    uint32_t identifier = 0;
    uint8_t data[64];
    int frames = 0;
    asks_for_much(board);
    CHECK(out(board, &identifier, data) == 8 && memcmp(data, "\x30\x10\x00\xcc", 4) == 0, "flow control");
    CHECK(identifier == (0x18DAF100u | OWN), "its identifier %08x", (unsigned)identifier);
    rest_of_question(board);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10 && data[1] == 1 + 3 + 4 + 237, "first frame");
    CHECK(silent(board), "nothing leaves before a flow control");
    in(board, TO_NODE, "\x31\x00\x00\xcc\xcc\xcc\xcc\xcc", 8, false);
    now += 900 * MS;
    CHECK(silent(board), "WAIT makes it wait on");
    in(board, TO_NODE, "\x30\x02\x05\xcc\xcc\xcc\xcc\xcc", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x21, "consecutive frame");
    CHECK(silent(board), "5 ms have not passed");
    now += 5 * MS;
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x22, "the second of the block");
    now += 5 * MS;
    CHECK(silent(board), "a block of two is over");
    in(board, TO_NODE, "\x30\x00\xf9\xcc\xcc\xcc\xcc\xcc", 8, false);
    while (out(board, &identifier, data) == 8 && frames < 100) {
        frames++;
        now += MS;
    }
    CHECK(frames == (245 - 6 + 6) / 7 - 2, "%d frames", frames);
    memory_free(board);
}

static void what_nobody_takes_up_is_given_up(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    asks_for_much(board);
    (void)out(board, &identifier, data);
    rest_of_question(board);
    CHECK(out(board, &identifier, data) == 8, "first frame");
    now += 1001 * MS;
    CHECK(silent(board), "given up");
    in(board, TO_NODE, "\x30\x00\x00\xcc\xcc\xcc\xcc\xcc", 8, false);
    CHECK(silent(board), "a flow control that is late is nobody's");
    for (int i = 0; i < 12; i++) {
        asks_for_much(board);
        (void)out(board, &identifier, data);
        rest_of_question(board);
        CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10, "asked anew it answers");
    }
    for (int block = 1; block < 3; block++) { /* of each block */
        for (int i = 0; i < 10; i++) {
            in(board, TO_NODE, "\x31\x00\x00", 3, false);
        }
        CHECK(silent(board), "it waits on");
        in(board, TO_NODE, "\x30\x01\x00", 3, false);
        CHECK(out(board, &identifier, data) == 8 && data[0] == 0x20 + block, "ten WAITs are borne");
    }
    for (int i = 0; i < 11; i++) {
        in(board, TO_NODE, "\x31\x00\x00", 3, false);
    }
    CHECK(silent(board), "eleven WAITs end it");
    in(board, TO_NODE, "\x30\x00\x00", 3, false);
    CHECK(silent(board), "ended");
    memory_free(board);
}

static void a_broken_question_is_dropped(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    asks_for_much(board);
    (void)out(board, &identifier, data);
    in(board, TO_NODE, "\x22\x05\x80\x00\x00\x00\x00\xcc", 8, false);
    CHECK(silent(board), "a number is missing");
    rest_of_question(board);
    CHECK(silent(board), "and the rest is nobody's");
    asks_for_much(board);
    (void)out(board, &identifier, data);
    now += 1001 * MS;
    rest_of_question(board);
    CHECK(silent(board), "too late");
    in(board, TO_NODE, "\x10\x06\x05\x00\x00\x01\x02\x00", 8, false);
    CHECK(silent(board), "a first frame of what fits one frame");
    in(board, TO_NODE, "\x08\x01\x02\x03\x04\x05\x06\x07", 8, false);
    in(board, TO_NODE, "\x00\x00", 2, false);
    in(board, TO_NODE, "\x05", 1, false);
    in(board, TO_NODE, "\x40\x01\x02", 3, false);
    CHECK(silent(board), "frames that say nothing");
    in(board, TO_NODE, "\x10\x07\x05\x00\x00\x80\x07\x00", 8, false);
    CHECK(silent(board), "a first frame of 7 octets: FF_DLmin of a classic frame is 8");
    in(board, TO_NODE, "\x00\x06\x05\x00\x00\x80\x07\x00", 8, false);
    in(board, 0x18DBFFF1u, "\x00\x07\x05\x00\x00\x80\x07\x00\x00", 9, false);
    in(board, TO_NODE, "\x00\x06\x05\x00\x00\x80\x07\x00", 8, true);
    CHECK(silent(board), "the escape of a length in a frame of 8 octets");
    in(board, TO_NODE, "\x07\x05\x00\x00\x80\x07\x00\x00\xcc\xcc\xcc\xcc", 12, true);
    in(board, TO_NODE, "\x00\x07\x05\x00\x00\x80\x07\x00\x00\xcc\xcc\xcc", 12, true);
    CHECK(silent(board), "a longer frame without it, or with a length that needs none");
    memory_free(board);
}

static void what_cannot_be_taken_is_refused_by_one_frame(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    in(board, TO_NODE, "\x1f\xff\x77\x00\x00\x01\x03\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && memcmp(data, "\x05\x77\x00\x00\x01\x0a", 6) == 0, "10");
    in(board, TO_NODE, "\x10\x00\x00\x01\x00\x00\x78\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && memcmp(data, "\x05\x78\x00\x00\x01\x0a", 6) == 0, "10, by 32 bits");
    asks_for_much(board);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "one long question is taken");
    in(board, TO_NODE + 1, "\x10\x0c\x79\x00\x00\x01\x02\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && identifier == (0x18DAF200u | OWN) &&
              memcmp(data, "\x05\x79\x00\x00\x01\x11", 6) == 0,
          "17 to another station");
    rest_of_question(board);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10, "the first one is answered");
    in(board, TO_NODE + 1, "\x10\x0c\x79\x00\x00\x01\x02\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "and now the other one is heard");
    memory_free(board);
}

/* A length in 32 bits that 12 bits hold is ignored (ISO 15765-2), and nothing is ever written behind what it announced:
 * a first frame that says less than it carries would never end. */
static void a_long_length_that_is_short_is_nobodys(void)
{
    static const uint16_t lengths[] = {0, 1, 2, 3, 7, 8, 57, 58, 59, 1024, 1025, 4095};
    for (size_t i = 0; i < 2 * (sizeof lengths / sizeof lengths[0]); i++) {
        memory_board *board = fresh();
        const bool fd = i % 2 != 0;
        const uint8_t octets = fd ? 64 : 8;
        uint8_t streams[sizeof board->node.streams], staging[sizeof board->node.staging];
        char frame[64];
        memcpy(streams, &board->node.streams, sizeof streams);
        memcpy(staging, board->node.staging, sizeof staging);
        memset(frame, 0x41, sizeof frame);
        memcpy(frame, "\x10\x00\x00\x00", 4);
        teds_put16((uint8_t *)frame + 4, lengths[i / 2]);
        in(board, TO_NODE, frame, octets, fd);
        CHECK(silent(board), "%u by 32 bits, FD %d", lengths[i / 2], fd);
        for (int number = 1; number < 600; number++) {
            frame[0] = (char)(0x20 | (number & 15));
            in(board, TO_NODE, frame, octets, fd);
            CHECK(board->node.can.rx_at <= sizeof board->node.rx, "%u octets held", board->node.can.rx_at);
            if (board->node.can.rx_at > sizeof board->node.rx) {
                break;
            }
        }
        CHECK(memcmp(streams, &board->node.streams, sizeof streams) == 0 &&
                  memcmp(staging, board->node.staging, sizeof staging) == 0,
              "what lies behind is as it was");
        memory_free(board);
    }
}

static void frames_may_come_twice(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    in(board, TO_NODE, "\x10\x14\x05\x00\x00\x01\x02\x00", 8, false);
    (void)out(board, &identifier, data);
    in(board, TO_NODE, "\x21\x0d\x80\x00\x00\x00\x00\x01", 8, false);
    in(board, TO_NODE, "\x21\x0d\x80\x00\x00\x00\x00\x01", 8, false);
    in(board, TO_NODE, "\x22\x01\x02\x03\x04\x05\x06\x07", 8, false);
    CHECK(out(board, &identifier, data) == 8 && memcmp(data, "\x05\x05\x00\x00\x01\x04", 6) == 0,
          "a Read of 13 octets: 4");
    memory_free(board);
}

/* A clock that goes on while a command runs: what is later than "now" is not old. */
static uint64_t running;

static uint64_t runs_on(void *user)
{
    (void)user;
    return running += 1000;
}

static void a_repetition_while_the_reply_is_under_way_gets_it_again(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64], first[64];
    running = now;
    board->port.now = runs_on;
    in(board, TO_NODE, "\x07\x05\x00\x00\x80\x03\x00\x00", 8, false); /* Open: 2 in factory state, one frame */
    CHECK(out(board, &identifier, first) == 8 && memcmp(first, "\x05\x05\x00\x00\x01\x02", 6) == 0, "refused");
    for (int i = 0; i < TEDS_REPLIES; i++) {
        if (board->node.replies[i].stored) {
            board->node.replies[i].octets[4] = 0x63; /* so that it shows whether it was run again */
            board->node.lines[0].out_state = TEDS_OUT_FIRST; /* as if it were still leaving */
            board->node.lines[0].out_reply = &board->node.replies[i];
        }
    }
    in(board, TO_NODE, "\x07\x05\x00\x00\x80\x03\x00\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[5] == 0x63, "the stored reply, not a new one");
    memory_free(board);
}

static void everyone_is_answered_after_a_wait(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    in(board, 0x18DBFFF3u, "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
    in(board, 0x18DBFFF3u, "\x07\x2b\x00\x00\x80\x08\x00\x00", 8, false);
    now += 50 * MS;
    CHECK(out(board, &identifier, data) == 8 && identifier == (0x18DAF300u | OWN) &&
              memcmp(data, "\x10\x1b\x2a\x01\x00\x17\x01\x01", 8) == 0,
          "Identify, and nothing else");
    memory_free(board);
}

/* Its answer waits for a flow control that never comes, and it is asked again: a loop that sleeps until what is due next
 * must not sleep through it. */
static void everyone_is_answered_in_time_though_the_last_answer_waits(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    uint64_t due;
    in(board, 0x18DBFFF3u, "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
    now += 50 * MS;
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10, "the first answer begins");
    in(board, 0x18DBFFF3u, "\x07\x2b\x00\x00\x80\x07\x00\x00", 8, false);
    due = memory_poll(board);
    CHECK(due <= now + 50 * MS, "due in %u ms", (unsigned)((due - now) / MS));
    now = due;
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10 && data[2] == 0x2b, "the second one");
    memory_free(board);
}

/* Four stations read at once, and there is room for three replies: the oldest is cut short, and nobody hears another's. */
static void more_long_answers_than_room_cut_the_oldest_short(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    unsigned frames[4] = {0}, others = 0;
    for (uint8_t i = 0; i < 4; i++) {
        const uint8_t rest[8] = {0x21, 5, 0x80, 0, 0, 0, (uint8_t)(i + 1), 0xCC}; /* from octet i + 1 on */
        now += MS;
        in(board, TO_NODE + i, "\x10\x0c\x05\x00\x00\x01\x02\x00", 8, false);
        CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "station %u is heard", i);
        in(board, TO_NODE + i, (const char *)rest, 8, false);
        CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10 && data[1] == 245 - (i + 1) && data[3] == 1,
              "station %u: a first frame of %u octets", i, data[1]);
        CHECK(identifier == (0x18DA0000u | (0xF1u + i) << 8 | OWN), "to it");
    }
    for (uint8_t i = 0; i < 4; i++) {
        in(board, TO_NODE + i, "\x30\x00\x00", 3, false);
    }
    while (out(board, &identifier, data) >= 0) {
        const unsigned to = (identifier >> 8 & 0xFF) - 0xF1;
        if (to < 4 && ++frames[to] == 1) {
            others += data[2] != to + 1; /* the offset's last octet */
        }
    }
    CHECK(frames[0] == 0, "the oldest is cut short: %u frames", frames[0]);
    for (unsigned i = 1; i < 4; i++) {
        CHECK(frames[i] == (245 - (i + 1) - 6 + 6) / 7, "station %u: %u frames", i, frames[i]);
    }
    CHECK(others == 0, "each its own");
    memory_free(board);
}

/* Erasing takes seconds on some chips: it waits until the reply has left, over BLE too. */
static void the_old_slot_is_erased_when_the_reply_has_left(void)
{
    static const uint8_t identify[12] = {0, 5, 0, 6, 0, 0, 0, 0, 128, 7, 0, 0};
    memory_board *board = fresh();
    uint8_t data[512];
    memory_ble_connected(board, 0, 23);
    memory_ble_written(board, 0, identify, sizeof identify);
    board->node.old_slot_due = board->node.free_slot_dirty = true;
    board->node.old_slot_by = now + 15000 * MS;
    memory_cut(board, 0, false);
    (void)memory_poll(board);
    CHECK(memory_ble_notify(board, 0, data) == 20 && memory_steps(board) == 0, "the first of two notifications");
    (void)memory_poll(board);
    CHECK(memory_steps(board) == 0, "one has not left yet");
    CHECK(memory_ble_notify(board, 0, data) == 18, "the last");
    (void)memory_poll(board);
    CHECK(memory_steps(board) == 1, "erased: %ld steps", memory_steps(board));
    memory_free(board);
}

/* A tag does not hear that its answer was read, and a chip that erases answers no reader: not while one may ask on. */
static void the_old_slot_is_erased_when_the_reader_is_quiet(void)
{
    static const uint8_t select[] = "\xd1\x02\x1fTs\x1eurn:nfc:xsn:teds-provision:tim";
    for (int way = 0; way < 2; way++) {
        memory_board *board = fresh();
        uint64_t due;
        memory_nfc(board, 4, 15, 0);
        (void)memory_start(board);
        memory_at(board, now);
        memory_nfc_field(board, true);
        CHECK(memory_nfc_written(board, select, sizeof select - 1), "a reader writes");
        board->node.old_slot_due = board->node.free_slot_dirty = true;
        board->node.old_slot_by = now + 15000 * MS;
        memory_cut(board, 0, false);
        due = memory_poll(board);
        CHECK(memory_steps(board) == 0 && due == now + 1000 * MS, "its answer is there, and is to be read");
        if (way == 0) {
            now += 999 * MS;
            memory_at(board, now);
            (void)memory_poll(board);
            CHECK(memory_steps(board) == 0, "not yet");
            now = due;
            memory_at(board, now);
        } else {
            memory_nfc_field(board, false);
        }
        due = memory_poll(board);
        CHECK(memory_steps(board) == 1 && due == UINT64_MAX, "erased: %ld steps", memory_steps(board));
        memory_free(board);
    }
}

static uint8_t address_of(const memory_board *board)
{
    uint8_t identity[23];
    teds_node_identify(&board->node, identity);
    return identity[22];
}

/* Set CAN address while the link over which it came goes: the reply never leaves, and the address is stored. */
static void a_new_address_counts_though_its_reply_is_lost(void)
{
    static const uint8_t command[7] = {0, 0, 128, 10, 0, 1, 0x55};
    static uint8_t reply[TEDS_MAX_MESSAGE];
    for (int way = 0; way < 3; way++) {
        memory_board *board = fresh();
        const uint8_t link = way == 1 ? 1 : 0xF1, kind = way == 1 ? TEDS_AT_NFC : TEDS_CAN;
        CHECK(memory_handle(board, link, kind, true, command, 7, reply) == 3 && reply[0] == 1, "128.10");
        CHECK(address_of(board) == OWN, "until the reply has left it answers at the old one");
        if (way == 0) {
            teds_node_bus_off(&board->node);
        } else {
            memory_lost(board, link);
        }
        CHECK(address_of(board) == 0x55, "way %d: it is at %02x", way, address_of(board));
        CHECK(memory_start(board) == 0 && address_of(board) == 0x55, "and stays there");
        memory_free(board);
    }
}

/* A board that has no CAN says so: address 0, and 128.10 is unknown in every state. */
static void a_board_without_can_has_no_address(void)
{
    static const uint8_t command[7] = {0, 0, 128, 10, 0, 1, 0x55};
    static uint8_t reply[TEDS_MAX_MESSAGE];
    memory_board *board = fresh();
    board->config.no_can = true;
    CHECK(address_of(board) == 0, "Identify");
    for (int tapped = 0; tapped < 2; tapped++) {
        CHECK(memory_handle(board, 1, TEDS_AT_NFC, tapped != 0, command, 7, reply) == 4 && reply[0] == 0 && reply[3] == 1,
              "128.10: %u", reply[3]);
    }
    memory_free(board);
}

static int identified(memory_board *board)
{
    uint32_t identifier;
    uint8_t data[64];
    in(board, TO_NODE, "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
    return out(board, &identifier, data) == 8 && data[0] == 0x10;
}

static void after_bus_off_it_is_silent_for_longer_and_longer(void)
{
    static const uint16_t seconds[] = {1, 2, 4, 8, 16, 30, 30};
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    CHECK(identified(board), "it is there");
    for (size_t i = 0; i < sizeof seconds / sizeof seconds[0]; i++) {
        teds_node_bus_off(&board->node);
        teds_node_bus_off(&board->node);
        teds_can_start(&board->node, now);
        now += seconds[i] * 1000 * MS - 1;
        CHECK(!identified(board) && silent(board), "%u s: neither hears nor speaks", seconds[i]);
        now += 1;
        CHECK(identified(board), "%u s: it answers", seconds[i]);
        now += 1500 * MS;
        CHECK(out(board, &identifier, data) == 8 && identifier == (0x1CFF0000u | OWN), "and has announced itself");
    }
    now += 60000 * MS;
    memory_at(board, now);
    teds_node_bus_off(&board->node);
    teds_can_start(&board->node, now);
    now += 999 * MS;
    CHECK(!identified(board), "and again silent");
    now += MS;
    CHECK(identified(board), "a minute on the bus, and it begins with a second again");
    memory_free(board);
}

static void nothing_from_before_a_loss_is_left(void)
{
    memory_board *board = fresh();
    uint32_t identifier = 0;
    uint8_t data[64];
    CHECK(identified(board), "the first line is one station's");
    in(board, TO_NODE + 1, "\x10\x0c\x05\x00\x00\x01\x02\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "another's long question begins");
    memory_move(board, OWN + 1);
    in(board, TO_NODE + 0x100, "\x10\x0c\x05\x00\x00\x01\x02\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "it keeps no other station's out after a move");
    memory_pressed(board);
    teds_node_bus_off(&board->node);
    now += 1001 * MS;
    CHECK(silent(board), "a button that was pressed before a bus-off is no news after it");
    memory_free(board);
}

static void nodes_that_meet_sort_themselves_out(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    uint8_t own[4];
    int told = 0;
    teds_put32(own, teds_crc32(0, (const uint8_t *)"\x01\x02\x03\x04\x05\x06\x07\x08\x09\x0a", 10));
    memory_at(board, now);
    teds_can_start(&board->node, now);
    now += 500 * MS;
    CHECK(out(board, &identifier, data) == 8 && identifier == (0x1CFF0000u | OWN) && data[0] == 1 && data[1] == 0 &&
              memcmp(data + 2, own, 4) == 0 && data[6] == 0 && data[7] == 0,
          "Announce");
    in(board, 0x1CFF0000u | (OWN + 1), "\x01\x00\x00\x00\x00\x00\x00\x00", 8, false);
    in(board, 0x1CFF0000u | OWN, "\x01\x00\xff\xff\xff\xff\x00\x00", 8, false);
    now += 50 * MS;
    CHECK(out(board, &identifier, data) == 8 && identifier == (0x1CFF0000u | OWN), "the smaller CRC stays");
    in(board, 0x1CFF0000u | OWN, "\x01\x00\x00\x00\x00\x01\x00\x00", 8, false);
    now += 50 * MS;
    CHECK(out(board, &identifier, data) == 8 && identifier == (0x1CFF0000u | (OWN + 2)),
          "the greater one takes the next address of which nothing was heard");
    for (int i = 0; i < 60; i++) {
        in(board, 0x1CFF0000u | (OWN + 2), "\x01\x00\xff\xff\xff\xff\x00\x00", 8, false);
        now += 60 * MS;
        told += out(board, &identifier, data) == 8;
    }
    CHECK(told == 17, "%d more Announces in this minute", told);
    now += 61000 * MS;
    in(board, 0x1CFF0000u | (OWN + 2), "\x01\x00\xff\xff\xff\xff\x00\x00", 8, false);
    now += 60 * MS;
    CHECK(out(board, &identifier, data) == 8, "and again in the next");
    memory_free(board);
}

static void a_classic_frame_has_eight_octets_at_most(void)
{
    memory_board *board = fresh();
    static const char identify[] = "\x06\x07\x00\x00\x80\x07\x00\x00\x00\x00\x00\x00\x00\x00\x00\x00";
    in(board, TO_NODE, identify, 9, false);
    CHECK(silent(board), "nine octets, as of a DLC that was read as that of FD");
    in(board, TO_NODE, identify, 16, false);
    CHECK(silent(board), "sixteen");
    in(board, TO_NODE, identify, 8, false);
    CHECK(!silent(board), "eight");
    memory_free(board);
}

static const char FOR_NOBODY[] = "\x02\x01\x00";

/* Frames of whom the profile does not know, and of other nodes. */
static void what_is_not_for_this_node_is_left_alone(void)
{
    static const uint32_t identifiers[] = {0x18DA2100u, 0x18DA21F0u, 0x18DA21F8u, 0x18DA22F1u, 0x18EF22F1u,
                                           0x18EF21F1u, 0x18FF00F1u, 0x18DBFEF1u, 0x1CFF2101u, 0x00000021u};
    memory_board *board = fresh();
    for (size_t i = 0; i < sizeof identifiers / sizeof identifiers[0]; i++) {
        in(board, identifiers[i], "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
        in(board, identifiers[i], "\x07\x2a\x00\x00\x80\x07\x00", 7, false);
        CHECK(silent(board), "%08x", (unsigned)identifiers[i]);
    }
    in(board, 0x18DBFFF1u, "\x06\x2a\x00\x00\x80\x07\x00", 7, false);
    in(board, 0x18DBFFF1u, "\x10\x08\x2a\x00\x00\x80\x07\x00", 8, false);
    now += 50 * MS;
    CHECK(silent(board), "nothing but Identify is asked of everyone");
    CHECK(identified(board), "it is there");
    memory_free(board);
}

static void no_frame_of_a_message_is_shorter_but_the_last(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    in(board, TO_NODE, "\x10\x14\x05\x00\x00\x01\x02\x00", 8, false);
    (void)out(board, &identifier, data);
    in(board, TO_NODE, "\x21\x0d\x80\x00\x00", 5, false);
    in(board, TO_NODE, "\x21\x0d\x80\x00\x00\x00\x00\x01", 8, false);
    in(board, TO_NODE, "\x22\x01\x02\x03\x04\x05\x06", 7, false);
    in(board, TO_NODE, "\x22\x01\x02\x03\x04\x05\x06\x07", 8, false);
    CHECK(out(board, &identifier, data) == 8 && memcmp(data, "\x05\x05\x00\x00\x01\x04", 6) == 0, "a Read: 4");
    in(board, TO_NODE, "\x10\x0a\x06\x00\x00\x01\x02\x00\x05\x80\x00\x00", 12, true);
    CHECK(silent(board), "would fit one frame of FD");
    memory_free(board);
}

static void one_station_does_not_cut_into_another_s_question(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    in(board, TO_NODE, "\x10\x14\x05\x00\x00\x01\x02", 7, false);
    CHECK(silent(board), "a first frame has 8 octets");
    asks_for_much(board);
    (void)out(board, &identifier, data);
    in(board, TO_NODE + 1, "\x21\x05\x80\x00\x00\x00\x00\xcc", 8, false);
    CHECK(silent(board), "another's frame is not of this question");
    rest_of_question(board);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10 && (identifier >> 8 & 0xFF) == 0xF1, "its answer");
    in(board, TO_NODE, "\x1f\xff\x77\x00\x00\x01\x03\x00", 8, true);
    CHECK(out(board, &identifier, data) == 8 && memcmp(data, "\x05\x77\x00\x00\x01\x0a", 6) == 0,
          "while it answers, a question that is too long is refused, and classic as the answer is");
    memory_free(board);
    board = fresh();
    asks_for_much(board);
    (void)out(board, &identifier, data);
    in(board, TO_NODE, "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10 && data[2] == 0x2a, "a new question ends the one before");
    rest_of_question(board);
    in(board, TO_NODE, "\x30\x00\x00", 3, false);
    while (out(board, &identifier, data) == 8) {
        CHECK(data[0] >> 4 == 2, "the rest of Identify and nothing else");
    }
    asks_for_much(board);
    (void)out(board, &identifier, data);
    now += 1001 * MS;
    in(board, TO_NODE + 1, "\x10\x0c\x79\x00\x00\x01\x02\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "what never ended makes room");
    memory_free(board);
}

static void any_flow_control_is_borne(void)
{
    static const struct {
        const char *frame;
        uint8_t length, wait; /* ms until the second frame; 0: it goes on waiting, 255: given up */
    } rows[] = {
        {"\x30\x00", 2, 0},        {"\x35\x00\x00", 3, 0}, {"\x32\x00\x00", 3, 255}, {"\x30\x00\xfa", 3, 127},
        {"\x30\x00\x80", 3, 127}, {"\x30\x00\xff", 3, 127}, {"\x30\x00\x03", 3, 3},   {"\x30\x00\x7f", 3, 127},
        {"\x30\x00\xf0", 3, 127},
    };
    for (uint32_t stmin = 0xF1; stmin <= 0xF9; stmin++) {
        CHECK(teds_isotp_gap((uint8_t)stmin) == (stmin - 0xF0) * 100000u, "STmin %02x", (unsigned)stmin);
    }
    for (size_t i = 0; i < sizeof rows / sizeof rows[0]; i++) {
        memory_board *board = fresh();
        uint32_t identifier;
        uint8_t data[64];
        asks_for_much(board);
        (void)out(board, &identifier, data);
        rest_of_question(board);
        (void)out(board, &identifier, data);
        in(board, TO_NODE, rows[i].frame, rows[i].length, false);
        if (rows[i].wait == 0 || rows[i].wait == 255) {
            CHECK(silent(board), "row %u", (unsigned)i);
            in(board, TO_NODE, "\x30\x00\x00", 3, false);
            CHECK(silent(board) == (rows[i].wait == 255), "row %u: then a good one", (unsigned)i);
        } else {
            CHECK(out(board, &identifier, data) == 8, "row %u: the first", (unsigned)i);
            now += rows[i].wait * MS - 1;
            CHECK(silent(board), "row %u: too soon", (unsigned)i);
            now += 1;
            CHECK(out(board, &identifier, data) == 8, "row %u: the second", (unsigned)i);
        }
        memory_free(board);
    }
}

/* Whether this station's plain Open (2 in factory state, one frame each way) is answered at once. */
static bool is_answered(memory_board *board, uint8_t station)
{
    uint32_t identifier = 0;
    uint8_t data[64];
    in(board, 0x18DA0000u | OWN << 8 | station, "\x07\x2e\x00\x00\x80\x03\x00\x00", 8, false);
    while (out(board, &identifier, data) >= 0) {
        if ((identifier >> 8 & 0xFF) == station && data[0] == 5) {
            return memcmp(data, "\x05\x2e\x00\x00\x01\x02", 6) == 0;
        }
    }
    return false;
}

/* Answers to everyone that nobody takes up hold every line: whoever asks the node itself is heard all the same. */
static void an_answer_to_everyone_gives_way(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    for (uint8_t i = 0; i < 4; i++) {
        in(board, 0x18DBFFF1u + i, "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
    }
    now += 50 * MS;
    for (uint8_t i = 0; i < 4; i++) {
        CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10, "answer %u begins", i);
    }
    in(board, 0x18DA21F1u, "\x30\x00\x0a", 3, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x21, "one is taken up");
    for (uint8_t i = 4; i < 7; i++) {
        CHECK(is_answered(board, (uint8_t)(0xF1 + i)), "station %u", i);
    }
    now += 10 * MS;
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x22 && (identifier >> 8 & 0xFF) == 0xF1,
          "what is taken up goes on");
    memory_free(board);
}

static void has_session(memory_board *board, size_t place, uint8_t station)
{
    board->node.sessions[place].used = true;
    board->node.sessions[place].link = station;
    board->node.sessions[place].good_at = now;
}

/* What strangers ask, of everyone and of the node, from every address and without a flow control: two stations with
 * sessions are answered each time, a newcomer is answered or refused, and the old slot is erased. */
static void what_strangers_ask_takes_no_place_of_a_session(void)
{
    memory_board *board = fresh();
    unsigned answered = 0, newcomer = 0;
    has_session(board, 0, 0xF1);
    has_session(board, 1, 0xF2);
    board->node.old_slot_due = board->node.free_slot_dirty = true;
    board->node.old_slot_by = now + 15000 * MS;
    for (unsigned round = 0; round < 100; round++) {
        uint32_t identifier;
        uint8_t data[64];
        for (uint8_t station = 0xF1; station <= 0xF7; station++) {
            in(board, 0x18DBFF00u | station, "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
            if (station < 0xF3) {
                continue;
            }
            in(board, 0x18DA0000u | OWN << 8 | station, "\x07\x2b\x00\x00\x80\x07\x00\x00", 8, false);
            if (round % 2 != 0) {
                in(board, 0x18DA0000u | OWN << 8 | station, "\x10\x60\x2c\x00\x00\x80\x03\x00", 8, false);
            }
            while (out(board, &identifier, data) >= 0) {
            }
        }
        now += 60 * MS;
        while (out(board, &identifier, data) >= 0) {
        }
        answered += is_answered(board, 0xF1) + is_answered(board, 0xF2);
        in(board, 0x18DA0000u | OWN << 8 | 0xF1, "\x10\x0c\x05\x00\x00\x01\x02\x00", 8, false);
        (void)out(board, &identifier, data);
        CHECK((identifier >> 8 & 0xFF) == 0xF1 && data[0] == 0x30, "round %u: its long question is taken", round);
        in(board, 0x18DA0000u | OWN << 8 | 0xF1, "\x21\x05\x80\x00\x00\x00\x00\xcc", 8, false);
        in(board, 0x18DA0000u | OWN << 8 | 0xF1, "\x30\x00\x00", 3, false);
        for (int frames = 0; frames < 36 && out(board, &identifier, data) >= 0; frames++) {
        }
        newcomer += is_answered(board, 0xF5);
        now += 190 * MS;
    }
    CHECK(answered == 200, "%u of 200 answers to stations with a session", answered);
    CHECK(newcomer > 90, "%u of 100 to another station", newcomer);
    CHECK(!board->node.free_slot_dirty, "the old key is gone from flash");
    CHECK(board->node.sessions[0].used && board->node.sessions[1].used, "no session ended");
    memory_free(board);
}

/* A main loop that sleeps until teds_poll's time would keep a refusal, or a flow control, until something else is due. */
static void what_waits_to_leave_is_due_now(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    memory_at(board, now);
    CHECK(memory_poll(board) > now, "nothing is due");
    in(board, TO_NODE, "\x1f\xff\x77\x00\x00\x01\x03\x00", 8, false);
    CHECK(memory_poll(board) == now, "a refusal");
    CHECK(out(board, &identifier, data) == 8 && data[5] == 10, "it leaves");
    CHECK(memory_poll(board) > now, "once");
    asks_for_much(board);
    CHECK(memory_poll(board) == now, "a flow control");
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "it leaves");
    CHECK(memory_poll(board) == now + 1000 * MS, "then the next frame of the question, within a second");
    rest_of_question(board);
    CHECK(memory_poll(board) <= now, "an answer");
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10, "its first frame leaves");
    CHECK(memory_poll(board) == now + 1000 * MS, "then a flow control, within a second");
    memory_free(board);
}

/* The same of what needs no line: a refusal to a station without one, and the Announce of a pressed button. */
static void what_leaves_without_a_line_is_due_now(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    memory_at(board, now);
    teds_can_pressed(&board->node, now);
    CHECK(memory_poll(board) == now, "a press");
    CHECK(out(board, &identifier, data) == 8 && data[6] == 1 && memory_poll(board) > now, "it leaves, once");
    has_session(board, 0, 0xF1);
    has_session(board, 1, 0xF2);
    CHECK(is_answered(board, 0xF1) && is_answered(board, 0xF2), "two lines");
    in(board, TO_NODE + 2, "\x14\x00\x05\x00\x00\x01\x03\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "a third");
    in(board, TO_NODE + 3, "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10 && memory_poll(board) > now, "a fourth");
    in(board, TO_NODE + 4, "\x07\x2c\x00\x00\x80\x07\x00\x00", 8, false);
    CHECK(memory_poll(board) == now, "a refusal");
    CHECK(out(board, &identifier, data) == 8 && data[5] == 17 && memory_poll(board) > now, "it leaves, once");
    memory_free(board);
}

/* An Announce that waited when the controller went off the bus is not sent at its return: teds_can_start plans another. */
static void no_announce_from_before_a_bus_off_is_left(void)
{
    memory_board *board = fresh();
    memory_at(board, now);
    memory_can_start(board);
    teds_can_pressed(&board->node, now);
    teds_node_bus_off(&board->node);
    now += 2000 * MS;
    CHECK(silent(board), "nothing is left");
    memory_can_start(board);
    now += 500 * MS;
    CHECK(!silent(board), "it announces itself");
    memory_free(board);
}

/* The end of a silent session is due ten minutes after its last good frame: what it staged or claimed ends with it. */
static void the_end_of_a_session_is_due(void)
{
    memory_board *board = fresh();
    memory_at(board, now);
    CHECK(memory_poll(board) == UINT64_MAX, "nothing is due");
    has_session(board, 0, 0xF1);
    CHECK(memory_poll(board) == now + 600000 * MS, "ten minutes");
    now += 599999 * MS;
    memory_at(board, now);
    CHECK(memory_poll(board) == now + MS && board->node.sessions[0].used, "it lives");
    now += MS;
    memory_at(board, now);
    CHECK(memory_poll(board) == UINT64_MAX && !board->node.sessions[0].used, "it has ended");
    memory_free(board);
}

/* Of a half-open Open and of a Request nothing lives longer than its minute, in memory neither. */
static void what_waits_for_its_station_is_wiped_after_a_minute(void)
{
    static const teds_half_open no_open;
    static const teds_pending no_request;
    memory_board *board = fresh();
    teds_half_open *half = &board->node.half_open[TEDS_SESSIONS - 1];
    teds_pending *pending = &board->node.pending;
    memory_at(board, now);
    half->used = pending->used = true;
    half->link = pending->link = 0xF1;
    half->until = now + 60000 * MS;
    pending->until = now + 60001 * MS;
    memset(&half->keys, 0x55, sizeof half->keys);
    memset(&pending->agreed, 0x55, sizeof pending->agreed);
    CHECK(memory_poll(board) == now + 60000 * MS && half->used, "the end of the Open is due");
    now += 60000 * MS;
    memory_at(board, now);
    CHECK(memory_poll(board) == now + MS && pending->used, "then that of the Request");
    CHECK(memcmp(half, &no_open, sizeof no_open) == 0, "nothing of the Open");
    now += MS;
    memory_at(board, now);
    CHECK(memory_poll(board) == UINT64_MAX, "nothing is due");
    CHECK(memcmp(pending, &no_request, sizeof no_request) == 0, "nothing of the Request");
    memory_free(board);
}

/* One spare line is that of a long request that comes in, the other's answer has just begun: a station without a line is
 * refused, not ignored. */
static void a_station_without_a_line_is_refused(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    has_session(board, 0, 0xF1);
    has_session(board, 1, 0xF2);
    CHECK(is_answered(board, 0xF1) && is_answered(board, 0xF2), "their lines");
    in(board, TO_NODE + 2, "\x14\x00\x05\x00\x00\x01\x03\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "a long question comes in");
    in(board, TO_NODE + 3, "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10, "an answer begins");
    in(board, TO_NODE + 4, "\x07\x2c\x00\x00\x80\x07\x00\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && identifier == (0x18DAF500u | OWN) &&
              memcmp(data, "\x05\x2c\x00\x00\x01\x11", 6) == 0, "17");
    in(board, TO_NODE + 5, "\x10\x0c\x79\x00\x00\x01\x02\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && identifier == (0x18DAF600u | OWN) &&
              memcmp(data, "\x05\x79\x00\x00\x01\x11", 6) == 0, "17 in place of a flow control");
    in(board, TO_NODE + 4, "\x22\x00\x00\x01\x02\x00\x00\x00", 8, false);
    CHECK(silent(board), "what asks nothing gets nothing");
    now += 100 * MS;
    CHECK(is_answered(board, 0xF5), "an answer that nobody takes up within 100 ms gives way");
    memory_free(board);
}

/* The same, in the form in which it asked. */
static void a_station_without_a_line_is_refused_in_its_form(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    has_session(board, 0, 0xF1);
    has_session(board, 1, 0xF2);
    CHECK(is_answered(board, 0xF1) && is_answered(board, 0xF2), "their lines");
    in(board, TO_NODE + 2, "\x14\x00\x05\x00\x00\x01\x03\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "a long question comes in");
    in(board, TO_NODE + 3, "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10, "an answer begins");
    for (int form = 0; form < 4; form++) {
        bool fd = form % 2 == 0;
        const bool asked = form % 2 != 0;
        in(board, TO_NODE + 4,
           form < 2 ? "\x07\x2c\x00\x00\x80\x07\x00\x00" : "\x10\x64\x2c\x00\x00\x01\x03\x00", 8, asked);
        CHECK(memory_can_tx(board, &identifier, data, &fd) == 8 && data[5] == 17 && fd == asked, "17 in form %d", form);
    }
    memory_free(board);
}

/* A stranger's long request that gives way before its flow control has left gets 17 alone; and who was refused once does
 * not keep the place from the other for ever. */
static void a_long_request_that_gives_way_is_not_asked_on(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    has_session(board, 0, 0xF3);
    asks_for_much(board);
    in(board, TO_NODE + 2, "\x10\x0c\x7a\x00\x00\x01\x02\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && identifier == (0x18DAF100u | OWN) &&
              memcmp(data, "\x05\x05\x00\x00\x01\x11", 6) == 0, "17, and no flow control");
    CHECK(out(board, &identifier, data) == 8 && identifier == (0x18DAF300u | OWN) && data[0] == 0x30, "flow control");
    CHECK(silent(board), "nothing else");
    memory_free(board);
    board = fresh();
    asks_for_much(board);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "flow control");
    in(board, TO_NODE + 1, "\x10\x0c\x79\x00\x00\x01\x02\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[5] == 17, "another waits");
    now += 1001 * MS;
    for (unsigned i = 0; i < 3; i++) {
        asks_for_much(board);
        CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "long after, nobody waits: it may begin again");
    }
    memory_free(board);
}

/* A long request as a whole ends in bounded time, whoever sends it, and however: by frames that come just in time, or by
 * beginning again and again. */
static void one_station_does_not_hold_the_place_of_long_requests(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64], next[8] = {0x20};
    unsigned taken = 0;
    in(board, TO_NODE, "\x14\x00\x05\x00\x00\x01\x03\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "flow control");
    for (unsigned frames = 1; frames < 100 && taken == 0; frames++) {
        now += 900 * MS;
        next[0] = (uint8_t)(0x20 | (frames & 15));
        in(board, TO_NODE, (const char *)next, 8, false);
        while (out(board, &identifier, data) >= 0) {
        }
        in(board, TO_NODE + 1, "\x10\x0c\x79\x00\x00\x01\x02\x00", 8, false);
        CHECK(out(board, &identifier, data) == 8, "an answer of some kind");
        taken = data[0] == 0x30 ? frames : 0;
    }
    CHECK(taken == 6, "taken after %u frames of the one before: 5 s", taken);
    memory_free(board);
    board = fresh();
    for (unsigned i = 0; i < 2; i++) {
        in(board, TO_NODE, "\x14\x00\x05\x00\x00\x01\x03\x00", 8, false);
        CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "it may begin again while nobody else waits");
    }
    in(board, TO_NODE + 1, "\x10\x0c\x79\x00\x00\x01\x02\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && memcmp(data, "\x05\x79\x00\x00\x01\x11", 6) == 0, "17");
    in(board, TO_NODE, "\x14\x00\x05\x00\x00\x01\x03\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && memcmp(data, "\x05\x05\x00\x00\x01\x11", 6) == 0, "now it waits itself");
    in(board, TO_NODE + 1, "\x10\x0c\x79\x00\x00\x01\x02\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "and the other one is heard");
    has_session(board, 0, 0xF3);
    in(board, TO_NODE + 2, "\x10\x0c\x7a\x00\x00\x01\x02\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && memcmp(data, "\x05\x79\x00\x00\x01\x11", 6) == 0,
          "a pair with a session goes before it, which gets 17");
    CHECK(out(board, &identifier, data) == 8 && identifier == (0x18DAF300u | OWN) && data[0] == 0x30, "flow control");
    memory_free(board);
}

/* A line whose reply another link's took the place of points to none. */
static void a_reply_that_is_another_link_s_is_nobodys(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    for (uint8_t i = 0; i < 4; i++) {
        now += MS;
        in(board, TO_NODE + i, "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
        CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10, "an answer begins");
    }
    for (const teds_line *line = board->node.lines; line < board->node.lines + TEDS_CAN_LINES; line++) {
        CHECK(line->out_reply == NULL || line->out_reply->link == line->source, "the reply of station %02x", line->source);
    }
    memory_free(board);
}

/* Nor does a reader or a connection get what another link was answered, once that has the place of its reply. */
static void a_reply_of_the_tag_and_of_the_air_goes_with_its_place(void)
{
    static const uint8_t identify[12] = {0, 5, 0, 6, 0, 0, 0, 0, 128, 7, 0, 0};
    for (int air = 0; air < 2; air++) {
        memory_board *board = fresh();
        uint32_t identifier;
        uint8_t data[512];
        memory_at(board, now);
        if (air) {
            memory_ble_connected(board, 0, 247);
            memory_ble_written(board, 0, identify, sizeof identify);
        } else {
            board->node.replies[0].used = true;
            board->node.replies[0].link = TEDS_LINK_NFC;
            board->node.replies[0].at = now;
            board->node.nfc.reply = &board->node.replies[0];
            board->node.nfc.answered = true;
        }
        for (uint8_t i = 0; i < TEDS_REPLIES; i++) {
            now += MS;
            in(board, TO_NODE + i, "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
            CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10, "an answer begins");
            CHECK(board->node.nfc.answered == (!air && i + 1 < TEDS_REPLIES), "the tag's, after %u", i + 1u);
        }
        CHECK(memory_ble_notify(board, 0, data) == 0, "nothing for the connection");
        memory_free(board);
    }
}

/* What Identify says changes while an answer to everyone is under way: it is not continued with other octets. */
static void an_answer_to_everyone_is_of_one_moment(void)
{
    static const uint8_t command[7] = {0, 0, 128, 10, 0, 1, 0x55};
    static uint8_t reply[TEDS_MAX_MESSAGE];
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    in(board, 0x18DBFFF3u, "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
    now += 50 * MS;
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10, "it begins");
    CHECK(memory_handle(board, 1, TEDS_AT_NFC, true, command, 7, reply) == 3 && reply[0] == 1, "128.10 at the reader");
    in(board, TO_NODE + 2, "\x30\x00\x00", 3, false);
    CHECK(silent(board), "it is not continued");
    memory_free(board);
}

/* Everyone's question beside a station's own: its answer comes first. */
static void everyone_waits_for_a_station_s_own_answer(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    asks_for_much(board);
    (void)out(board, &identifier, data);
    rest_of_question(board);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10 && data[2] == 0x05, "its answer begins");
    in(board, 0x18DBFFF1u, "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
    now += 60 * MS;
    CHECK(silent(board), "everyone's waits");
    in(board, TO_NODE, "\x30\x00\x00", 3, false);
    for (int frames = 0; frames < 35; frames++) {
        CHECK(out(board, &identifier, data) == 8 && data[0] >> 4 == 2, "the rest of its answer");
    }
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10 && data[2] == 0x2a, "then everyone's");
    memory_free(board);
}

/* 128.10, and its station asks on before the reply was fetched: the node has moved, and is at the old address no more. */
static void who_asks_on_after_a_move_asks_nobody(void)
{
    memory_board *board = fresh();
    in(board, TO_NODE, "\x00\x08\x2a\x00\x00\x80\x0a\x00\x01\x55\xcc\xcc", 12, true);
    in(board, TO_NODE, "\x07\x2b\x00\x00\x80\x07\x00\x00", 8, false);
    CHECK(silent(board), "nobody");
    CHECK(address_of(board) == 0x55, "it is at %02x", address_of(board));
    memory_free(board);
}

/* The same, and another station takes the line whose reply nobody took up: it is not answered at the old address. */
static void who_takes_the_line_of_a_move_asks_nobody(void)
{
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    has_session(board, 0, 0xF1);
    has_session(board, 1, 0xF2);
    CHECK(is_answered(board, 0xF1) && is_answered(board, 0xF2), "their lines");
    in(board, TO_NODE + 2, "\x10\x0c\x05\x00\x00\x01\x02\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "a long question");
    in(board, TO_NODE + 2, "\x21\x05\x80\x00\x00\x00\x00\xcc", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10, "its answer begins");
    board->node.can.moves_to = 0x55; /* as if it were that of a sealed 128.10 whose session has ended since */
    board->node.can.moves_link = 0xF3;
    in(board, TO_NODE + 3, "\x14\x00\x05\x00\x00\x01\x03\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "another's long question comes in");
    now += 99 * MS;
    in(board, TO_NODE + 4, "\x07\x2b\x00\x00\x80\x07\x00\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && identifier == (0x18DAF500u | OWN) && data[5] == 17, "it may yet be taken up");
    CHECK(address_of(board) == OWN, "so the node stays");
    now += MS;
    in(board, TO_NODE + 4, "\x07\x2b\x00\x00\x80\x07\x00\x00", 8, false);
    CHECK(address_of(board) == 0x55, "it has moved, to %02x", address_of(board));
    CHECK(silent(board), "nobody answers for the old address");
    memory_free(board);
}

static void a_move_waits_for_its_own_reply(void)
{
    static const uint8_t command[7] = {0, 0, 128, 10, 0, 1, 0x55};
    static uint8_t reply[TEDS_MAX_MESSAGE];
    memory_board *board = fresh();
    CHECK(memory_handle(board, 1, TEDS_AT_NFC, true, command, 7, reply) == 3, "128.10 at the reader");
    memory_reply_left(board, 0xF1);
    memory_lost(board, 0xF2);
    CHECK(address_of(board) == OWN, "others' replies and links are not its own");
    memory_reply_left(board, 1);
    CHECK(address_of(board) == 0x55, "its reply has left");
    memory_free(board);
}

/* Nodes that start together without randomness do not speak together: each waits for as long as its UUID says. */
static void a_chip_without_randomness_waits_by_its_uuid(void)
{
    uint64_t waits[2][2];
    for (uint8_t i = 0; i < 2; i++) {
        const uint8_t uuid[10] = {1, 2, 3, 4, 5, 6, 7, 8, 9, (uint8_t)(10 + i)};
        memory_board *board = fresh();
        memcpy(board->node.identity.uuid, uuid, sizeof uuid);
        memory_chip_fails(board, 1);
        memory_at(board, now);
        teds_can_start(&board->node, now);
        waits[i][0] = memory_poll(board) - now;
        memory_chip_fails(board, 1);
        in(board, 0x18DBFFF1u, "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
        waits[i][1] = board->node.lines[0].asked_due - now;
        CHECK(waits[i][0] > 0 && waits[i][0] <= 500 * MS, "an Announce after %u ms", (unsigned)(waits[i][0] / MS));
        CHECK(waits[i][1] > 0 && waits[i][1] <= 50 * MS, "an answer after %u ms", (unsigned)(waits[i][1] / MS));
        memory_free(board);
    }
    CHECK(waits[0][0] != waits[1][0] && waits[0][1] != waits[1][1], "each its own");
}

/* An Announce proves nothing, and each move ends sessions: three are immediate, then each waits twice as long as before. */
static void forged_announces_move_a_node_less_and_less(void)
{
    static const uint8_t waits[] = {1, 2, 4, 8, 16, 32, 60, 60};
    static const char forged[] = "\x01\x00\x00\x00\x00\x01\x00\x00";
    memory_board *board = fresh();
    unsigned moves = 0;
    uint32_t identifier;
    uint8_t before, data[64];
    for (unsigned i = 0; i < 12; i++) {
        before = address_of(board);
        in(board, 0x1CFF0000u | before, forged, 8, false);
        (void)memory_poll(board);
        moves += address_of(board) != before;
        now += 250 * MS;
    }
    CHECK(moves == 4, "%u moves in 3 s: three, and one after 1 s", moves);
    now += 2000 * MS;
    memory_at(board, now);
    (void)memory_poll(board);
    for (size_t i = 2; i < sizeof waits; i++) {
        before = address_of(board);
        in(board, 0x1CFF0000u | before, forged, 8, false);
        now += 100 * MS;
        in(board, 0x1CFF0000u | before, forged, 8, false);
        now += (waits[i] * UINT64_C(1000) - 101) * MS;
        while (out(board, &identifier, data) >= 0) {
        }
        CHECK(address_of(board) == before && memory_poll(board) == now + MS, "move %u: it stays for %u s", (unsigned)i, waits[i]);
        now += MS;
        memory_at(board, now);
        (void)memory_poll(board);
        CHECK(address_of(board) != before, "move %u", (unsigned)i);
    }
    now += 599999 * MS;
    before = address_of(board);
    in(board, 0x1CFF0000u | before, "\x01\x00\xff\xff\xff\xff\x00\x00", 8, false);
    now += 600000 * MS;
    for (unsigned i = 0; i < 4; i++) {
        before = address_of(board);
        in(board, 0x1CFF0000u | before, forged, 8, false);
        CHECK((address_of(board) != before) == (i < 3), "after ten minutes without a conflict, move %u", i);
    }
    memory_free(board);
}

/* A conflict, and a refusal that waits, are of the address at which they came. */
static void what_waits_at_an_address_goes_with_it(void)
{
    static const char forged[] = "\x01\x00\x00\x00\x00\x01\x00\x00";
    memory_board *board = fresh();
    uint32_t identifier;
    uint8_t data[64];
    for (unsigned i = 0; i < 4; i++) {
        in(board, 0x1CFF0000u | address_of(board), forged, 8, false);
    }
    CHECK(board->node.can.gives_up, "the fourth move waits for a second");
    memory_move(board, 0x55);
    now += 1500 * MS;
    while (out(board, &identifier, data) >= 0) {
    }
    CHECK(address_of(board) == 0x55, "nobody claimed the new one: it is at %02x", address_of(board));
    memory_free(board);
    board = fresh();
    has_session(board, 0, 0xF1);
    has_session(board, 1, 0xF2);
    CHECK(is_answered(board, 0xF1) && is_answered(board, 0xF2), "their lines");
    in(board, TO_NODE + 2, "\x14\x00\x05\x00\x00\x01\x03\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x30, "a long question comes in");
    in(board, TO_NODE + 3, "\x07\x2a\x00\x00\x80\x07\x00\x00", 8, false);
    CHECK(out(board, &identifier, data) == 8 && data[0] == 0x10, "an answer begins");
    in(board, TO_NODE + 4, "\x07\x2c\x00\x00\x80\x07\x00\x00", 8, false);
    memory_move(board, 0x55);
    CHECK(silent(board), "who was refused at the old address hears nothing from the new one");
    memory_free(board);
}

static void an_announce_that_is_none_moves_nobody(void)
{
    static const struct {
        const char *octets;
        uint8_t length;
    } rows[] = {
        {"\x01\x00\x00\x00\x00\x01\x00", 7},
        {"\x02\x00\x00\x00\x00\x01\x00\x00", 8},
        {"\x01\x03\x00\x00\x00\x01\x00\x00", 8},
    };
    memory_board *board = fresh();
    uint8_t own[8] = {1, 0};
    teds_put32(own + 2, teds_crc32(0, (const uint8_t *)"\x01\x02\x03\x04\x05\x06\x07\x08\x09\x0a", 10));
    in(board, 0x1CFF0000u | OWN, (const char *)own, 8, false); /* its own, given back, or its twin */
    for (size_t i = 0; i < sizeof rows / sizeof rows[0]; i++) {
        in(board, 0x1CFF0000u | OWN, rows[i].octets, rows[i].length, false);
    }
    now += 100 * MS;
    CHECK(silent(board) && address_of(board) == OWN, "it stays, and says nothing");
    for (uint32_t address = 1; address <= 239; address++) {
        in(board, 0x18DAF100u | address, FOR_NOBODY, 3, false);
    }
    in(board, 0x1CFF0000u | OWN, "\x01\x00\x00\x00\x00\x01\x00\x00", 8, false);
    CHECK(address_of(board) == OWN, "where every address is taken it stays");
    memory_free(board);
}

static void a_board_that_cannot_be_is_told_at_the_start(void)
{
    memory_board *board = fresh();
    const teds_port good = board->port;
    const struct {
        uint8_t unit;
        uint32_t slot, identity;
        bool antenna;
        uint16_t ndef;
        int result;
    } rows[] = {
        {8, good.slot_octets, 192, true, 0, 0},         {0, good.slot_octets, 256, false, 0, TEDS_E_USAGE},
        {33, good.slot_octets, 256, false, 0, TEDS_E_USAGE}, {12, good.slot_octets, 256, false, 0, TEDS_E_USAGE},
        {8, TEDS_STAGING + 255, 256, false, 0, TEDS_E_USAGE}, {8, good.slot_octets, 191, false, 0, TEDS_E_USAGE},
        {8, good.slot_octets, 256, true, 159, TEDS_E_USAGE}, {8, good.slot_octets, 256, true, 160, 0},
        {8, good.slot_octets, 256, false, 159, 0},      {64, good.slot_octets, 256, false, 0, TEDS_E_USAGE},
    };
    for (size_t i = 0; i < sizeof rows / sizeof rows[0]; i++) {
        board->port.unit = rows[i].unit;
        board->port.slot_octets = rows[i].slot;
        board->port.identity_octets = rows[i].identity;
        board->config.nfc.present = rows[i].antenna;
        board->config.nfc.max_ndef = rows[i].ndef;
        CHECK(memory_start(board) == rows[i].result, "row %u", (unsigned)i);
    }
    memory_free(board);
}

static void a_key_that_cannot_be_made_ahead_is_made_when_it_is_due(void)
{
    memory_board *board = fresh();
    memory_chip_fails(board, 1);
    CHECK(!teds_idle_work(&board->node), "nothing was done");
    memory_chip_fails(board, 0);
    CHECK(teds_idle_work(&board->node), "made");
    CHECK(!teds_idle_work(&board->node), "one is enough");
    CHECK(teds_node_missed(&board->node) == 0, "no data message was missed");
    memory_free(board);
}

/* What the chip's stack tells of connections that are none. */
static void a_connection_that_is_none_does_nothing(void)
{
    static const uint8_t begins[10] = {0, 5, 0, 8, 0, 0, 0, 0, 128, 7}, goes_on[10] = {0, 6, 0, 8, 0, 4, 0, 0, 0, 0};
    memory_board *board = fresh();
    uint8_t data[512];
    memory_ble_connected(board, TEDS_BLE_CONNECTIONS, 247);
    memory_ble_connected(board, 255, 247);
    memory_ble_mtu(board, 1, 247);
    memory_ble_disconnected(board, 1);
    memory_ble_hears(board, 1, true);
    memory_ble_written(board, 1, begins, sizeof begins);
    memory_ble_driven(board, 1, begins, sizeof begins);
    CHECK(!memory_ble_drops(board, 1) && memory_ble_notify(board, 1, data) == 0, "not there");
    memory_ble_connected(board, 0, 10);
    memory_ble_mtu(board, 0, 5);
    memory_ble_written(board, 0, begins, sizeof begins);
    memory_ble_written(board, 0, goes_on, sizeof goes_on);
    CHECK(memory_ble_notify(board, 0, data) == 0, "a piece of another command drops what is held");
    memory_ble_driven(board, 0, begins, 0);
    memory_ble_driven(board, 0, goes_on + 1, 2);
    memory_at(board, now);
    CHECK(!memory_ble_advertises(board), "nobody tapped it");
    teds_ble_tapped(&board->node);
    now += 59999 * MS;
    memory_at(board, now);
    CHECK(memory_ble_advertises(board) && memory_ble_drops(board, 0), "for a minute; a stranger for 10 s");
    now += MS;
    memory_at(board, now);
    CHECK(!memory_ble_advertises(board), "a minute is over");
    memory_free(board);
}

/* What a tag is told that no reader says. */
static void a_tag_bears_what_no_reader_says(void)
{
    memory_board *board = fresh();
    uint8_t data[256], much[300] = {2};
    size_t length;
    memory_nfc(board, 4, 15, 9999);
    (void)memory_start(board);
    CHECK(memory_nfc_frame(board, (const uint8_t *)"\xe0", 1, data) == 5, "a RATS without its parameter");
    CHECK(memory_nfc_frame(board, much, 0, data) == 0 && memory_nfc_frame(board, much, 257, data) == 0, "no block");
    CHECK(!memory_nfc_written(board, much, 0), "an empty message");
    CHECK(!memory_nfc_written(board, data, TEDS_MAX_NDEF + 1), "one that is too long");
    (void)teds_nfc_message(&board->node, &length);
    CHECK(length > 0, "it shows the initial message still");
    memory_free(board);
}

int main(void)
{
    a_long_answer_waits_for_flow_control();
    what_nobody_takes_up_is_given_up();
    a_broken_question_is_dropped();
    what_cannot_be_taken_is_refused_by_one_frame();
    a_long_length_that_is_short_is_nobodys();
    frames_may_come_twice();
    a_repetition_while_the_reply_is_under_way_gets_it_again();
    everyone_is_answered_after_a_wait();
    everyone_is_answered_in_time_though_the_last_answer_waits();
    more_long_answers_than_room_cut_the_oldest_short();
    the_old_slot_is_erased_when_the_reply_has_left();
    the_old_slot_is_erased_when_the_reader_is_quiet();
    a_new_address_counts_though_its_reply_is_lost();
    a_board_without_can_has_no_address();
    after_bus_off_it_is_silent_for_longer_and_longer();
    nothing_from_before_a_loss_is_left();
    nodes_that_meet_sort_themselves_out();
    a_classic_frame_has_eight_octets_at_most();
    what_is_not_for_this_node_is_left_alone();
    no_frame_of_a_message_is_shorter_but_the_last();
    one_station_does_not_cut_into_another_s_question();
    any_flow_control_is_borne();
    an_answer_to_everyone_gives_way();
    what_strangers_ask_takes_no_place_of_a_session();
    what_waits_to_leave_is_due_now();
    what_leaves_without_a_line_is_due_now();
    no_announce_from_before_a_bus_off_is_left();
    the_end_of_a_session_is_due();
    what_waits_for_its_station_is_wiped_after_a_minute();
    a_station_without_a_line_is_refused();
    a_station_without_a_line_is_refused_in_its_form();
    a_long_request_that_gives_way_is_not_asked_on();
    one_station_does_not_hold_the_place_of_long_requests();
    a_reply_that_is_another_link_s_is_nobodys();
    a_reply_of_the_tag_and_of_the_air_goes_with_its_place();
    an_answer_to_everyone_is_of_one_moment();
    everyone_waits_for_a_station_s_own_answer();
    who_asks_on_after_a_move_asks_nobody();
    who_takes_the_line_of_a_move_asks_nobody();
    a_move_waits_for_its_own_reply();
    a_chip_without_randomness_waits_by_its_uuid();
    forged_announces_move_a_node_less_and_less();
    what_waits_at_an_address_goes_with_it();
    an_announce_that_is_none_moves_nobody();
    a_board_that_cannot_be_is_told_at_the_start();
    a_key_that_cannot_be_made_ahead_is_made_when_it_is_due();
    a_connection_that_is_none_does_nothing();
    a_tag_bears_what_no_reader_says();
    return ENDED("isotp");
}
