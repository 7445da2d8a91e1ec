/* SPDX-License-Identifier: Apache-2.0 */
/* The board's TransducerChannels, by their index in the port's table: kind, value and safe state; and whether the
 * stored TransducerChannel TEDS describes this hardware (operation.md, 1). */
#include "transducers.h"
#include "clock.h"
#include "datasheet.h"
#include "teds_source.h"
#include "inside.h"

#if TEDS_OPERATION

bool teds_channels_good(const teds_port *port)
{
    size_t events = 0;
    if (port->channel_count > TEDS_CHANNELS) {
        return false;
    }
    for (size_t i = 0; i < port->channel_count; i++) {
        const teds_channel *own = &port->channels[i];
        if (own->number == 0 || (i > 0 && own->number <= own[-1].number) || own->octets == 0 ||
            own->kind > TEDS_EVENT_SENSOR) {
            return false;
        }
        events += own->kind == TEDS_EVENT_SENSOR ? 1 : 0;
        if (own->kind == TEDS_EVENT_SENSOR && own->octets > TEDS_EVENT_OCTETS) {
            return false;
        }
    }
    return events <= TEDS_EVENT_CHANNELS;
}

int teds_place_of(const teds_node *node, uint8_t channel)
{
    for (size_t i = 0; i < node->port->channel_count; i++) {
        if (node->port->channels[i].number == channel) {
            return (int)i;
        }
    }
    return -1;
}

int teds_channel_list(const uint8_t *octets, size_t length, size_t most)
{
    if (length < 1 || length > most) {
        return -TEDS_BAD_FORM;
    }
    for (size_t i = 0; i < length; i++) {
        if (octets[i] == 0 || memchr(octets, octets[i], i) != NULL) {
            return -TEDS_BAD_FORM;
        }
    }
    return 0;
}

bool teds_has_fault(const teds_node *node, int place)
{
    return node->port->fault != NULL && node->port->fault(node->port->user, teds_channel_at(node, place)->number);
}

bool teds_is_testing(const teds_node *node, int place)
{
    return node->port->testing != NULL && node->port->testing(node->port->user, teds_channel_at(node, place)->number);
}

teds_power teds_power_now(const teds_node *node)
{
    teds_power power = {0, 0xFF, 0xFFFF, 0x7FFF, 0x7F};
    if (node->port->power != NULL) {
        node->port->power(node->port->user, &power);
    }
    return power;
}

bool teds_read_channel(const teds_node *node, int place, uint64_t tick, uint8_t *out)
{
    const teds_port *port = node->port;
    uint8_t number = teds_channel_at(node, place)->number;
    memset(out, 0, teds_channel_at(node, place)->octets);
    if (teds_is_actuator(node, place)) {
        if (port->set_point != NULL) {
            port->set_point(port->user, number, out);
        }
        return true;
    }
    return port->sample != NULL && port->sample(port->user, number, tick, out) && !teds_is_testing(node, place) &&
           !teds_has_fault(node, place);
}

void teds_go_safe(teds_node *node, int place)
{
    const teds_port *port = node->port;
    if (port->arm != NULL) {
        port->arm(port->user, teds_channel_at(node, place)->number, 0);
    }
    if (port->safe != NULL) {
        port->safe(port->user, teds_channel_at(node, place)->number);
    }
    node->safe |= UINT32_C(1) << place;
}

/* -- facts of the stored TransducerChannel TEDS -------------------------------------------------------------------- */

/* Float32 seconds as ns, less 1 ppm; 0 if it is not a positive number. */
static uint64_t decode_period(uint32_t bits)
{
    uint32_t exponent = bits >> 23 & 255;
    uint64_t ns = (uint64_t)((bits & 0x7FFFFF) | 0x800000) * TEDS_SECOND;
    if (bits >> 31 != 0 || exponent == 0 || (exponent == 255 && (bits & 0x7FFFFF) != 0)) {
        return 0;
    }
    if (exponent >= 127 + 20) { /* longer periods count as a million seconds */
        return 1000000 * TEDS_SECOND;
    }
    ns = exponent >= 150 ? ns << (exponent - 150) : 150 - exponent < 64 ? ns >> (150 - exponent) : 0;
    return ns - (ns + 999999) / 1000000;
}

int teds_channel_fits(const teds_node *node, int place, uint64_t *period)
{
    const teds_channel *own = teds_channel_at(node, place);
    teds_walk in = {.node = node, .at = 10, .width = 1};
    uint32_t value, length, kind = UINT32_MAX, model = UINT32_MAX, octets = UINT32_MAX, halt = UINT32_MAX;
    uint8_t type;
    *period = 0;
    if (!teds_find(node, (uint16_t)(own->number << 8 | 3), &in.source) || in.source.length < 12) {
        return 0;
    }
    in.end = in.source.length - 2;
    in.at = teds_number_at(&in, 5, 1) == 5 ? 11 : 10;
    in.width = teds_number_at(&in, in.at - 1, 1);
    in.width = in.width >= 1 && in.width <= 4 ? in.width : 1;
    while (teds_next_tuple(&in, &type, &value, &length)) {
        if (type == 11) {
            kind = teds_number_at(&in, value, length);
        } else if (type == 36) {
            halt = teds_number_at(&in, value, length);
        } else if (type == 23 && length == 4) {
            *period = decode_period(teds_number_at(&in, value, 4));
        } else if (type == 18) {
            teds_walk within = in;
            within.at = value;
            within.end = value + length;
            while (teds_next_tuple(&within, &type, &value, &length)) {
                model = type == 40 ? teds_number_at(&in, value, length) : model;
                octets = type == 41 ? teds_number_at(&in, value, length) : octets;
            }
        }
    }
    if (own->kind == TEDS_ACTUATOR && halt != UINT32_MAX && halt != own->halt) {
        return 0;
    }
    return kind == own->kind && model == own->model && octets == own->octets;
}

#else
typedef int teds_transducers_is_left_out;
#endif
