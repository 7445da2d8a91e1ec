/* SPDX-License-Identifier: Apache-2.0 */
/* The board's TransducerChannels. A place is an index of the port's table, and a channel's bit in claims. */
#ifndef TEDS_SRC_TRANSDUCERS_H
#define TEDS_SRC_TRANSDUCERS_H

#include "inside.h"

#if TEDS_OPERATION
static inline const teds_channel *teds_channel_at(const teds_node *node, int place)
{
    return &node->port->channels[place];
}
static inline bool teds_is_actuator(const teds_node *node, int place)
{
    return teds_channel_at(node, place)->kind == TEDS_ACTUATOR;
}

/* True if this build supports the board's table. */
bool teds_channels_good(const teds_port *port);

/* Place of a channel by its number; -1: there is none. */
int teds_place_of(const teds_node *node, uint8_t channel);

/* Return 0 for a list of 1 to `most` channel numbers, none 0 and none twice; otherwise a reason negated. */
int teds_channel_list(const uint8_t *octets, size_t length, size_t most);

bool teds_has_fault(const teds_node *node, int place);
bool teds_is_testing(const teds_node *node, int place);
teds_power teds_power_now(const teds_node *node);

/* Read a data set, at the tick for a sensor; false: it is not valid, or the channel is in a self-test or faulty. */
bool teds_read_channel(const teds_node *node, int place, uint64_t tick, uint8_t *out);

/* Bring an actuator to its safe state and disarm its hardware timer. */
void teds_go_safe(teds_node *node, int place);

/* True if the stored TEDS describes this channel as the firmware does; `period`: its sampling period in ns (0: none).
 * */
int teds_channel_fits(const teds_node *node, int place, uint64_t *period);
#endif

#endif
