/* What a node of the profile keeps, as C: a starting point for firmware, and the source of the figures in docs/node-cost.md.
 * Plain octets, the largest members first, so that no compiler adds more than the last word's padding. */
#ifndef TEDS_NODE_STATE_H
#define TEDS_NODE_STATE_H

#include <stdint.h>

#ifndef TEDS_MAX_MESSAGE
#define TEDS_MAX_MESSAGE 1024 /* the least that the profile allows (docs/profile.md, "Lengths") */
#endif

/* ---- security part ---- */

struct teds_flash_keys { /* written when the board is made; the UUID's key never changes */
    uint8_t private_key[32];
    uint8_t public_key[65];
    uint8_t key_signature[64]; /* field 102 */
    uint8_t uuid[10];
};

struct teds_flash_state { /* replaced whole, in one transaction; kept twice, the old one and the new one */
    uint32_t epoch;
    uint32_t sequence;
    uint8_t station[65]; /* P(station) */
    uint8_t ca[65];      /* P(CA) */
    uint8_t link_key[16];
    uint8_t state; /* factory, keyed, provisioned */
    uint8_t can_address;
};

struct teds_session { /* one for each session; two at least */
    uint32_t counter;
    uint32_t good_at;   /* ms, for the silence after which it may be replaced */
    uint8_t to_node[16];    /* k_sn */
    uint8_t to_station[16]; /* k_ns */
    uint8_t messages[32];   /* k_m */
    uint8_t link;
};

struct teds_half_open { /* one for each Open that waits for its first good frame; two at least */
    struct teds_session session;
    uint8_t reply[81]; /* En and the tag, for a repeated request */
};

struct teds_pending_agreement { /* one over all links, for 60 s */
    uint32_t until;
    uint32_t epoch;
    uint8_t link_key[16];
    uint8_t confirmation_key[32];
    uint8_t transcript[32];
    uint8_t station[65];
    uint8_t ca[65];
    uint8_t link;
};

struct teds_one_time_key { /* made ahead while nothing else is to do */
    uint8_t private_key[32];
    uint8_t public_key[65];
};

struct teds_link { /* one for each link: NFC, each pair of CAN addresses, each BLE connection */
    uint8_t last_request_digest[32];
    uint8_t last_reply[TEDS_MAX_MESSAGE];
    uint16_t last_reply_length;
    uint8_t transaction[2];
};

struct teds_message { /* one at a time: a request as it comes in, opened and answered in place */
    uint8_t octets[TEDS_MAX_MESSAGE];
    uint16_t length;
};

struct teds_security_ram { /* two sessions, NFC and one pair of CAN addresses */
    struct teds_session sessions[2];
    struct teds_half_open half_open[2];
    struct teds_pending_agreement pending;
    struct teds_one_time_key one_time;
    struct teds_link links[2];
    struct teds_message message;
    uint8_t open_counter[8]; /* c */
};

/* ---- measuring part ---- */

struct teds_arm { /* a trigger that a session waits for */
    uint8_t token_digest[16];
    uint32_t until;
    uint8_t stream;
};

struct teds_session_operation { /* beside each session */
    uint64_t lease_until; /* ns */
    uint64_t mark;
    uint64_t claimed; /* a bit for each channel */
    uint32_t drive_counter;
    struct teds_arm arms[3];
};

struct teds_stream { /* one for each stream */
    uint8_t filling[240];
    uint8_t sending[240];
    uint8_t key_schedule[176]; /* AES-128, expanded once */
    uint64_t start;
    uint64_t period;
    uint32_t counter;
    uint16_t length;
    uint8_t kind, n, run, session, channels[16], channel_count;
};

struct teds_operation_ram { /* two sessions with one stream each */
    struct teds_session_operation sessions[2];
    struct teds_stream streams[2];
};

struct teds_operation_ram_full { /* two sessions with two streams each */
    struct teds_session_operation sessions[2];
    struct teds_stream streams[4];
};

#endif
