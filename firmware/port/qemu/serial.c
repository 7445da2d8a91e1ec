/* SPDX-License-Identifier: Apache-2.0 */
#include "serial.h"

#define UART(offset) (*(volatile uint32_t *)(uintptr_t)(0x40004000u + (offset)))
#define END 0xC0u
#define ESCAPE 0xDBu

static uint8_t packet[80];
static size_t held;
static int escaped;

void serial_open(void)
{
    UART(0x10) = 16;
    UART(8) = 3;
}

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

void serial_send(uint8_t kind, const uint8_t *octets, size_t length)
{
    put(END);
    put_escaped(kind);
    for (size_t i = 0; i < length; i++) {
        put_escaped(octets[i]);
    }
    put(END);
}

size_t serial_receive(const uint8_t **out)
{
    *out = packet;
    while ((UART(4) & 2u) != 0) {
        uint8_t octet = (uint8_t)UART(0);
        if (octet == END) {
            size_t length = held;
            held = 0;
            escaped = 0;
            if (length > 0) {
                return length;
            }
            continue;
        }
        if (octet == ESCAPE) {
            escaped = 1;
            continue;
        }
        if (escaped) {
            octet = octet == 0xDC ? END : ESCAPE;
            escaped = 0;
        }
        if (held < sizeof packet) {
            packet[held++] = octet;
        }
    }
    return 0;
}
