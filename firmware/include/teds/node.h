/* SPDX-License-Identifier: Apache-2.0 */
/** @file
 * A node (TIM) of the teds-provision profile: frames in, frames out.
 *
 * One teds_node is one node; nothing is global. No function allocates or recurses, and none blocks except in a call of
 * the port's cryptography or flash. Call all of them from one thread or main loop, except teds_sensor_event.
 *
 * Functions that return int return 0, or a negative TEDS_E_… for a misuse or a port that failed. What a peer did wrong
 * is a refusal in the reply, never an error of the call. Times are ns of the port's clock (teds_port.now).
 *
 * A board calls teds_node_init once, teds_can_start when its controller is on the bus, and then in its loop
 * teds_can_rx, teds_node_poll, teds_can_tx and teds_idle_work; port/template/main.c is that loop.
 */
#ifndef TEDS_NODE_H
#define TEDS_NODE_H

#include "teds/node_state.h"
#include "teds/version.h"

#ifdef __cplusplus
extern "C" {
#endif

/** Results of the functions that return int, besides 0. */
enum {
    TEDS_E_USAGE = -1,    /**< a port or configuration that cannot be: sizes, unit, channels, no cryptography */
    TEDS_E_FLASH = -2,    /**< flash failed, or reads back other than written */
    TEDS_E_RANDOM = -3,   /**< no randomness */
    TEDS_E_IDENTITY = -4, /**< the identity area is torn: a node never makes a second key over one that it has shown */
    TEDS_E_CRYPTO = -5,   /**< a function of the port's cryptography failed */
    TEDS_E_BUILD = -6,    /**< board and library were compiled with different options, sizes or versions */
    TEDS_E_FORM = -7      /**< flash was written in a form that this firmware does not know; it stays as it is */
};

/** Links that are not CAN. */
enum {
    TEDS_LINK_NFC = 1, /**< the reader in whose field the tag is */
    TEDS_LINK_BLE = 2  /**< Bluetooth LE connection 0; 3 is connection 1, and so on */
};

/** Kinds of a link. */
enum {
    TEDS_CAN = 1,    /**< CAN or CAN FD */
    TEDS_AT_NFC = 2, /**< NFC */
    TEDS_AT_BLE = 3  /**< Bluetooth LE */
};

/** How and when a command came. */
typedef struct teds_arrival {
    uint8_t kind;  /**< #TEDS_CAN, #TEDS_AT_NFC, #TEDS_AT_BLE */
    bool tapped;   /**< it came over NFC, or over a bus that counts as tapped */
    bool fd;       /**< it came by CAN FD */
    uint64_t tick; /**< when its last octet came */
} teds_arrival;

/** A TEDS that is part of the firmware and cannot be written. */
typedef struct teds_fixed {
    uint8_t channel;       /**< its TransducerChannel, 0: the TIM; ascending in the table */
    uint8_t code;          /**< its TEDS access code; ascending within a channel */
    uint16_t length;       /**< octets of it */
    const uint8_t *octets; /**< Length to Checksum */
} teds_fixed;

/** Another TNEP service on this node's tag: one of the application. Its reader selects it by name; afterwards its NDEF
 * messages come to `answer` until the reader selects another service or leaves. */
typedef struct teds_nfc_service {
    const char *name; /**< service name URI, 1 to 128 octets: "urn:nfc:xsn:example.com:settings" */
    void *user;       /**< first argument of `answer` */
    /** Answer an NDEF message of the service's reader; called from teds_node_poll. `out` gets the records that follow
     * the status record in the answer: none of them begins a message (MB), the last one ends it (ME). Return their
     * octets, at most `room`; 0 if there are none; a negative number for a message that is not understood. `message` is
     * whole, without chunks; the one that selects the service contains the Ts record. It is not authenticated: any
     * reader can send it. */
    int (*answer)(void *user, const uint8_t *message, size_t length, uint8_t *out, size_t room);
} teds_nfc_service;

/** Configuration by the application. It must outlive the node. */
struct teds_config {
    uint8_t uuid[10];        /**< used at the very first start only; afterwards the stored one counts */
    const teds_fixed *fixed; /**< TEDS of the firmware, NULL: none */
    size_t fixed_count;      /**< their number */
    bool quick_points;       /**< the chip's point arithmetic takes 5 ms at most */
    bool no_can;             /**< the board has no CAN: Identify reports address 0, and 128.10 gets 1 */
    /** NFC, if the library was compiled with it. */
    struct {
        bool present;                     /**< the board has an antenna: a tap is a tap, and its bus is never one */
        uint8_t wt_int;                   /**< answers are read after 2^(wt_int / 4 - 1) ms; multiples of 4 */
        uint8_t n_wait;                   /**< how often it may read again, at most 15 */
        uint16_t max_ndef;                /**< longest NDEF message of this tag, 160 or more; 0: #TEDS_MAX_NDEF */
        const teds_nfc_service *services; /**< services of the application on the same tag, NULL: none */
        size_t service_count;             /**< their number; their records share the initial message with the node's */
    } nfc;                                /**< NFC */
    const uint8_t *ble_address; /**< static random, 6 octets in the order people write, shown at a tap; NULL: no BLE */
};

/** A CAN frame with an identifier of 29 bits. */
typedef struct teds_can_frame {
    uint32_t identifier;                 /**< 29 bits */
    uint8_t length;                      /**< octets of data */
    bool fd;                             /**< CAN FD, with bit rate switching as the bus has it */
    uint8_t data[TEDS_CAN_FD ? 64 : 8];  /**< its data */
} teds_can_frame;

/** @name Start and main loop */
/** @{ */

/** Return one number for all that board and library have to agree on: sizes of what they share, options, version. */
static inline uint32_t teds_built(void)
{
    const uint32_t facts[] = {
        sizeof(teds_node), sizeof(teds_port), sizeof(teds_config), sizeof(teds_can_frame), sizeof(teds_channel),
        TEDS_MAX_MESSAGE, TEDS_STAGING, TEDS_SESSIONS, TEDS_REPLIES, TEDS_CAN_LINES, TEDS_CAN_FD, TEDS_OPERATION,
        TEDS_CHANNELS, TEDS_STREAMS, TEDS_DRIVE_OCTETS, TEDS_EVENT_CHANNELS, TEDS_EVENTS, TEDS_EVENT_OCTETS,
        TEDS_SHA256_OCTETS, TEDS_MANAGED, TEDS_NFC, TEDS_MAX_NDEF, TEDS_BLE, TEDS_BLE_CONNECTIONS, TEDS_VERSION,
    };
    uint32_t built = 0;
    for (size_t i = 0; i < sizeof facts / sizeof facts[0]; i++) {
        built = (built ^ facts[i]) * 16777619u;
    }
    return built;
}

/** Start a node; boards call teds_node_init. `built` is the board's teds_built: if it differs from the library's, the
 * result is #TEDS_E_BUILD, and nothing was written. */
int teds_node_init_as_built(teds_node *node, uint32_t built, const teds_config *config, const teds_port *port);

/** Start a node: read both slots, take the newer good one, erase the other if it is not blank, and make the identity key
 * at the very first start (a P-256 key and a signature: up to half a second on a small core). A spare slot that cannot
 * be erased does not stop a node whose other slot is whole: it refuses what would write (11). `config` and `port` must
 * outlive the node. Inline, so that it carries what the board was compiled with. */
static inline int teds_node_init(teds_node *node, const teds_config *config, const teds_port *port)
{
    return teds_node_init_as_built(node, teds_built(), config, port);
}

/** Run leases, samples, time-outs and due erasures. Return when it is due again; UINT64_MAX: not by itself. */
uint64_t teds_node_poll(teds_node *node, uint64_t now);

/** Make the next one-time key ahead of time, if it is missing. Call it while nothing else is to do. True if it made one:
 * that took as long as `p256_make` of the port, 68 ms on a 64 MHz Cortex-M4 with BearSSL and 0.22 s on a 48 MHz
 * Cortex-M0+, during which the loop stood still. False costs nothing. A node that never calls it makes the key within
 * Request and Open, which then take that much longer. */
bool teds_idle_work(teds_node *node);

/** @} */
/** @name CAN */
/** @{ */

/** The controller is on the bus: announce after a random 0 to 500 ms. */
void teds_can_start(teds_node *node, uint64_t now);

/** Take a frame that came; `tick` is its end. From the main loop, never from an interrupt: keep a ring of 20 frames. */
void teds_can_rx(teds_node *node, const teds_can_frame *frame, uint64_t tick);

/** Return the next frame to send; false: none. Call it when the controller has room for one: commands and replies are
 * sent before data, and frames that are still here can be withdrawn. */
bool teds_can_tx(teds_node *node, teds_can_frame *frame, uint64_t now);

/** The controller is off the bus: all CAN links are lost. Restart it at once, and call teds_can_start: the node itself
 * stays silent for 1 s, doubling to 30 s while it recurs. */
void teds_node_bus_off(teds_node *node);

/** @} */
/** @name Events of the board */
/** @{ */

/** Button, pad or magnet held for 5 s: the effect of Reset. 0, or #TEDS_E_FLASH. While an image is on trial it restarts
 * the board instead, and nothing is reset: hold the button again. */
int teds_node_reset_by_hand(teds_node *node);

/** A button was released that was held for 50 ms to 2 s: announce it on CAN, so that a person sees which board this is. At
 * most once a second and 20 times a minute, the rest is left out. */
void teds_can_pressed(teds_node *node, uint64_t now);

/** An event sensor has seen something at `tick`. The one function that an interrupt may call, each sensor from an
 * interrupt of its own. `octets` is a data set. If its ring is full the event is lost, and the counter of its stream
 * shows it. */
void teds_sensor_event(teds_node *node, uint8_t channel, uint64_t tick, const uint8_t *octets, bool valid);

/** @} */
/** @name Commands over a link of the board's own
 * CAN, NFC and BLE need none of these: their functions call them. */
/** @{ */

/** Answer one whole command frame with one whole reply frame; return its length. `frame` is never written and does not
 * overlap `reply`, which has room for #TEDS_MAX_MESSAGE octets. Call teds_node_reply_left when its last frame was
 * acknowledged. */
size_t teds_node_handle(teds_node *node, teds_link link, const teds_arrival *arrival, const uint8_t *frame,
                        size_t length, uint8_t *reply);

/** The last frame of the reply has left: data may follow, and a new CAN address counts from now on. */
void teds_node_reply_left(teds_node *node, teds_link link);

/** A link or field is lost: its session, half-open Open, pending agreement and stored reply go. */
void teds_node_link_lost(teds_node *node, teds_link link);

/** @} */
/** @name State */
/** @{ */

/** Return the payload of Identify: 23 octets. */
void teds_node_identify(const teds_node *node, uint8_t out[23]);

/** Return the data messages that could not leave in time, since the start. */
uint64_t teds_node_missed(const teds_node *node);

/** @} */

#if TEDS_NFC || defined(TEDS_REFERENCE)
/** @name NFC */
/** @{ */

/** A reader has activated the tag, or its field is gone: the session over NFC goes with it. */
void teds_nfc_field(teds_node *node, bool present);

/** For chips that keep the NDEF message themselves: a reader has written a whole one, and the chip shows an empty message
 * from that moment on. False if the message is empty or too long. */
bool teds_nfc_written(teds_node *node, const uint8_t *message, size_t length);

/** Return the NDEF message for the tag to show now; call it after each teds_node_poll. */
const uint8_t *teds_nfc_message(const teds_node *node, size_t *length);

/** Octets of the longest answer to an APDU. */
#define TEDS_T4T_OCTETS 258

/** For chips that hand over APDUs (ISO/IEC 7816-4): return the response, with its status word. Commands that a reader
 * wrote are run by teds_node_poll, so call that soon. */
size_t teds_t4t_apdu(teds_node *node, const uint8_t *apdu, size_t length, uint8_t out[TEDS_T4T_OCTETS]);

/** State of ISO-DEP, for chips that hand over frames: owned by the board, used by teds_isodep_start and _block. */
typedef struct teds_isodep {
    /** @cond INSIDE */
    bool receives;
    uint8_t number, last;
    uint16_t information, length, at, last_at, last_length;
    uint8_t apdu[264];
    /** @endcond */
} teds_isodep;

/** For chips that hand over frames: answer a RATS with the ATS; it is an activation, too. */
size_t teds_isodep_start(teds_node *node, teds_isodep *card, const uint8_t *rats, size_t length, uint8_t out[5]);

/** For chips that hand over frames: answer a block without its CRC; return the octets of the answer, 0: silence. */
size_t teds_isodep_block(teds_node *node, teds_isodep *card, const uint8_t *block, size_t length, uint8_t out[256]);

/** @} */
#endif

#if TEDS_BLE || defined(TEDS_REFERENCE)
/** @name Bluetooth LE
 * `connection` is 0 and up, below #TEDS_BLE_CONNECTIONS, of the service d8570001-29b5-44d3-91d4-401ec8a7a4d4. */
/** @{ */

/** A connection began, with this ATT MTU. */
void teds_ble_connected(teds_node *node, uint8_t connection, uint16_t mtu);

/** Its ATT MTU changed. */
void teds_ble_mtu(teds_node *node, uint8_t connection, uint16_t mtu);

/** It ended. */
void teds_ble_disconnected(teds_node *node, uint8_t connection);

/** The station wrote d8570002-…: call teds_ble_notify until it returns 0. */
void teds_ble_written(teds_node *node, uint8_t connection, const uint8_t *value, size_t length);

/** Return the next notification of d8570003-… that is due; 0: none. */
size_t teds_ble_notify(teds_node *node, uint8_t connection, uint8_t out[512]);

#if TEDS_OPERATION || defined(TEDS_REFERENCE)
/** Octets of the longest data message over BLE. */
#define TEDS_BLE_DATA 241

/** The station enabled the notifications of d8570004-…, or disabled them, which ends its streams. */
void teds_ble_hears(teds_node *node, uint8_t connection, bool hears);

/** Return the next data message that may leave now as a notification of d8570004-…, and on which connection; 0: none.
 * Ask until then, after each teds_node_poll and each reply that has left. */
size_t teds_ble_data(teds_node *node, uint8_t *connection, uint8_t out[TEDS_BLE_DATA]);

/** The station wrote d8570004-… without response: Drive. */
void teds_ble_driven(teds_node *node, uint8_t connection, const uint8_t *value, size_t length);
#endif

/** The node was tapped: advertise for 60 s. teds_nfc_field calls it. */
void teds_ble_tapped(teds_node *node);

/** True if the node should advertise now: for 60 s after a tap, and while it has a key. Ask twice a second. */
bool teds_ble_advertises(const teds_node *node);

/** True if a connection should be dropped: 10 s without a session. Ask twice a second. */
bool teds_ble_drops(teds_node *node, uint8_t connection);

/** @} */
#endif

#ifdef __cplusplus
}
#endif

#endif
