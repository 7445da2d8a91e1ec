// SPDX-License-Identifier: Apache-2.0
// A magnetic angle sensor AS5600 on I2C as a node on CAN: ESP32, a 3.3 V transceiver on GPIO 21 and 22.
// Partitions: port/esp32/partitions.csv. Compiled and run against stand-ins only: no board has run it yet.
#include <Wire.h>
#include <teds_esp32.h>

static const teds_channel channels[] = {{1, TEDS_SENSOR, 0, 2, 0, 1000000}};  // 12 bits in 2 octets, 1 kHz at most
static teds_port port;
static teds_config config;
static uint16_t angle;
static bool seen;

// The newest angle, at once: loop() reads it. Not valid until the sensor has answered.
static bool sample(void *, uint8_t, uint64_t, uint8_t *out) {
  out[0] = uint8_t(angle >> 8);
  out[1] = uint8_t(angle);
  return seen;
}

static void readAngle() {
  Wire.beginTransmission(0x36);
  Wire.write(0x0C);  // RAW ANGLE
  seen = Wire.endTransmission(false) == 0 && Wire.requestFrom(0x36, 2) == 2;
  if (seen) {
    const uint8_t high = Wire.read();
    angle = uint16_t((high & 0x0F) << 8 | Wire.read());
  }
}

void setup() {
  Serial.begin(115200);
  Wire.begin();
  Wire.setClock(400000);
  port.channels = channels;
  port.channel_count = 1;
  port.sample = sample;
  const teds_esp32_board board = {&port, &config, 21, 22, 500000, false};
  const int failed = teds_esp32_start(&board);
  Serial.println(failed == 0 ? "ready" : "The node does not start; see teds_node_init.");
  if (failed != 0) {
    while (true) delay(1000);
  }
}

void loop() {
  static uint32_t last;
  if (micros() - last >= 1000) {
    last = micros();
    readAngle();
  }
  teds_esp32_work();
}
