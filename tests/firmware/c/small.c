/* SPDX-License-Identifier: Apache-2.0 */
/* A board that saves a stored reply: as many places as sessions. While both are sessions' a stranger is told so. */
#include "check.h"
#include "inside.h"
#include "memory.h"

#define OWN 0x21u

static int draw(char kind, uint8_t *out, size_t length)
{
    memset(out, 0, length);
    if (kind != 'n') {
        out[31] = 9;
    }
    return 0;
}

/* The single frame that answers a plain Identify from this station, its octets; 0: none came. */
static int identified(memory_board *board, uint8_t station, uint8_t data[64])
{
    static const uint8_t identify[8] = {7, 5, 0, 0, TEDS_CLASS_SECURITY, TEDS_IDENTIFY, 0, 0};
    uint32_t identifier;
    bool fd;
    memory_can_rx(board, 0x18DA0000u | OWN << 8 | station, identify, sizeof identify, false);
    (void)memory_poll(board);
    return memory_can_tx(board, &identifier, data, &fd) > 0 &&
           identifier == (0x18DA0000u | (uint32_t)station << 8 | OWN);
}

int main(void)
{
    static const uint8_t uuid[10] = {1, 2, 3}, none[65] = {0};
    memory_board *board = memory_new(uuid, 8, 0xFF, draw);
    uint8_t data[64];
    CHECK(memory_start(board) == 0 && memory_put(board, 0, OWN, 0, 0, none, none, none, none, 0) == 0, "it starts");
    for (uint8_t i = 0; i < 2; i++) {
        CHECK(identified(board, (uint8_t)(0xF1 + i), data) && data[0] == 0x10, "the first frame of an answer");
        board->node.sessions[i].used = true;
        board->node.sessions[i].link = (teds_link)(0xF1 + i);
    }
    CHECK(identified(board, 0xF3, data) && memcmp(data, "\x05\x05\x00\x00\x01\x11", 6) == 0, "17, in one frame");
    CHECK(board->node.sessions[0].used && board->node.sessions[1].used, "no session ends by it");
    CHECK(board->node.replies[0].link == 0xF1 && board->node.replies[1].link == 0xF2, "nor goes a stored reply");
    CHECK(identified(board, 0xF2, data) && data[0] == 0x10, "a session's own station is answered");
    teds_node_link_lost(&board->node, 0xF2);
    CHECK(identified(board, 0xF3, data) && data[0] == 0x10, "and the stranger, when a place is free");
    memory_free(board);
    return ENDED("small");
}
