/* What a board gives to its node: flash, randomness, cryptography, a clock, its channels.
 *
 * Function pointers and a `user` each, so that two nodes live in one process. Functions that return int give 0 when it
 * was done, anything else when it was not; the node then refuses with reason 11 and changes nothing.
 */
#ifndef TEDS_PORT_H
#define TEDS_PORT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "teds/config.h"

/* Areas of flash: the identity is written once, the slots take turns. */
enum { TEDS_IDENTITY = 0, TEDS_SLOT_A = 1, TEDS_SLOT_B = 2 };

/* A private key as the port knows it: the scalar of a key in software, the slot of a secure element, a PSA key id.
 * The node stores that of its identity key in the identity area and never looks inside. */
typedef struct teds_key_ref {
    uint8_t octets[32];
} teds_key_ref;

/* What a key is made for. A signing key is kept for good; an agreeing one lives for one Request or one Open. */
enum { TEDS_KEY_SIGNS = 0, TEDS_KEY_AGREES = 1 };

typedef union teds_sha256 {
    uint64_t align;
    void *align_pointer;
    uint8_t octets[TEDS_SHA256_OCTETS];
} teds_sha256;

typedef struct teds_part {
    const uint8_t *octets;
    size_t length;
} teds_part;

/* Kinds of a channel as ChanType has them. */
enum { TEDS_SENSOR = 0, TEDS_ACTUATOR = 1, TEDS_EVENT_SENSOR = 2 };

/* A channel as the firmware knows it (operation.md, 1: the TEDS does not command the hardware). */
typedef struct teds_channel {
    uint8_t number; /* 1 to 255, ascending in the table */
    uint8_t kind;
    uint8_t model;  /* DatModel */
    uint8_t octets; /* ModLenth */
    uint8_t halt;   /* ActHalt; of actuators */
    uint32_t shortest; /* shortest period, ns */
} teds_channel;

enum {
    TEDS_POWER_BATTERY = 1,
    TEDS_POWER_CHARGING = 2,
    TEDS_POWER_FULL = 4,
    TEDS_POWER_IN_FIELD = 8,
    TEDS_POWER_TOO_LOW = 16
};

typedef struct teds_power {
    uint8_t flags;
    uint8_t level;       /* %, FF unknown */
    uint16_t voltage;    /* mV, FFFF unknown */
    int16_t current;     /* mA, + charges, 7FFF unknown */
    int8_t temperature;  /* degrees Celsius, 7F unknown */
} teds_power;

typedef struct teds_port {
    void *user;

    /* -- flash. Areas of whole erase pages; a slot holds TEDS_STAGING + 256 octets or more. ------------------- */
    uint32_t slot_octets;
    uint32_t identity_octets; /* 192 or more */
    uint8_t unit;   /* 1, 2, 4, 8, 16 or 32: writes are whole units, ascending, each unit once after an erase */
    uint8_t erased; /* 0xFF or 0x00 */
    int (*erase)(void *user, int area);
    int (*write)(void *user, int area, uint32_t at, const uint8_t *octets, size_t length);
    int (*read)(void *user, int area, uint32_t at, uint8_t *out, size_t length);

    /* -- randomness: fails rather than be weak; good from the first moment after a start ---------------------- */
    int (*random)(void *user, uint8_t *out, size_t length);

    /* -- the clock: ns since the start, never back, never wrapped while the node is up ------------------------- */
    uint64_t (*now)(void *user);
    uint32_t step;  /* of that clock, ns */
    uint16_t drift; /* ppm */

    /* -- cryptography ------------------------------------------------------------------------------------------ */
    void (*sha256_start)(void *user, teds_sha256 *state);
    void (*sha256_update)(void *user, teds_sha256 *state, const uint8_t *octets, size_t length);
    void (*sha256_finish)(void *user, teds_sha256 *state, uint8_t out[32]);
    /* HMAC-SHA-256 of the parts one after another. */
    int (*hmac)(void *user, const uint8_t *key, size_t key_length, const teds_part *parts, size_t count,
                uint8_t out[32]);
    int (*p256_make)(void *user, int use, teds_key_ref *key, uint8_t point[65]);
    /* Whether 65 octets that begin with 04 are a point of the curve. */
    bool (*p256_good)(void *user, const uint8_t point[65]);
    /* x-coordinate of the ECDH of an agreeing key. */
    int (*p256_ecdh)(void *user, const teds_key_ref *key, const uint8_t peer[65], uint8_t out[32]);
    /* ECDSA over a SHA-256, r and s of 32 octets each; s may be high, the node turns it. */
    int (*p256_sign)(void *user, const teds_key_ref *key, const uint8_t hash[32], uint8_t out[64]);
    /* Whether it verifies; the node has refused a high s before. */
    bool (*p256_verify)(void *user, const uint8_t point[65], const uint8_t hash[32], const uint8_t signature[64]);
    /* An agreeing key is used up; its octets are wiped by the node afterwards. NULL where nothing is to be done. */
    void (*p256_drop)(void *user, teds_key_ref *key);
    /* AES-128-CCM, nonce of 13 octets, no associated data. seal: in and out may be the same place, the tag follows the
     * text. open: in (text and tag) and out do not overlap, in is never written. */
    int (*ccm_seal)(void *user, const uint8_t key[16], const uint8_t nonce[13], const uint8_t *in, size_t length,
                    uint8_t *out, size_t tag_length);
    bool (*ccm_open)(void *user, const uint8_t key[16], const uint8_t nonce[13], const uint8_t *in, size_t length,
                     uint8_t *out, size_t tag_length);

    /* -- channels; all return at once. NULL where the board has none of that ----------------------------------- */
    const teds_channel *channels;
    size_t channel_count;
    /* The value of a sensor; false where it is not valid (out of range, warming up, fault). */
    bool (*sample)(void *user, uint8_t channel, uint64_t tick, uint8_t *out);
    /* Actuators: whether the hardware bears a raw value; give it; its present set point; its safe state; the hardware
     * timer of its dead-man, armed for ms (0: off) and kicked by each good value. */
    bool (*bears)(void *user, uint8_t channel, const uint8_t *octets);
    void (*set)(void *user, uint8_t channel, const uint8_t *octets);
    void (*set_point)(void *user, uint8_t channel, uint8_t *out);
    void (*safe)(void *user, uint8_t channel);
    void (*arm)(void *user, uint8_t channel, uint16_t ms);
    void (*kick)(void *user, uint8_t channel);
    void (*self_test)(void *user, uint8_t channel);
    bool (*testing)(void *user, uint8_t channel);
    bool (*fault)(void *user, uint8_t channel);
    void (*power)(void *user, teds_power *out);
} teds_port;

#endif
