/* SPDX-License-Identifier: Apache-2.0 */
/* The serial line of qemu's mps2-an386 with packets on it, framed as SLIP does (RFC 1055): a kind, then octets.
 *
 *   in   FRAME id4 fd data…   a CAN frame            POWER seed32 uuid10   power comes: randomness and identity
 *   out  FRAME id4 fd data…   a CAN frame            READY                 on the bus
 *   in   STACK                how much stack         out STACK stack4 node4
 */
#ifndef TEDS_SERIAL_H
#define TEDS_SERIAL_H

#include <stddef.h>
#include <stdint.h>

enum { SERIAL_FRAME = 0, SERIAL_POWER = 1, SERIAL_READY = 2, SERIAL_STACK = 3 };

void serial_open(void);
void serial_send(uint8_t kind, const uint8_t *octets, size_t length);
/* A whole packet that has come: its length, 0: none yet. `*packet` holds until the next call. */
size_t serial_receive(const uint8_t **packet);

#endif
