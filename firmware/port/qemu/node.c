/* A node under qemu, on a serial line that carries CAN frames. Packets are framed as SLIP does (RFC 1055):
 *
 *   in   00 id4 fd data…   a CAN frame            01 seed32 uuid10   power comes: randomness and identity
 *   out  00 id4 fd data…   a CAN frame            02                 on the bus
 *   in   03                how much stack         out 03 stack4 node4
 */
#include "image.h"
#include "octets.h"
#include "teds_bearssl.h"
#include "teds/node.h"

#include <bearssl.h>

#define UART(offset) (*(volatile uint32_t *)(uintptr_t)(0x40004000u + (offset)))
#define END 0xC0u
#define ESCAPE 0xDBu
#define IDENTITY 256u
#define SLOT 8192u

typedef struct board {
    teds_bearssl crypto; /* first: the port of BearSSL looks here */
    br_hmac_drbg_context dice;
    uint8_t flash[IDENTITY + 2 * SLOT];
    uint8_t packet[80];
    size_t held;
    int escaped;
} board;

static board own;
static teds_node node;
static teds_config config;
static teds_port port;
static const teds_channel channels[] = {{1, TEDS_SENSOR, 0, 2, 0, 100000}};

/* -- the serial line ------------------------------------------------------------------------------------------------------ */

static void put(uint8_t octet)
{
    while ((UART(4) & 1u) != 0) {
    }
    UART(0) = octet;
}

static void put_escaped(uint8_t octet)
{
    if (octet == END || octet == ESCAPE) {
        put(ESCAPE);
        octet = octet == END ? 0xDC : 0xDD;
    }
    put(octet);
}

static void send(uint8_t kind, const uint8_t *octets, size_t length)
{
    put(END);
    put_escaped(kind);
    for (size_t i = 0; i < length; i++) {
        put_escaped(octets[i]);
    }
    put(END);
}

/* A whole packet in own.packet: its length, 0: none yet. */
static size_t receive(void)
{
    while ((UART(4) & 2u) != 0) {
        uint8_t octet = (uint8_t)UART(0);
        if (octet == END) {
            size_t length = own.held;
            own.held = 0;
            own.escaped = 0;
            if (length > 0) {
                return length;
            }
            continue;
        }
        if (octet == ESCAPE) {
            own.escaped = 1;
            continue;
        }
        if (own.escaped) {
            octet = octet == 0xDC ? END : ESCAPE;
            own.escaped = 0;
        }
        if (own.held < sizeof own.packet) {
            own.packet[own.held++] = octet;
        }
    }
    return 0;
}

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

static int start(void)
{
    br_hmac_drbg_init(&own.dice, &br_sha256_vtable, own.packet + 1, 32);
    memcpy(config.uuid, own.packet + 33, 10);
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
    teds_bearssl_fill(&port);
    port.channels = channels;
    port.channel_count = 1;
    port.sample = sample;
    return teds_node_init(&node, &config, &port);
}

static void take(size_t length)
{
    teds_can_frame frame = {0};
    uint8_t told[8];
    if (own.packet[0] == 1 && length == 43) {
        if (start() == 0) {
            teds_can_start(&node, now(NULL));
            send(2, NULL, 0);
        }
    } else if (own.packet[0] == 3) {
        teds_put32(told, image_stack_used());
        teds_put32(told + 4, sizeof node);
        send(3, told, sizeof told);
    } else if (own.packet[0] == 0 && length >= 6 && length - 6 <= sizeof frame.data) {
        frame.identifier = teds_get32(own.packet + 1);
        frame.fd = own.packet[5] != 0;
        frame.length = (uint8_t)(length - 6);
        memcpy(frame.data, own.packet + 6, frame.length);
        teds_can_rx(&node, &frame, now(NULL));
    }
}

int main(void)
{
    uint8_t packet[5 + 64];
    teds_can_frame frame;
    UART(0x10) = 16;
    UART(8) = 3;
    image_paint();
    for (;;) {
        size_t length = receive();
        if (length > 0) {
            take(length);
        }
        if (node.port == NULL) {
            continue;
        }
        (void)teds_node_poll(&node, now(NULL));
        while (teds_can_tx(&node, &frame, now(NULL))) {
            teds_put32(packet, frame.identifier);
            packet[4] = frame.fd;
            memcpy(packet + 5, frame.data, frame.length);
            send(0, packet, 5u + frame.length);
        }
        if (length == 0) {
            (void)teds_idle_work(&node);
        }
    }
}
