/* SPDX-License-Identifier: Apache-2.0 */
/* --can: INTERFACE:CHANNEL[?key=value&…], as the station's option; udp_multicast and socketcand. */
#define _DEFAULT_SOURCE
#include "host.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* The value of `key` in a query, or `otherwise`. */
static const char *option(const char *query, const char *key, const char *otherwise, char *room, size_t octets)
{
    size_t length = strlen(key);
    while (query != NULL && *query != '\0') {
        const char *end = strchr(query, '&');
        size_t whole = end != NULL ? (size_t)(end - query) : strlen(query);
        if (whole > length && strncmp(query, key, length) == 0 && query[length] == '=' &&
            whole - length - 1 < octets) {
            memcpy(room, query + length + 1, whole - length - 1);
            room[whole - length - 1] = '\0';
            return room;
        }
        query = end != NULL ? end + 1 : NULL;
    }
    return otherwise;
}

/* The bit rates, and whether frames take their time; false after words on stderr. */
static bool read_pace(host_bus *bus, const char *query, host_pace *pace, bool paces)
{
    char rate[16], data_rate[16], form[8];
    bus->bitrate = (uint32_t)strtoul(option(query, "bitrate", "500000", rate, sizeof rate), NULL, 10);
    bus->data_bitrate = (uint32_t)strtoul(option(query, "data_bitrate", "2000000", data_rate, sizeof data_rate), NULL, 10);
    if (bus->bitrate == 0 || bus->data_bitrate == 0) {
        (void)fprintf(stderr, "--can: a bit rate is a number above 0.\n");
        return false;
    }
    if (paces || strcmp(option(query, "pace", "0", form, sizeof form), "1") == 0) {
        bus->pace = pace;
        host_pace_start(pace);
    }
    return true;
}

int host_bus_open(host_bus *bus, const char *spec, bool fd, host_pace *pace, bool paces)
{
    char place[256], host[128], port[16], hops[16], form[8];
    const char *query = strchr(spec, '?');
    size_t length = query != NULL ? (size_t)(query - spec) : strlen(spec);
    char *channel;
    memset(bus, 0, sizeof *bus);
    if (length >= sizeof place) {
        (void)fprintf(stderr, "--can is too long.\n");
        return -1;
    }
    memcpy(place, spec, length);
    place[length] = '\0';
    query = query != NULL ? query + 1 : NULL;
    channel = strchr(place, ':');
    if (channel == NULL) {
        (void)fprintf(stderr, "--can %s does not name an interface and a channel.\n", spec);
        return -1;
    }
    *channel++ = '\0';
    bus->fd = TEDS_CAN_FD && (fd || strcmp(option(query, "fd", "0", form, sizeof form), "1") == 0);
    if (!read_pace(bus, query, pace, paces)) {
        return -1;
    }
    if (strcmp(place, "udp_multicast") == 0) {
        int number = atoi(option(query, "port", "43113", port, sizeof port));
        if (multicast_open(bus, channel, (uint16_t)number, atoi(option(query, "hop_limit", "0", hops, sizeof hops))) !=
            0) {
            (void)fprintf(stderr, "The bus %s does not open: %s.\n", spec, strerror(errno));
            return -1;
        }
        return 0;
    }
    if (strcmp(place, "socketcand") == 0) {
        bus->is_socketcand = true;
        if (socketcand_open(bus, channel, option(query, "host", "127.0.0.1", host, sizeof host),
                            option(query, "port", "29536", port, sizeof port)) != 0) {
            (void)fprintf(stderr, "The bus %s does not open: %s.\n", spec, strerror(errno));
            return -1;
        }
        return 0;
    }
    (void)fprintf(stderr, "--can knows udp_multicast and socketcand, not %s.\n", place);
    return -1;
}

int host_bus_receive(host_bus *bus, teds_can_frame *frame)
{
    return bus->is_socketcand ? socketcand_receive(bus, frame) : multicast_receive(bus, frame);
}

int host_bus_send(host_bus *bus, const teds_can_frame *frame)
{
    if (bus->pace != NULL) {
        host_pace_frame(bus->pace, frame, bus->bitrate, bus->data_bitrate);
    }
    return bus->is_socketcand ? socketcand_send(bus, frame) : multicast_send(bus, frame);
}

uint32_t host_bus_dropped(const host_bus *bus)
{
    uint32_t counts[9] = {0}; /* the last is SK_MEMINFO_DROPS (linux/sock_diag.h) */
    socklen_t length = sizeof counts;
    return getsockopt(bus->in, SOL_SOCKET, SO_MEMINFO, counts, &length) == 0 ? counts[8] : 0;
}

void host_bus_accept(host_bus *bus, uint8_t address)
{
    if (bus->pace != NULL && !bus->is_socketcand && bus->accepted != address) {
        bus->accepted = address;
        multicast_accept(bus, address);
    }
}
