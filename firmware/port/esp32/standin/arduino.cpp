// SPDX-License-Identifier: Apache-2.0
// The stand-in for Arduino on this machine: the sketch's setup() and loop(), and an AS5600 that turns slowly.
#include <chrono>
#include <cstdio>
#include <cstring>
#include <thread>

#include "Arduino.h"
#include "Wire.h"

SerialPort Serial;
WireBus Wire;
static int next;

uint32_t micros() {
  using namespace std::chrono;
  return uint32_t(duration_cast<microseconds>(steady_clock::now().time_since_epoch()).count());
}

void delay(uint32_t ms) { std::this_thread::sleep_for(std::chrono::milliseconds(ms)); }

void SerialPort::begin(unsigned long) {}

void SerialPort::println(const char *text) {
  std::printf("{\"serial\": \"%s\", \"ready\": %s}\n", text, std::strcmp(text, "ready") == 0 ? "true" : "false");
  std::fflush(stdout);
}

void WireBus::begin() {}
void WireBus::setClock(uint32_t) {}
void WireBus::beginTransmission(int) {}
void WireBus::write(uint8_t at) { next = at; }
int WireBus::endTransmission(bool) { return 0; }
int WireBus::requestFrom(int, int octets) { return octets; }

uint8_t WireBus::read() {
  const unsigned angle = micros() >> 10 & 0x0FFF;
  return uint8_t(next++ == 0x0C ? angle >> 8 : angle);
}

int main() {
  setup();
  for (;;) {
    loop();
    std::this_thread::sleep_for(std::chrono::microseconds(200));
  }
}
