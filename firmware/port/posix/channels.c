/* SPDX-License-Identifier: Apache-2.0 */
/* Channels without hardware: what a source gives for a time. Integers of up to 8 octets, big-endian. */
#define _POSIX_C_SOURCE 200809L
#include "host.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static int kind_of(const char *word)
{
    return strcmp(word, "sensor") == 0     ? TEDS_SENSOR
           : strcmp(word, "actuator") == 0 ? TEDS_ACTUATOR
           : strcmp(word, "event") == 0    ? TEDS_EVENT_SENSOR
                                           : -1;
}

int host_channels_read(host_channels *channels, const char *path)
{
    FILE *file = fopen(path, "r");
    char line[160], word[16];
    unsigned number, model, octets, halt, bits;
    unsigned long shortest;
    if (file == NULL) {
        (void)fprintf(stderr, "%s cannot be read.\n", path);
        return -1;
    }
    while (fgets(line, sizeof line, file) != NULL) {
        teds_channel *own = &channels->table[channels->count];
        int read;
        if (line[0] == '#' || line[0] == '\n') {
            continue;
        }
        halt = 0;
        bits = 0;
        read = sscanf(line, "%u %15s %u %u %lu %u %u", &number, word, &model, &octets, &shortest, &halt, &bits);
        if (read < 5 || kind_of(word) < 0 || number < 1 || number > 255 || octets < 1 || octets > 8 || bits > 8 * octets ||
            channels->count == TEDS_CHANNELS) {
            (void)fprintf(stderr, "%s: not a channel: %s", path, line);
            (void)fclose(file);
            return -1;
        }
        own->number = (uint8_t)number;
        own->kind = (uint8_t)kind_of(word);
        own->model = (uint8_t)model;
        own->octets = (uint8_t)octets;
        own->halt = (uint8_t)halt;
        own->shortest = (uint32_t)shortest;
        channels->bits[channels->count] = (uint8_t)(bits > 0 ? bits : 8 * octets);
        channels->count++;
    }
    (void)fclose(file);
    return 0;
}

int host_source(host_channels *channels, const char *source)
{
    const char *colon = strchr(source, ':');
    channels->source = source[0];
    channels->seconds = colon != NULL ? strtod(colon + 1, NULL) : 1.0;
    channels->random = 88172645463325252u;
    if (strncmp(source, "noise", 5) == 0 ||
        ((strncmp(source, "sine", 4) == 0 || strncmp(source, "ramp", 4) == 0) && channels->seconds > 0)) {
        return 0;
    }
    (void)fprintf(stderr, "--source is noise, sine:SECONDS or ramp:SECONDS, not %s.\n", source);
    return -1;
}

/* Between 0 and 1. */
static double source_at(host_channels *channels, uint8_t channel, uint64_t tick)
{
    double turns = (double)tick / 1e9 / channels->seconds;
    if (channels->source == 's') {
        return 0.5 + 0.5 * sin(2 * 3.14159265358979 * turns + channel);
    }
    if (channels->source == 'r') {
        return turns - floor(turns);
    }
    channels->random ^= channels->random << 13;
    channels->random ^= channels->random >> 7;
    channels->random ^= channels->random << 17;
    return (double)(channels->random >> 11) / 9007199254740992.0;
}

bool host_sample(host_channels *channels, uint8_t channel, uint64_t tick, uint8_t *out)
{
    for (size_t i = 0; i < channels->count; i++) {
        const teds_channel *own = &channels->table[i];
        double most = ldexp(1.0, channels->bits[i] < 53 ? channels->bits[i] : 53) - 1;
        uint64_t value;
        if (own->number != channel) {
            continue;
        }
        value = (uint64_t)(source_at(channels, channel, tick) * most);
        for (size_t at = own->octets; at-- > 0; value >>= 8) {
            out[at] = (uint8_t)value;
        }
        return true;
    }
    return false;
}
