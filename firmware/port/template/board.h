/* SPDX-License-Identifier: Apache-2.0 */
/* What the loop in main.c asks of a board; board.c is the part to write. */
#ifndef BOARD_H
#define BOARD_H

#include "teds/node.h"

/* Start clock, flash, randomness and CAN controller; fill in port and configuration. 0, or -1. */
int board_start(teds_port *port, teds_config *config);

/* ns since the start: the port's clock. */
uint64_t board_now(void);

/* Take the oldest frame out of the ring that the receive interrupt fills, and the time of its end; false: it is empty. */
bool board_frame_came(teds_can_frame *frame, uint64_t *tick);

/* True if the controller's one mailbox is free, so that no reply waits behind more than one data frame. */
bool board_may_send(void);
void board_send(const teds_can_frame *frame);

/* True once after the controller went off the bus; it has been restarted. */
bool board_was_bus_off(void);

/* True once when a button was pressed for a short time. */
bool board_was_pressed(void);

/* True once when the reset button was held for 5 s. */
bool board_reset_was_held(void);

/* Sleep until `until`, or until a frame came or the mailbox is free again, whichever is first. `until` may be past while
 * the mailbox is taken: then 0.2 ms at most. */
void board_sleep(uint64_t until);

#endif
