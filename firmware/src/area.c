/* SPDX-License-Identifier: Apache-2.0 */
/* Areas of flash, written once from front to back in whole units, with a CRC-32 at the end; and reading them.
 * identity.c and slots.c define the contents. */
#include "area.h"
#include "inside.h"

#define PIECE 64u

void teds_area_put(teds_writing *into, const void *data, size_t length)
{
    const uint8_t *octets = data;
    into->crc = teds_crc32(into->crc, octets, length);
    for (size_t i = 0; i < length && !into->failed; i++) {
        into->buffer[into->fill++] = octets[i];
        if (into->fill == into->port->unit) {
            into->failed = into->port->write(into->port->user, into->area, into->at, into->buffer, into->fill);
            into->at += into->fill;
            into->fill = 0;
        }
    }
}

void teds_area_pad(teds_writing *into, uint32_t until)
{
    static const uint8_t zero = 0;
    while (into->at + into->fill < until && !into->failed) {
        teds_area_put(into, &zero, 1);
    }
}

int teds_area_close(teds_writing *into, uint32_t total)
{
    uint8_t crc[4];
    teds_area_pad(into, total - 4);
    teds_put32(crc, into->crc);
    teds_area_put(into, crc, 4);
    return into->failed;
}

int teds_area_read(const teds_port *port, int area, uint32_t at, void *out, size_t length)
{
    return port->read(port->user, area, at, out, length);
}

int teds_area_scan(const teds_port *port, int area, uint32_t octets, bool *blank, uint32_t *crc)
{
    uint8_t piece[PIECE];
    *blank = true;
    *crc = 0;
    for (uint32_t at = 0; at < octets; at += sizeof piece) {
        const size_t length = octets - at < sizeof piece ? octets - at : sizeof piece;
        if (teds_area_read(port, area, at, piece, length) != 0) {
            return TEDS_E_FLASH;
        }
        *crc = teds_crc32(*crc, piece, length);
        for (size_t i = 0; i < length; i++) {
            *blank = *blank && piece[i] == port->erased;
        }
    }
    return 0;
}

int teds_area_crc_good(const teds_port *port, int area, uint32_t total, bool *good)
{
    uint8_t last[4];
    uint32_t crc;
    bool blank;
    if (teds_area_scan(port, area, total - 4, &blank, &crc) != 0 || teds_area_read(port, area, total - 4, last, 4) != 0) {
        return TEDS_E_FLASH;
    }
    *good = teds_get32(last) == crc;
    return 0;
}
