/* SPDX-License-Identifier: Apache-2.0 */
/* The firmware that is running, and a board that shows which one it is. */
#ifndef TEDS_SRC_ABOUT_H
#define TEDS_SRC_ABOUT_H

#include "inside.h"

/* Read the port's report; false if it has none. The flags stay in the node. */
bool teds_firmware_read(teds_node *node, teds_firmware *out);

teds_handler teds_about, teds_locate;

/* Stop blinking when its time is over; return when the next thing is due. */
uint64_t teds_locate_poll(teds_node *node, uint64_t now);

#endif
