/* SPDX-License-Identifier: Apache-2.0 */
#include "clock.h"

uint64_t teds_now(const teds_node *node)
{
    return node->port->now(node->port->user);
}

void teds_sooner(uint64_t *due, uint64_t at)
{
    if (at < *due) {
        *due = at;
    }
}
