/* SPDX-License-Identifier: Apache-2.0 */
/* The port's clock: ns since the start, never backwards. */
#ifndef TEDS_SRC_CLOCK_H
#define TEDS_SRC_CLOCK_H

#include "inside.h"

uint64_t teds_now(const teds_node *node);

/* `due` becomes `at` if that is earlier. */
void teds_sooner(uint64_t *due, uint64_t at);

#endif
