/* SPDX-License-Identifier: Apache-2.0 */
#include "octets.h"

void teds_put16(uint8_t *at, uint16_t value)
{
    at[0] = (uint8_t)(value >> 8);
    at[1] = (uint8_t)value;
}

void teds_put32(uint8_t *at, uint32_t value)
{
    teds_put16(at, (uint16_t)(value >> 16));
    teds_put16(at + 2, (uint16_t)value);
}

void teds_put64(uint8_t *at, uint64_t value)
{
    teds_put32(at, (uint32_t)(value >> 32));
    teds_put32(at + 4, (uint32_t)value);
}

uint16_t teds_get16(const uint8_t *at)
{
    return (uint16_t)((uint32_t)at[0] << 8 | at[1]);
}

uint32_t teds_get32(const uint8_t *at)
{
    return (uint32_t)teds_get16(at) << 16 | teds_get16(at + 2);
}

uint64_t teds_get64(const uint8_t *at)
{
    return (uint64_t)teds_get32(at) << 32 | teds_get32(at + 4);
}

bool teds_equal(const uint8_t *a, const uint8_t *b, size_t length)
{
    uint8_t differ = 0;
    for (size_t i = 0; i < length; i++) {
        differ |= (uint8_t)(a[i] ^ b[i]);
    }
    return differ == 0;
}

void teds_wipe(void *octets, size_t length)
{
    volatile uint8_t *at = octets;
    for (size_t i = 0; i < length; i++) {
        at[i] = 0;
    }
}

uint32_t teds_crc32(uint32_t crc, const uint8_t *octets, size_t length)
{
    static const uint32_t nibble[16] = {
        0x00000000u, 0x1DB71064u, 0x3B6E20C8u, 0x26D930ACu, 0x76DC4190u, 0x6B6B51F4u, 0x4DB26158u, 0x5005713Cu,
        0xEDB88320u, 0xF00F9344u, 0xD6D6A3E8u, 0xCB61B38Cu, 0x9B64C2B0u, 0x86D3D2D4u, 0xA00AE278u, 0xBDBDF21Cu,
    };
    crc = ~crc;
    for (size_t i = 0; i < length; i++) {
        crc ^= octets[i];
        crc = crc >> 4 ^ nibble[crc & 15];
        crc = crc >> 4 ^ nibble[crc & 15];
    }
    return ~crc;
}
