/* SPDX-License-Identifier: Apache-2.0 */
/* The running firmware, and Locate. */
#ifndef TEDS_SRC_ABOUT_H
#define TEDS_SRC_ABOUT_H

#include "inside.h"

/* Read the port's report; false if it has none. The flags are kept in the node. */
bool teds_firmware_read(teds_node *node, teds_firmware *out);

teds_handler teds_about, teds_locate;

/* Stop blinking when its time is over; return the time of the next action. */
uint64_t teds_locate_poll(teds_node *node, uint64_t now);

#endif
