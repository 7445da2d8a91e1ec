/* SPDX-License-Identifier: Apache-2.0 */
/* Octets: integers by shifts alone (any byte order of the chip), comparing and wiping secrets, CRC-32. */
#ifndef TEDS_OCTETS_H
#define TEDS_OCTETS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

/* Most significant octet first, as all numbers on the wire and in flash. */
void teds_put16(uint8_t *at, uint16_t value);
void teds_put32(uint8_t *at, uint32_t value);
void teds_put64(uint8_t *at, uint64_t value);
uint16_t teds_get16(const uint8_t *at);
uint32_t teds_get32(const uint8_t *at);
uint64_t teds_get64(const uint8_t *at);

/* Compare in constant time: for tags and keys. */
bool teds_equal(const uint8_t *a, const uint8_t *b, size_t length);

/* Overwrite a secret; compilers do not remove this, even without a later use. */
void teds_wipe(void *octets, size_t length);

/* CRC-32 of IEEE 802.3, continued: begin with 0. By nibbles: needs no table of 1 KiB, and is fast enough for 8 KiB at a
 * start. */
uint32_t teds_crc32(uint32_t crc, const uint8_t *octets, size_t length);

#endif
