/* SPDX-License-Identifier: Apache-2.0 */
/* The commands of class 1 on TEDS: Query, Read, Write, Update. */
#ifndef TEDS_SRC_TEDS_COMMANDS_H
#define TEDS_SRC_TEDS_COMMANDS_H

#include "inside.h"

teds_handler teds_query, teds_read, teds_write, teds_update;

#endif
