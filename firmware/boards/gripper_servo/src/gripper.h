/* SPDX-License-Identifier: Apache-2.0 */
/* A gripper on a hobby servo: its set point, its safe state and its dead-man; opening and force. */
#ifndef GRIPPER_H
#define GRIPPER_H

#include "teds/port.h"

enum { SET_POINT = 1, OPENING = 2, FORCE = 3 };

/* 0, or a negative errno where a device is not ready. The servo has no power until the first set point. */
int gripper_start(void);

/* Fill in channels and their functions. */
void gripper_fill(teds_port *port);

#endif
