/* SPDX-License-Identifier: Apache-2.0 */
/* A stand-in for ESP-IDF: what the port uses of it, so that it compiles and runs on this machine. Not ESP-IDF. */
#ifndef STANDIN_WIRE_H
#define STANDIN_WIRE_H

#include <stdint.h>
struct WireBus { /* an AS5600 that turns slowly */
    void begin();
    void setClock(uint32_t);
    void beginTransmission(int);
    void write(uint8_t);
    int endTransmission(bool);
    int requestFrom(int, int);
    uint8_t read();
};
extern WireBus Wire;

#endif
