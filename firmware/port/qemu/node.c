/* SPDX-License-Identifier: Apache-2.0 */
/* A node under qemu: a whole port, on a serial line that carries CAN frames (serial.h). */
#include "image.h"
#include "octets.h"
#include "serial.h"
#include "teds_bearssl.h"
#include "teds/node.h"

#include <bearssl.h>

#define IDENTITY 256u
#define SLOT 8192u

typedef struct board {
    teds_bearssl crypto; /* first: the port of BearSSL looks here */
    br_hmac_drbg_context dice;
    uint8_t flash[IDENTITY + 2 * SLOT];
} board;

static board own;
static teds_node node;
static teds_config config;
static teds_port port;
static const teds_channel channels[] = {{1, TEDS_SENSOR, 0, 2, 0, 100000}};

/* -- the port --------------------------------------------------------------------------------------------------------------- */

static uint8_t *place(int area)
{
    return own.flash + (area == TEDS_IDENTITY ? 0 : area == TEDS_SLOT_A ? IDENTITY : IDENTITY + SLOT);
}

static int erase(void *user, int area)
{
    (void)user;
    memset(place(area), 0xFF, area == TEDS_IDENTITY ? IDENTITY : SLOT);
    return 0;
}

static int write_flash(void *user, int area, uint32_t at, const uint8_t *octets, size_t length)
{
    (void)user;
    memcpy(place(area) + at, octets, length);
    return 0;
}

static int read_flash(void *user, int area, uint32_t at, uint8_t *out, size_t length)
{
    (void)user;
    memcpy(out, place(area) + at, length);
    return 0;
}

static int draw(void *user, uint8_t *out, size_t length)
{
    (void)user;
    br_hmac_drbg_generate(&own.dice, out, length);
    return 0;
}

static uint64_t now(void *user)
{
    (void)user;
    return image_ticks() * (IMAGE_TICK_PICOSECONDS / 1000u);
}

static bool sample(void *user, uint8_t channel, uint64_t tick, uint8_t *out)
{
    (void)user;
    (void)channel;
    teds_put16(out, (uint16_t)(tick / 1000000u));
    return true;
}

static int start(const uint8_t seed[32], const uint8_t uuid[10])
{
    br_hmac_drbg_init(&own.dice, &br_sha256_vtable, seed, 32);
    memcpy(config.uuid, uuid, 10);
    memset(own.flash, 0xFF, sizeof own.flash);
    own.crypto.random = draw;
    port.user = &own;
    port.slot_octets = SLOT;
    port.identity_octets = IDENTITY;
    port.unit = 8;
    port.erased = 0xFF;
    port.erase = erase;
    port.write = write_flash;
    port.read = read_flash;
    port.random = draw;
    port.now = now;
    port.step = IMAGE_TICK_PICOSECONDS / 1000u;
    port.drift = 100;
    port.channels = channels;
    port.channel_count = 1;
    port.sample = sample;
    return teds_bearssl_fill(&port, &own.crypto) != 0 ? TEDS_E_USAGE : teds_node_init(&node, &config, &port);
}

static void take(const uint8_t *packet, size_t length)
{
    teds_can_frame frame = {0};
    uint8_t told[8];
    if (packet[0] == SERIAL_POWER && length == 43) {
        if (start(packet + 1, packet + 33) == 0) {
            teds_can_start(&node, now(NULL));
            serial_send(SERIAL_READY, NULL, 0);
        }
    } else if (packet[0] == SERIAL_STACK) {
        teds_put32(told, image_stack_used());
        teds_put32(told + 4, sizeof node);
        serial_send(SERIAL_STACK, told, sizeof told);
    } else if (packet[0] == SERIAL_FRAME && length >= 6 && length - 6 <= sizeof frame.data) {
        frame.identifier = teds_get32(packet + 1);
        frame.fd = packet[5] != 0;
        frame.length = (uint8_t)(length - 6);
        memcpy(frame.data, packet + 6, frame.length);
        teds_can_rx(&node, &frame, now(NULL));
    }
}

int main(void)
{
    uint8_t packet[5 + 64];
    const uint8_t *came;
    teds_can_frame frame;
    serial_open();
    image_paint();
    for (;;) {
        size_t length = serial_receive(&came);
        if (length > 0) {
            take(came, length);
        }
        if (node.port == NULL) {
            continue;
        }
        (void)teds_node_poll(&node, now(NULL));
        while (teds_can_tx(&node, &frame, now(NULL))) {
            teds_put32(packet, frame.identifier);
            packet[4] = frame.fd;
            memcpy(packet + 5, frame.data, frame.length);
            serial_send(SERIAL_FRAME, packet, 5u + frame.length);
        }
        if (length == 0) {
            (void)teds_idle_work(&node);
        }
    }
}
