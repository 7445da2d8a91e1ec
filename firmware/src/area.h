/* SPDX-License-Identifier: Apache-2.0 */
/* Areas of flash: written once from front to back in whole units, with a CRC-32 as the last four octets; read anywhere. */
#ifndef TEDS_SRC_AREA_H
#define TEDS_SRC_AREA_H

#include "inside.h"

#define TEDS_UNIT_MOST 32u
/* offset of the form's version; the octets before it, a slot's length and the CRC are the same in every form */
#define TEDS_FORM_AT 4u

/* An area that is being written. Set port and area, and the rest to 0. A failure is remembered: check it once, at the
 * end. */
typedef struct teds_writing {
    const teds_port *port;
    int area, failed;
    uint32_t at, crc;
    uint8_t fill, buffer[TEDS_UNIT_MOST];
} teds_writing;

void teds_area_put(teds_writing *into, const void *data, size_t length);

/* Put zeros up to this offset. */
void teds_area_pad(teds_writing *into, uint32_t until);

/* Pad to `total`, whose last four octets are the CRC; return any earlier failure. */
int teds_area_close(teds_writing *into, uint32_t total);

int teds_area_read(const teds_port *port, int area, uint32_t at, void *out, size_t length);

/* Read the first `octets` of an area: `blank` if all of them are (the rest of a torn slot may be anywhere), and their
 * CRC-32. */
int teds_area_scan(const teds_port *port, int area, uint32_t octets, bool *blank, uint32_t *crc);

/* Compare the CRC-32 of the first `total` - 4 octets with the 4 that follow. */
int teds_area_crc_good(const teds_port *port, int area, uint32_t total, bool *good);

#endif
