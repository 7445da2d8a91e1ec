/* SPDX-License-Identifier: Apache-2.0 */
/* Commands: permission, routing, and short handlers. Implements teds_node_handle of teds/node.h: a frame in, its reply
 * out. */
#ifndef TEDS_SRC_COMMANDS_H
#define TEDS_SRC_COMMANDS_H

#include "inside.h"

#endif
