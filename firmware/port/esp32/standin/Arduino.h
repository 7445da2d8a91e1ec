/* SPDX-License-Identifier: Apache-2.0 */
/* A stand-in for ESP-IDF: what the port uses of it, so that it compiles and runs on this machine. Not ESP-IDF. */
#ifndef STANDIN_ARDUINO_H
#define STANDIN_ARDUINO_H

#include <stddef.h>
#include <stdint.h>
uint32_t micros();
void delay(uint32_t ms);
struct SerialPort {
    void begin(unsigned long);
    void println(const char *);
};
extern SerialPort Serial;
void setup();
void loop();

#endif
