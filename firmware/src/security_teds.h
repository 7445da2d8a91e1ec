/* SPDX-License-Identifier: Apache-2.0 */
/* The Security TEDS as octets: its initial form, and reading a signed one. */
#ifndef TEDS_SRC_SECURITY_TEDS_H
#define TEDS_SRC_SECURITY_TEDS_H

#include "inside.h"

/* The signature fields, decoded from base64. */
enum { TEDS_SIGNATURE, TEDS_STATION, TEDS_STATION_SIGNATURE }; /* 100, 103, 104 */

/* The fields of a signed one. */
typedef struct teds_signed {
    uint8_t decoded[3][66];
    bool others;            /* 101 or 102 is not this node's own */
    uint32_t numbers[2];    /* 106 sequence, 107 key epoch */
    const uint8_t *blocks;  /* the first tuple of type 108 */
    size_t block_count;
    size_t signature_at; /* of its tuple, in the data block */
} teds_signed;

/* Read a data block; false if it is not in canonical form. Signatures are not verified here. */
bool teds_security_parse(const teds_node *node, const uint8_t *block, size_t length, teds_signed *out);

/* Return a listed block by its index: channel 2, access code 1, digest 32. */
const uint8_t *teds_listed_block(const teds_signed *teds, size_t place);

bool teds_is_listed(const teds_signed *teds, uint16_t id);

/* Write the Security TEDS of a node for which no station has signed. */
void teds_put_initial(const teds_node *node, uint8_t out[TEDS_INITIAL_OCTETS]);

/* Checksum of a TEDS whose `length` octets precede it. */
uint16_t teds_checksum(const uint8_t *octets, size_t length);

/* True if an image is valid by itself: length, checksum, and the access code in its header. */
bool teds_own_check(uint8_t code, const uint8_t *teds, size_t length);

/* RFC 3629: no overlong forms, no surrogates, nothing above U+10FFFF. */
bool teds_is_utf8(const uint8_t *text, size_t length);

#endif
