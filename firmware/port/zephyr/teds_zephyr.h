/* SPDX-License-Identifier: Apache-2.0 */
/** @file
 * A node on Zephyr: one thread that owns it, a message queue from the CAN callback, flash partitions, PSA Crypto.
 *
 * The application fills in its channels and starts it. Devicetree: `chosen` zephyr,canbus; fixed partitions labelled
 * teds_identity, teds_slot_a, teds_slot_b, each of whole erase pages, slots of CONFIG_TEDS_NODE_STAGING + 256 or more.
 */
#ifndef TEDS_ZEPHYR_H
#define TEDS_ZEPHYR_H

#include "teds/node.h"

#ifdef __cplusplus
extern "C" {
#endif

/** What an application hands over of its board. Both must outlive the node. */
typedef struct teds_zephyr_board {
    teds_port *port;     /**< channel functions as in teds_port, called from the node's thread; the rest is filled in here */
    teds_config *config; /**< a UUID of zeros is replaced: the chip's own number (hwinfo), or random octets if it has none */
} teds_zephyr_board;

/** Fill in the port, start the node and its thread. Return 0, TEDS_E_…, or Zephyr's negative errno if a device is not
 * ready. */
int teds_zephyr_start(const teds_zephyr_board *board);

/** Return ns since the start: the port's clock, for ticks of events. Also from an interrupt. */
uint64_t teds_zephyr_now(void);

/** A pad was held for five seconds: the effect of Reset, soon, on the node's thread. Also from an interrupt. */
void teds_zephyr_reset_by_hand(void);

/** A button was released that was held for 50 ms to 2 s: the board announces itself, soon, on the node's thread. Also from an
 * interrupt. The devicetree alias teds-button does it by itself. */
void teds_zephyr_pressed(void);

/** teds_sensor_event, and wake the node's thread. From an interrupt or a thread. */
void teds_zephyr_event(uint8_t channel, uint64_t tick, const uint8_t *octets, bool valid);

/** Return the frames of the bus that found no room on their way to the node, since the start. */
uint32_t teds_zephyr_dropped(void);

/** @cond INSIDE */
/* -- between the files of this port ---------------------------------------------------------------------------------- */

int teds_zephyr_flash(teds_port *port);
void teds_zephyr_firmware(teds_port *port);
#ifdef CONFIG_TEDS_MANAGE
void teds_zephyr_feed(void);
bool teds_zephyr_on_trial(void);
void teds_zephyr_restart(void);
#endif
int teds_zephyr_can_start(void);
/* Give the node what came and the controller what may leave; true if something moved. */
bool teds_zephyr_can_work(teds_node *node);
/* A frame is with the controller, which calls back when it has left. */
bool teds_zephyr_can_busy(void);
int teds_zephyr_nfc_start(void);
bool teds_zephyr_nfc_work(teds_node *node);
int teds_zephyr_ble_start(teds_config *config); /* and set the address that a tap shows */
bool teds_zephyr_ble_work(teds_node *node);
/* Wake the node's thread. Also from an interrupt. */
void teds_zephyr_wake(void);
/** @endcond */

#ifdef __cplusplus
}
#endif

#endif
