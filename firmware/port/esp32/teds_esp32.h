/* SPDX-License-Identifier: Apache-2.0 */
/** @file
 * A node on an ESP32 by ESP-IDF 5 or Arduino: TWAI for CAN, three data partitions, BearSSL.
 *
 * Compiled and run against stand-ins only (port/esp32/standin): no ESP32 has run it yet. Partitions teds_identity,
 * teds_slot_a and teds_slot_b are in port/esp32/partitions.csv. With flash encryption the keys are encrypted at rest.
 */
#ifndef TEDS_ESP32_H
#define TEDS_ESP32_H

#include "teds/node.h"

#ifdef __cplusplus
extern "C" {
#endif

/** What an application hands over of its board. Port and configuration must outlive the node. */
typedef struct teds_esp32_board {
    teds_port *port;     /**< channel functions as in teds_port; the rest, `user` included, is filled in here */
    teds_config *config; /**< a UUID of zeros is replaced by one made of the chip's MAC address */
    int tx;              /**< GPIO of the transceiver's TXD */
    int rx;              /**< GPIO of the transceiver's RXD */
    uint32_t bitrate;    /**< 125000, 250000, 500000 or 1000000 */
    bool radio;          /**< Wi-Fi or Bluetooth runs as long as the node: else the chip's random generator has no entropy
                              of its own, and is given that of the SAR ADC for each draw, which the application then
                              must not use at the same time */
} teds_esp32_board;

/** Fill in the port, start node and controller. Return 0, TEDS_E_…, or -100 if a partition is missing or too small, -101 if
 * the controller does not start. */
int teds_esp32_start(const teds_esp32_board *board);

/** Do what is due, once: frames, samples, time-outs. Call it from one task or from loop(), each millisecond or more often;
 * a P-256 multiplication or an erase takes longer. */
void teds_esp32_work(void);

/** Return ns since the start: the port's clock, for ticks of events. Also from an interrupt. */
uint64_t teds_esp32_now(void);

/** Return the node, for teds_sensor_event and teds_node_reset_by_hand. */
teds_node *teds_esp32_node(void);

#ifdef __cplusplus
}
#endif

#endif
