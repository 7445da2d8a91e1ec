/* SPDX-License-Identifier: Apache-2.0 */
/* The main loop of a node on CAN. Complete as it is. */
#include "board.h"

static teds_node node; /* 12 KB with the default sizes; nothing else is allocated */
static teds_port port;
static teds_config config;

int main(void)
{
    teds_can_frame frame;
    uint64_t tick, next;
    if (board_start(&port, &config) != 0 || teds_node_init(&node, &config, &port) != 0) {
        return 1; /* a real board shows the error and stops; a watchdog would only repeat it */
    }
    teds_can_start(&node, board_now());
    for (;;) {
        bool idle = true;
        while (board_frame_came(&frame, &tick)) {
            teds_can_rx(&node, &frame, tick);
            idle = false;
        }
        if (board_was_bus_off()) {
            teds_node_bus_off(&node);
            teds_can_start(&node, board_now());
        }
        if (board_was_pressed()) {
            teds_can_pressed(&node, board_now());
        }
        if (board_reset_was_held()) {
            (void)teds_node_reset_by_hand(&node);
        }
        next = teds_node_poll(&node, board_now()); /* leases, samples, time-outs, erasing */
        while (board_may_send() && teds_can_tx(&node, &frame, board_now())) {
            board_send(&frame);
            idle = false;
        }
        if (idle && teds_idle_work(&node)) {
            continue; /* it took a P-256 multiplication: look at the ring before sleeping */
        }
        board_sleep(next);
    }
}
