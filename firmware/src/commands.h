/* SPDX-License-Identifier: Apache-2.0 */
/* Commands: permission, routing, and those that need little. teds_node_handle of teds/node.h is here: a frame in, its
 * reply out. */
#ifndef TEDS_SRC_COMMANDS_H
#define TEDS_SRC_COMMANDS_H

#include "inside.h"

#endif
