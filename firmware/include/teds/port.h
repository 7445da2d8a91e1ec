/* SPDX-License-Identifier: Apache-2.0 */
/** @file
 * What a board gives to its node: flash, randomness, a clock, cryptography, channels.
 *
 * The port is a structure of function pointers, each of which gets `user`, so that two nodes run in one process.
 * Functions that return int return 0 if they did what was asked, and anything else if not: the node then refuses the
 * command with reason 11 and has changed nothing. A blank port to copy is port/template/board.c.
 */
#ifndef TEDS_PORT_H
#define TEDS_PORT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "teds/config.h"

#ifdef __cplusplus
extern "C" {
#endif

/** Areas of flash. The identity is written once; the two slots take turns. */
enum {
    TEDS_IDENTITY = 0, /**< UUID and identity key */
    TEDS_SLOT_A = 1,   /**< state and TEDS, one of the two */
    TEDS_SLOT_B = 2    /**< state and TEDS, the other one */
};

/** A private key as the port knows it: the scalar of a key in software, the slot of a secure element, a PSA key id.
 * The node stores the one of its identity key in the identity area and never interprets it. */
typedef struct teds_key_ref {
    uint8_t octets[32]; /**< meaning: the port's */
} teds_key_ref;

/** Purpose of a new key. */
enum {
    TEDS_KEY_SIGNS = 0, /**< the identity key: signs, is kept for life */
    TEDS_KEY_AGREES = 1 /**< a one-time key: one Request or one Open */
};

/** Room for the port's running SHA-256, aligned for any member. */
typedef union teds_sha256 {
    uint64_t align;                     /**< alignment only */
    void *align_pointer;                /**< alignment only */
    uint8_t octets[TEDS_SHA256_OCTETS]; /**< the port's own structure */
} teds_sha256;

/** One of several octet strings that are hashed one after another. */
typedef struct teds_part {
    const uint8_t *octets; /**< its first octet */
    size_t length;         /**< its octets */
} teds_part;

/** Kinds of a channel, as ChanType numbers them. */
enum {
    TEDS_SENSOR = 0,      /**< has a value whenever it is asked */
    TEDS_ACTUATOR = 1,    /**< takes a set point */
    TEDS_EVENT_SENSOR = 2 /**< has a value when something happens (teds_sensor_event) */
};

/** A channel as the firmware knows it: the TEDS describes the hardware and never commands it. */
typedef struct teds_channel {
    uint8_t number;    /**< 1 to 255, ascending in the table */
    uint8_t kind;      /**< #TEDS_SENSOR, #TEDS_ACTUATOR or #TEDS_EVENT_SENSOR */
    uint8_t model;     /**< DatModel */
    uint8_t octets;    /**< ModLenth: octets of a data set */
    uint8_t halt;      /**< ActHalt of an actuator */
    uint32_t shortest; /**< shortest sampling period, ns */
} teds_channel;

/** Flags of teds_power. */
enum {
    TEDS_POWER_BATTERY = 1,  /**< the board has a battery */
    TEDS_POWER_CHARGING = 2, /**< it is being charged */
    TEDS_POWER_FULL = 4,     /**< it is full */
    TEDS_POWER_IN_FIELD = 8, /**< a reader's field is present */
    TEDS_POWER_TOO_LOW = 16  /**< too low for a commit */
};

/** State of the supply. */
typedef struct teds_power {
    uint8_t flags;      /**< TEDS_POWER_… */
    uint8_t level;      /**< %, FF if unknown */
    uint16_t voltage;   /**< mV, FFFF if unknown */
    int16_t current;    /**< mA, positive while it charges, 7FFF if unknown */
    int8_t temperature; /**< degrees Celsius, 7F if unknown */
} teds_power;

/** Flags of teds_firmware, as About (128.21) reports them. The node itself adds those of Locate and Manage. */
enum {
    TEDS_FIRMWARE_LOCATES = 1,  /**< added by the node: the port has `locate` */
    TEDS_FIRMWARE_MANAGES = 2,  /**< added by the node: it takes packets of 128.23 */
    TEDS_FIRMWARE_ON_TRIAL = 4, /**< the boot loader reverts the running image unless it is confirmed */
    TEDS_FIRMWARE_PENDING = 8,  /**< another image starts at the next restart */
    TEDS_FIRMWARE_SIGNED = 16,  /**< the boot loader checks the owner's signature */
    TEDS_FIRMWARE_COUNTER = 32  /**< the boot loader keeps a security counter */
};

/** The firmware that is running. */
typedef struct teds_firmware {
    uint8_t flags;         /**< TEDS_FIRMWARE_… */
    uint8_t major, minor;  /**< its version, as in MCUboot's header */
    uint16_t patch;        /**< of the version */
    uint32_t build;        /**< of the version */
    uint8_t image[32];     /**< MCUboot's SHA256 TLV (of a longer digest its first 32 octets), zeros if there is none */
    const char *text;      /**< board and application, divided by the last `/`: at most 48 of A-Z a-z 0-9 . _ + - /; NULL: "" */
} teds_firmware;

/** A board, as the node sees it. It must outlive the node. */
typedef struct teds_port {
    /** First argument of each function. With port/bearssl it points to a structure that begins with a teds_bearssl. */
    void *user;

    /** @name Flash
     * Areas of whole erase pages at fixed addresses; raw flash, without a file system or a key-value store. */
    /** @{ */
    uint32_t slot_octets;     /**< octets of each slot, #TEDS_STAGING + 256 or more */
    uint32_t identity_octets; /**< octets of the identity area, 192 or more */
    uint8_t unit;             /**< octets of a write unit: 1, 2, 4, 8, 16 or 32 */
    uint8_t erased;           /**< an erased octet: FF or 00 */
    /** Erase an area, all of it. */
    int (*erase)(void *user, int area);
    /** Write whole units, ascending; the node writes each unit once after an erase. Return when it is in flash. */
    int (*write)(void *user, int area, uint32_t at, const uint8_t *octets, size_t length);
    /** Read from any octet on. */
    int (*read)(void *user, int area, uint32_t at, uint8_t *out, size_t length);
    /** @} */

    /** Draw random octets for keys and nonces. Good from the first call after a start; fails rather than be weak. */
    int (*random)(void *user, uint8_t *out, size_t length);

    /** @name Clock */
    /** @{ */
    /** Return ns since the start: never back, and without a wrap while the node runs. */
    uint64_t (*now)(void *user);
    uint32_t step;  /**< resolution of the clock, ns */
    uint16_t drift; /**< its tolerance, ppm */
    /** @} */

    /** @name Cryptography
     * teds_bearssl_fill or teds_psa_fill fill these in. Constant time, wherever a secret is involved. */
    /** @{ */
    /** Start a SHA-256 in `state`. */
    void (*sha256_start)(void *user, teds_sha256 *state);
    /** Add octets to it. */
    void (*sha256_update)(void *user, teds_sha256 *state, const uint8_t *octets, size_t length);
    /** Finish it. */
    void (*sha256_finish)(void *user, teds_sha256 *state, uint8_t out[32]);
    /** HMAC-SHA-256 of the parts one after another. */
    int (*hmac)(void *user, const uint8_t *key, size_t key_length, const teds_part *parts, size_t count,
                uint8_t out[32]);
    /** Make a P-256 key for `use`; return a reference to it, and its public point (04, x, y). */
    int (*p256_make)(void *user, int use, teds_key_ref *key, uint8_t point[65]);
    /** True if 65 octets, 04 first, are a point of the curve. */
    bool (*p256_good)(void *user, const uint8_t point[65]);
    /** ECDH of an agreeing key with a good point: the x-coordinate. */
    int (*p256_ecdh)(void *user, const teds_key_ref *key, const uint8_t peer[65], uint8_t out[32]);
    /** ECDSA over a SHA-256: r and s, 32 octets each. s may be high, the node replaces it by n - s. */
    int (*p256_sign)(void *user, const teds_key_ref *key, const uint8_t hash[32], uint8_t out[64]);
    /** True if the signature is good. The node has refused a high s before. */
    bool (*p256_verify)(void *user, const uint8_t point[65], const uint8_t hash[32], const uint8_t signature[64]);
    /** Drop an agreeing key after its one use; the node wipes the reference. NULL if there is nothing to drop. */
    void (*p256_drop)(void *user, teds_key_ref *key);
    /** AES-128-CCM, nonce of 13 octets, no associated data: text, then the tag. `in` and `out` may be the same. */
    int (*ccm_seal)(void *user, const uint8_t key[16], const uint8_t nonce[13], const uint8_t *in, size_t length,
                    uint8_t *out, size_t tag_length);
    /** The reverse: true if the tag is good. `in` (text and tag) and `out` do not overlap; `in` is never written, since
     * the node tries the keys of a session and of a half-open one on the same octets. */
    bool (*ccm_open)(void *user, const uint8_t key[16], const uint8_t nonce[13], const uint8_t *in, size_t length,
                     uint8_t *out, size_t tag_length);
    /** @} */

    /** @name Channels
     * All functions return at once. NULL if the board has none of that. */
    /** @{ */
    const teds_channel *channels; /**< constant table of the hardware */
    size_t channel_count;         /**< its entries */
    /** Read a sensor's value for `tick`; false if it is not valid (out of range, warming up, fault). */
    bool (*sample)(void *user, uint8_t channel, uint64_t tick, uint8_t *out);
    /** True if the hardware takes this raw value. */
    bool (*bears)(void *user, uint8_t channel, const uint8_t *octets);
    /** Apply a value that `bears` accepted. */
    void (*set)(void *user, uint8_t channel, const uint8_t *octets);
    /** Return the present set point. */
    void (*set_point)(void *user, uint8_t channel, uint8_t *out);
    /** Bring an actuator to its safe state. */
    void (*safe)(void *user, uint8_t channel);
    /** Arm the dead-man for `ms` (0: off): a hardware timer that calls the safe state by itself. */
    void (*arm)(void *user, uint8_t channel, uint16_t ms);
    /** Restart the dead-man: a good value came. */
    void (*kick)(void *user, uint8_t channel);
    /** Start a self-test. */
    void (*self_test)(void *user, uint8_t channel);
    /** True while a self-test runs. */
    bool (*testing)(void *user, uint8_t channel);
    /** True if a channel is faulty. */
    bool (*fault)(void *user, uint8_t channel);
    /** Return the state of the supply. */
    void (*power)(void *user, teds_power *out);
    /** @} */

    /** @name Firmware
     * Which board this is, what runs on it, and its updates (128.21 to 128.23). NULL if the board has none of that. */
    /** @{ */
    /** Describe the running firmware; `out` comes filled with zeros. Asked at the start, by About and after a change of
     * images, so it reads what is stored and remembers nothing itself. */
    void (*about)(void *user, teds_firmware *out);
    /** Begin to blink or beep (`seconds` > 0), or stop (0). The node calls it again with 0 when the time is over. */
    void (*locate)(void *user, uint8_t seconds);
    /** Answer one SMP packet with one SMP packet, both of version 2; return its octets, at most `room`, or 0 if there is
     * none (the station gets 11). `packet` and `out` share memory: read all of the packet before the first octet of the
     * answer is written. The node has checked that the packet is permitted now; reset (0/5) it answers itself. Nothing
     * takes longer than 1 s: erase a slot page by page as it is written. A confirmation is in flash when it returns.
     * Set it only if the boot loader checks the owner's signature, starts a new image on trial, reverts by itself, has one
     * image (number 0) and knows images by their SHA256 TLV; without #TEDS_FIRMWARE_SIGNED it is never called. */
    size_t (*manage)(void *user, const uint8_t *packet, size_t length, uint8_t *out, size_t room);
    uint16_t manage_octets; /**< longest packet of `manage` (buf_size of 0/6); 0: what a sealed command holds */
    /** Restart: a station asked for it and its reply has left, or an image was on trial for ten minutes. Without it
     * nothing is managed. */
    void (*restart)(void *user);
    /** @} */
} teds_port;

#ifdef __cplusplus
}
#endif

#endif
