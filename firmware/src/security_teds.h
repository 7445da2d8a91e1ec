/* SPDX-License-Identifier: Apache-2.0 */
/* The Security TEDS: its initial form, and reading one. */
#ifndef TEDS_SRC_SECURITY_TEDS_H
#define TEDS_SRC_SECURITY_TEDS_H

#include "inside.h"

enum { TEDS_SIGNATURE, TEDS_STATION, TEDS_STATION_SIGNATURE }; /* 100, 103, 104 */
typedef struct teds_signed {
    uint8_t decoded[3][66]; /* these fields without their base64 */
    bool others;            /* 101 or 102 is not this node's own */
    uint32_t numbers[2];    /* 106 sequence, 107 key epoch */
    const uint8_t *blocks;  /* the first tuple of type 108 */
    size_t block_count;
    size_t signature_at; /* of its tuple, in the data block */
} teds_signed;
void teds_initial(const teds_node *node, uint8_t out[TEDS_INITIAL_OCTETS]);
bool teds_security_parse(const teds_node *node, const uint8_t *block, size_t length, teds_signed *out);
uint16_t teds_checksum(const uint8_t *octets, size_t length);
bool teds_own_check(uint8_t code, const uint8_t *teds, size_t length);

#endif
