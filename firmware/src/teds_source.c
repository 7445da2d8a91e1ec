/* SPDX-License-Identifier: Apache-2.0 */
/* Reading one TEDS from flash, from RAM, or generated (the initial Security TEDS); and its tuples. */
#include "teds_source.h"
#include "area.h"
#include "security_teds.h"
#include "inside.h"

#define PIECE 64u

int teds_source_read(const teds_node *node, const teds_source *source, uint32_t at, uint8_t *out, size_t length)
{
    if (source->unreadable) {
        return TEDS_E_FLASH;
    }
    if (source->initial) {
        uint8_t teds[TEDS_INITIAL_OCTETS];
        teds_put_initial(node, teds);
        memcpy(out, teds + at, length);
        return 0;
    }
    if (source->octets != NULL) {
        memcpy(out, source->octets + at, length);
        return 0;
    }
    return teds_area_read(node->port, node->slot, source->at + at, out, length);
}

int teds_source_hash(const teds_node *node, const teds_source *source, uint8_t out[32])
{
    const teds_port *port = node->port;
    uint8_t piece[PIECE];
    teds_sha256 state;
    int failed = 0;
    port->sha256_start(port->user, &state);
    for (uint32_t at = 0; at < source->length && !failed; at += sizeof piece) {
        size_t length = source->length - at < sizeof piece ? source->length - at : sizeof piece;
        failed = teds_source_read(node, source, at, piece, length);
        port->sha256_update(port->user, &state, piece, length);
    }
    port->sha256_finish(port->user, &state, out);
    return failed;
}

/* -- tuples -------------------------------------------------------------------------------------------------------- */

/* UINT32_MAX: it does not fit, or cannot be read. */
static uint32_t read_number(const teds_walk *in, uint32_t at, uint32_t octets)
{
    uint32_t value = 0;
    for (; octets > 0; octets--, at++) {
        uint8_t octet;
        if (value > 0xFFFFFF || at >= in->source.length ||
            teds_source_read(in->node, &in->source, at, &octet, 1) != 0) {
            return UINT32_MAX;
        }
        value = value << 8 | octet;
    }
    return value;
}

#if TEDS_OPERATION
uint32_t teds_number_at(const teds_walk *in, uint32_t at, uint32_t octets)
{
    return octets >= 1 && octets <= 4 ? read_number(in, at, octets) : UINT32_MAX;
}
#endif

bool teds_next_tuple(teds_walk *in, uint8_t *type, uint32_t *value, uint32_t *length)
{
    if (in->at + 1 + in->width > in->end) {
        return false;
    }
    *type = (uint8_t)read_number(in, in->at, 1);
    *length = read_number(in, in->at + 1, in->width);
    *value = in->at + 1 + in->width;
    if (*length > in->end - *value) {
        return false;
    }
    in->at = *value + *length;
    return true;
}
