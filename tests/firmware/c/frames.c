/* ISO-TP, Announce and Claim as the bus sees them: frames in, frames out, time in the test's hands. */
#include "check.h"
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
            CHECK(board->node.can.rx_at <= sizeof board->node.can.rx, "%u octets held", board->node.can.rx_at);
            if (board->node.can.rx_at > sizeof board->node.can.rx) {
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
            board->node.can.lines[0].out_state = TEDS_OUT_FIRST; /* as if it were still leaving */
            board->node.can.lines[0].out_reply = (int8_t)i;
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
    teds_node_bus_off(&board->node);
    teds_can_start(&board->node, now);
    now += 1000 * MS;
    CHECK(identified(board), "a minute on the bus, and it begins with a second again");
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
    after_bus_off_it_is_silent_for_longer_and_longer();
    nodes_that_meet_sort_themselves_out();
    a_classic_frame_has_eight_octets_at_most();
    return ENDED("isotp");
}
