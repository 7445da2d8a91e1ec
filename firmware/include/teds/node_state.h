/* SPDX-License-Identifier: Apache-2.0 */
/** @file
 * The inside of a teds_node. It is public only so that a board can own a node without a heap: read and write it through
 * the functions of teds/node.h. Its members change without notice.
 */
#ifndef TEDS_NODE_STATE_H
#define TEDS_NODE_STATE_H

#include "teds/port.h"

#ifdef __cplusplus
extern "C" {
#endif

/** The station at the other end: F1 to F7 on CAN, #TEDS_LINK_NFC, #TEDS_LINK_BLE and up, one for each connection. */
typedef uint8_t teds_link;

/** Configuration by the application: defined in teds/node.h. */
typedef struct teds_config teds_config;

/** One node: static memory of the board, started by teds_node_init. */
typedef struct teds_node teds_node;

/** @cond INSIDE */

/* Layout of the identity area; octets alone, so without gaps. */
typedef struct teds_identity {
    uint8_t uuid[10];
    teds_key_ref key;
    uint8_t point[65], signature[64]; /* signature: field 102 */
} teds_identity;

/* Result of an agreement, as stored in a slot: link key, station, CA. */
typedef struct teds_agreed {
    uint8_t key[16], station[65], ca[65];
} teds_agreed;

typedef struct teds_state {
    uint8_t flags; /* 1 keyed, 2 provisioned */
    uint8_t address;
    uint32_t epoch, sequence;
    teds_agreed agreed;
} teds_state;

typedef struct teds_keys {
    uint8_t to_node[16], to_station[16], messages[32];
} teds_keys;

typedef struct teds_session {
    bool used;
    teds_link link;
    uint32_t counter;
    uint64_t good_at;
    teds_keys keys;
#if TEDS_OPERATION
    uint32_t claims;      /* bits by place in the port's channel table */
    uint64_t lease;       /* ns */
    uint64_t mark;
    uint16_t run;
    struct {
        bool armed;
        uint64_t until;
        uint8_t commitment[16];
    } arms[3];
    struct {
        bool used, fd, seen, begun;
        uint8_t count, segment, octets;
        uint8_t places[16];
        uint8_t key[16];
        uint8_t at;
        uint32_t last; /* highest counter with a good tag */
        uint8_t message[16 + TEDS_DRIVE_OCTETS];
    } drive;
#endif
} teds_session;

typedef struct teds_half_open {
    bool used;
    teds_link link;
    uint64_t until;
    teds_keys keys;
} teds_half_open;

typedef struct teds_stored_reply {
    uint64_t at;
    uint16_t length;
    bool used, stored;
    teds_link link;
    uint8_t digest[32];
    uint8_t octets[1 + TEDS_MAX_MESSAGE]; /* transaction, reply */
} teds_stored_reply;

typedef struct teds_one_time {
    bool ready;
    teds_key_ref key;
    uint8_t point[65];
} teds_one_time;

typedef struct teds_pending {
    bool used;
    teds_link link;
    teds_session *session; /* NULL: outside */
    uint64_t until;
    uint32_t epoch;
    teds_agreed agreed;
    uint8_t tag[16];
} teds_pending;

#if TEDS_OPERATION
#define TEDS_MESSAGE 240
typedef struct teds_stream {
    bool used, ready, waits, full, ended, late;
    teds_session *session;
    uint8_t number, kind, n, count, octets, pattern, flags, full_flags;
    bool fd, ble;
    uint8_t channels[16]; /* places in the port's table */
    uint8_t held;
    uint16_t gap, run, length, fill;
    uint32_t counter, full_counter;
    uint64_t period, start, missed, last_event;
    bool had_event;
    uint8_t key[16];
    uint8_t filling[TEDS_MESSAGE - 12], waiting[TEDS_MESSAGE - 12];
} teds_stream;
#endif

#if TEDS_OPERATION
/* Of one event sensor, interrupt to main loop: one side writes `in` and `lost`, the other `out` and `reported`. */
typedef struct teds_events {
    volatile uint8_t in, out;
    volatile uint16_t lost; /* found no room */
    uint16_t reported;
    volatile struct {
        uint64_t tick;
        bool valid;
        uint8_t octets[TEDS_EVENT_OCTETS];
    } ring[TEDS_EVENTS + 1];
} teds_events;
#endif

/* One station. Small members first, here and in teds_can: an offset that fits into an instruction costs nothing. */
typedef struct teds_line {
    uint8_t source; /* 0: not used */
    uint8_t own;
    bool fd;
    uint8_t flow;                    /* a flow control is due: its first octet, 0: none */
    uint8_t refuses, refused;        /* a refusal as a single frame: its reason, 0: none; of which transaction */
    bool asked, asked_fd;            /* a broadcast waits to be answered */
    uint8_t asked_transaction;
    /* The message being sent. */
    uint8_t out_state, out_number, out_block, out_waits;
    uint16_t out_length, out_at;
    uint32_t out_gap;             /* ns between consecutive frames */
    const uint8_t *out;
    teds_stored_reply *out_reply; /* NULL: a broadcast answer */
    uint32_t touched;             /* order of use: a greater value is later */
    uint64_t out_due;             /* next frame, or when a flow control is given up */
    uint64_t asked_due;
} teds_line;

#if TEDS_MANAGED
/* Of 128.23: the present upload, the start of the last one, and a restart that is due once its reply was sent. */
typedef struct teds_managed {
    teds_session *upload_of;   /* NULL: no upload */
    uint64_t upload_until, sha_until;
    uint32_t upload_octets;    /* of the whole image */
    bool begun, restarts;
    teds_link restart_link;
    uint8_t sha_length, sha[32];
} teds_managed;
#endif

typedef struct teds_can {
    uint8_t address, moves_to; /* moves_to: the address of 128.10, used once its reply was sent; 0: none */
    teds_link moves_link;
    bool announces;
    uint8_t bus_offs; /* in a row */
    uint8_t announced_at;
    uint8_t moves; /* caused by another node's claim, since the start or the last ten minutes without a conflict */
    bool gives_up; /* leave this address at move_at */
    bool pressed;  /* announce the press now */
    bool rx_wanted; /* another pair was refused during the reception of the present long request */
    bool turned_away_fd;
    uint8_t turned_away, turned_away_transaction; /* a station without a line, to be refused; 0: none */
    /* The one long request that may be being received. */
    uint8_t rx_number, rx_block, rx_frame; /* rx_frame: octets of its first frame, and so of all but the last */
    uint16_t rx_length, rx_at;
    teds_line *rx_line;
    uint64_t rx_until, rx_ends; /* time limits of its next frame, and of the whole request */
    uint64_t announce_due, back_at; /* back_at: end of the silence after bus-off */
    uint64_t move_at, conflict_at;
    uint32_t touches;
#if TEDS_OPERATION
    /* The one data message that is being sent. */
    teds_stream *data_stream;
    uint64_t data_free_at;
    uint16_t data_at, data_length;
    uint8_t data_segment;
    uint8_t data[TEDS_MESSAGE];
#endif
    uint8_t heard[30];
    uint8_t broadcast_answer[27]; /* shared by all lines, except its first octet, which is sent at once */
    uint32_t announced[20];
    uint32_t pressed_at, pressed_paid; /* the last announced press, and the budget of further ones */
} teds_can;

#if TEDS_NFC
typedef struct teds_nfc {
    bool selected, shows_initial, collects, answered;
    uint8_t stage, opened, file_open;
    uint8_t other; /* the selected service of the application, from 1 on; 0: none */
    teds_stored_reply *reply; /* the reply that the reader fetches in pieces */
    uint16_t transaction, total, held, answered_transaction, length, came;
    uint64_t tick, busy_until; /* busy_until: until then a reader may fetch an answer or continue its request */
    uint8_t shown[23]; /* the Identify in the initial message */
    uint8_t request[TEDS_MAX_MESSAGE];
    uint8_t file[2 + TEDS_MAX_NDEF]; /* NLEN, message */
} teds_nfc;
#endif

#if TEDS_BLE
typedef struct teds_ble_line {
    bool used, holds, sends, hears;
    teds_stored_reply *reply;
    uint16_t mtu, transaction, total, held, sent_transaction, at;
    uint64_t silent_since;
    uint8_t request[TEDS_MAX_MESSAGE];
} teds_ble_line;

typedef struct teds_ble {
    bool was_tapped;
    uint64_t tapped_at;
#if TEDS_OPERATION
    uint64_t data_free_at; /* all connections share one time on air */
#endif
    teds_ble_line lines[TEDS_BLE_CONNECTIONS];
} teds_ble;
#endif

/* Small members that are used often come first: an offset that fits into an instruction costs nothing. */
struct teds_node {
    const teds_port *port;
    const teds_config *config;
    uint8_t slot; /* the current slot */
    uint8_t firmware; /* flags of About, as last read */
    bool free_slot_dirty, old_slot_due;
    bool identity_changed; /* broadcast answers on CAN that began before have the old reply to Identify */
    bool spare_slot_fails; /* the spare slot could not be erased: the node answers, but writes nothing */
    teds_session *staging_of; /* NULL: none */
    uint16_t staging_end;
    uint32_t slot_counter, records_end;
    uint64_t opens; /* c */
    uint64_t staged_until; /* from then on another session may use the staging */
    uint64_t old_slot_by; /* from then on the old slot is erased, even if a station waits for a reply */
    uint64_t locate_until; /* 0: it does not blink */
    /* earliest time of another write of the address; of another plain Read, List or About during streams */
    uint64_t address_again, strangers_again;
#if TEDS_OPERATION
    uint32_t safe, stopped; /* bits by place */
    uint64_t missed;
#endif
#if TEDS_MANAGED
    teds_managed managed;
#endif
    teds_can can;
    teds_state state;
    teds_identity identity;
    teds_pending pending;
    teds_one_time one_time;
    teds_session sessions[TEDS_SESSIONS];
    teds_half_open half_open[TEDS_SESSIONS];
#if TEDS_OPERATION
    uint64_t deadline[TEDS_CHANNELS];
    uint16_t dead_man[TEDS_CHANNELS];
    teds_session *actuator_of[TEDS_CHANNELS]; /* which claims an actuator; NULL: none */
#endif
#if TEDS_OPERATION
    teds_stream streams[TEDS_STREAMS];
    teds_events events[TEDS_EVENT_CHANNELS];
#endif
    teds_line lines[TEDS_CAN_LINES];
    uint8_t rx[1 + TEDS_MAX_MESSAGE];
    teds_stored_reply replies[TEDS_REPLIES];
#if TEDS_NFC
    teds_nfc nfc;
#endif
#if TEDS_BLE
    teds_ble ble;
#endif
    uint8_t staging[TEDS_STAGING];
};

/** @endcond */

#ifdef __cplusplus
}
#endif

#endif
