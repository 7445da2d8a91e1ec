/* A node (TIM) of the teds-provision profile: frames in, frames out.
 *
 * One teds_node is one node; there is nothing global. Nothing here allocates, recurses or blocks but inside a call of
 * the port's cryptography or flash. All functions are called from one thread or main loop.
 *
 * int functions give 0, or a negative TEDS_E_ for a misuse or a port that failed. What a peer did wrong is a refusal in
 * the reply, never an error of the call. Times are ns of the port's clock.
 */
#ifndef TEDS_NODE_H
#define TEDS_NODE_H

#include "teds/port.h"

enum {
    TEDS_E_USAGE = -1,    /* a port or configuration that cannot be */
    TEDS_E_FLASH = -2,    /* flash failed */
    TEDS_E_RANDOM = -3,   /* no randomness */
    TEDS_E_IDENTITY = -4, /* the identity area is torn: a node never makes a second key over one that it has shown */
    TEDS_E_CRYPTO = -5,
    TEDS_E_BUILD = -6 /* board and library were compiled with different options or sizes */
};

/* A link is the station's address: F1 to F7 on CAN, 1 on NFC, 2 and up on BLE. */
typedef uint8_t teds_link;

enum { TEDS_LINK_NFC = 1, TEDS_LINK_BLE = 2 };

enum { TEDS_CAN = 1, TEDS_AT_NFC = 2, TEDS_AT_BLE = 3 };

/* Where and when a command came. */
typedef struct teds_arrival {
    uint8_t kind;    /* TEDS_CAN, TEDS_AT_NFC, TEDS_AT_BLE */
    bool tapped;     /* it came over NFC, or the wired bus counts as tapped */
    bool fd;         /* by CAN FD */
    uint64_t tick;   /* when its last octet came */
} teds_arrival;

/* A TEDS that is part of the firmware and cannot be written; channel and code ascending in the table. */
typedef struct teds_fixed {
    uint8_t channel, code;
    uint16_t length;
    const uint8_t *octets; /* Length to Checksum */
} teds_fixed;

typedef struct teds_config {
    uint8_t uuid[10]; /* used at the very first start alone; afterwards the stored one counts */
    const teds_fixed *fixed;
    size_t fixed_count;
    bool quick_points; /* the chip's point arithmetic takes 5 ms at most */
    bool no_can;       /* the board has no CAN: Identify reports address 0, and 128.10 gets 1 */
    struct {
        bool present;      /* the board has an antenna: a tap is a tap, and its bus is never one */
        uint8_t wt_int;    /* how soon a reader may look for an answer: 2^(wt_int / 4 - 1) ms; multiples of 4 */
        uint8_t n_wait;    /* how often it may look again, at most 15 */
        uint16_t max_ndef; /* longest NDEF message of this tag, 160 or more; 0: TEDS_MAX_NDEF */
    } nfc;
    const uint8_t *ble_address; /* static random, 6 octets as people write them, told at a tap; NULL: no BLE */
} teds_config;

typedef struct teds_can_frame {
    uint32_t identifier; /* 29 bits */
    uint8_t length;
    bool fd;
    uint8_t data[TEDS_CAN_FD ? 64 : 8];
} teds_can_frame;

/* -- the inside; stands here so that a board can own it. Nothing outside src/ looks into it. ------------------------ */

/* As it lies in the identity area; octets alone, so without gaps. */
typedef struct teds_identity {
    uint8_t uuid[10];
    teds_key_ref key;
    uint8_t point[65], signature[64]; /* signature: field 102 */
} teds_identity;

/* What an agreement makes, as it lies in a slot: link key, station, CA. */
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
    uint8_t kind;
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
/* Of one event sensor, from its interrupt to the main loop: one side writes `in` and `lost`, the other `out` and `told`. */
typedef struct teds_events {
    volatile uint8_t in, out;
    volatile uint16_t lost; /* found no room */
    uint16_t told;
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
    bool asked, asked_fd;            /* a functional Identify waits for its time */
    uint8_t asked_transaction;
    /* what is being sent */
    uint8_t out_state, out_number, out_block, out_waits;
    uint16_t out_length, out_at;
    uint32_t out_gap;             /* ns between consecutive frames */
    const uint8_t *out;
    teds_stored_reply *out_reply; /* NULL: it is everyone's */
    uint32_t touched;             /* the later the greater */
    uint64_t out_due;             /* next frame, or when a flow control is given up */
    uint64_t asked_due;
} teds_line;

typedef struct teds_can {
    uint8_t address, moves_to; /* moves_to: where 128.10 leads once its reply has left; 0: nowhere */
    teds_link moves_link;
    bool announces;
    uint8_t bus_offs; /* in a row */
    uint8_t announced_at;
    uint8_t moves; /* because of another node's claim, since the start or the last ten minutes without a conflict */
    bool gives_up; /* this address, at move_at */
    bool rx_wanted; /* another pair was refused because of the long request that is coming in */
    bool turned_away_fd;
    uint8_t turned_away, turned_away_transaction; /* a station that finds no line is refused; 0: none */
    /* the one long request that may be coming in */
    uint8_t rx_number, rx_block, rx_frame; /* rx_frame: octets of its first frame, and so of all but the last */
    uint16_t rx_length, rx_at;
    teds_line *rx_line;
    uint64_t rx_until, rx_ends; /* its next frame, the whole of it */
    uint64_t announce_due, back_at; /* back_at: after bus-off it is silent until then */
    uint64_t move_at, conflict_at;
    uint32_t touches;
#if TEDS_OPERATION
    /* the one data message that is being sent */
    teds_stream *data_stream;
    uint64_t data_free_at;
    uint16_t data_at, data_length;
    uint8_t data_segment;
    uint8_t data[TEDS_MESSAGE];
#endif
    uint8_t heard[30];
    uint8_t everyone[27]; /* the answer to everyone: of all lines, but for its first octet, which leaves at once */
    uint32_t announced[20];
} teds_can;

#if TEDS_NFC
typedef struct teds_nfc {
    bool selected, shows_initial, collects, answered;
    uint8_t stage, opened, file_open;
    teds_stored_reply *reply; /* it is read in pieces */
    uint16_t transaction, total, held, answered_transaction, length, came;
    uint64_t tick, busy_until; /* busy_until: its reader has something to read, or will ask on */
    uint8_t shown[23]; /* the Identify that the initial message holds */
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
    uint64_t data_free_at; /* all connections are one bus */
#endif
    teds_ble_line lines[TEDS_BLE_CONNECTIONS];
} teds_ble;
#endif

/* What is small and asked for often stands first: an offset that fits into an instruction costs nothing. */
typedef struct teds_node {
    const teds_port *port;
    const teds_config *config;
    uint8_t slot; /* the one that counts */
    bool free_slot_dirty, old_slot_due;
    bool spare_slot_fails; /* it could not be erased when that was last tried: the node answers and writes nothing */
    teds_session *staging_of; /* NULL: nobody's */
    uint16_t staging_end;
    uint32_t slot_counter, records_end;
    uint64_t opens; /* c */
    uint64_t staged_until; /* then another session may take the staging */
    uint64_t old_slot_by; /* then the old slot is erased, whoever still waits for a reply */
    uint64_t address_again, strangers_again; /* from then on: a write of the address, a plain Read or List beside streams */
#if TEDS_OPERATION
    uint32_t safe, stopped; /* bits by place */
    uint64_t missed;
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
} teds_node;

/* -- public functions --------------------------------------------------------------------------------------------- */

/* All that board and library have to agree on, as one number: the sizes of what they share, and the options. */
static inline uint32_t teds_built(void)
{
    const uint32_t facts[] = {
        sizeof(teds_node), sizeof(teds_port), sizeof(teds_config), sizeof(teds_can_frame), sizeof(teds_channel),
        TEDS_MAX_MESSAGE, TEDS_STAGING, TEDS_SESSIONS, TEDS_REPLIES, TEDS_CAN_LINES, TEDS_CAN_FD, TEDS_OPERATION,
        TEDS_CHANNELS, TEDS_STREAMS, TEDS_DRIVE_OCTETS, TEDS_EVENT_CHANNELS, TEDS_EVENTS, TEDS_EVENT_OCTETS,
        TEDS_SHA256_OCTETS, TEDS_NFC, TEDS_MAX_NDEF, TEDS_BLE, TEDS_BLE_CONNECTIONS,
    };
    uint32_t built = 0;
    for (size_t i = 0; i < sizeof facts / sizeof facts[0]; i++) {
        built = (built ^ facts[i]) * 16777619u;
    }
    return built;
}

/* `built` is the board's teds_built: where it differs from the library's, TEDS_E_BUILD, and nothing is written. */
int teds_node_init_as_built(teds_node *node, uint32_t built, const teds_config *config, const teds_port *port);

/* Read both slots, take the newer good one, erase the other if it is not blank; make the identity key at the very first
 * start. A spare slot that cannot be erased stops no node whose other slot is whole: it refuses what would write (11).
 * `config` and `port` must outlive the node. Inline, so that it carries what the board was compiled with. */
static inline int teds_node_init(teds_node *node, const teds_config *config, const teds_port *port)
{
    return teds_node_init_as_built(node, teds_built(), config, port);
}

/* One whole command frame to one whole reply frame; gives its length. `frame` is never written and does not overlap
 * `reply`, which has room for TEDS_MAX_MESSAGE octets. Call teds_node_reply_left when its last frame was taken. */
size_t teds_node_handle(teds_node *node, teds_link link, const teds_arrival *arrival, const uint8_t *frame,
                        size_t length, uint8_t *reply);
void teds_node_reply_left(teds_node *node, teds_link link);

/* Loss of a link or field: its session, half-open Open, pending agreement and stored reply go. */
void teds_node_link_lost(teds_node *node, teds_link link);

/* The controller is off the bus: all CAN links are lost. Restart it at once, and teds_can_start: the node itself stays
 * silent for 1 s, doubling to 30 s while it recurs (operation.md, 6). */
void teds_node_bus_off(teds_node *node);

/* Button, pad or magnet held 5 s: the effect of Reset. 0, or TEDS_E_FLASH. */
int teds_node_reset_by_hand(teds_node *node);

/* What Identify says: 23 octets. */
void teds_node_identify(const teds_node *node, uint8_t out[23]);

/* Leases, samples, time-outs, erasing what is due. Gives when it is due again; UINT64_MAX: not by itself. */
uint64_t teds_node_poll(teds_node *node, uint64_t now);

/* Make the next one-time key while nothing else is to do; true where there was something to do. */
bool teds_idle_work(teds_node *node);

/* The controller is on the bus: announce after a random 0 to 500 ms. */
void teds_can_start(teds_node *node, uint64_t now);

/* A frame came; `tick` is its end. From the main loop, never from an interrupt: keep a ring of 20 frames or more. */
void teds_can_rx(teds_node *node, const teds_can_frame *frame, uint64_t tick);

/* The next frame that may leave now; false: none. Ask when the controller is free for one: commands and replies go
 * before data, and what is still here can be taken back. */
bool teds_can_tx(teds_node *node, teds_can_frame *frame, uint64_t now);

#if TEDS_NFC
/* A reader has activated the tag, or its field is gone: the session over NFC goes with it. */
void teds_nfc_field(teds_node *node, bool present);

/* For chips that keep the NDEF message themselves: a reader has written a whole one (the chip shows an empty message
 * from that moment on), and what the tag has to show now; look after each teds_node_poll. written: false where it is
 * empty or too long. */
bool teds_nfc_written(teds_node *node, const uint8_t *message, size_t length);
const uint8_t *teds_nfc_message(const teds_node *node, size_t *length);

/* For chips that hand over APDUs (ISO/IEC 7816-4): the response, with its status word. Commands that a reader wrote are
 * run by teds_node_poll, so ask soon. */
#define TEDS_T4T_OCTETS 258
size_t teds_t4t_apdu(teds_node *node, const uint8_t *apdu, size_t length, uint8_t out[TEDS_T4T_OCTETS]);

/* For chips that hand over frames: ISO-DEP. start takes a RATS and gives the ATS; it is an activation, too. block takes
 * a block without its CRC and gives the answer's octets, 0: silence. */
typedef struct teds_isodep {
    bool receives;
    uint8_t number, last;
    uint16_t information, length, at, last_at, last_length;
    uint8_t apdu[264];
} teds_isodep;
size_t teds_isodep_start(teds_node *node, teds_isodep *card, const uint8_t *rats, size_t length, uint8_t out[5]);
size_t teds_isodep_block(teds_node *node, teds_isodep *card, const uint8_t *block, size_t length, uint8_t out[256]);
#endif

#if TEDS_BLE
/* A connection (0 and up, below TEDS_BLE_CONNECTIONS) of the service d8570001-29b5-44d3-91d4-401ec8a7a4d4 began, has
 * another ATT MTU, ended. */
void teds_ble_connected(teds_node *node, uint8_t connection, uint16_t mtu);
void teds_ble_mtu(teds_node *node, uint8_t connection, uint16_t mtu);
void teds_ble_disconnected(teds_node *node, uint8_t connection);

/* d8570002-… was written; then the notifications of d8570003-… that are due, one a call, until 0. */
void teds_ble_written(teds_node *node, uint8_t connection, const uint8_t *value, size_t length);
size_t teds_ble_notify(teds_node *node, uint8_t connection, uint8_t out[512]);

#if TEDS_OPERATION
/* d8570004-…: a station has enabled its notifications, or disabled them, which ends its streams; the next of them that may
 * leave now and on which connection, 0: none (ask until then, after each teds_node_poll and each reply that has left); a
 * station wrote it, without response (Drive). */
#define TEDS_BLE_DATA 241
void teds_ble_hears(teds_node *node, uint8_t connection, bool hears);
size_t teds_ble_data(teds_node *node, uint8_t *connection, uint8_t out[TEDS_BLE_DATA]);
void teds_ble_driven(teds_node *node, uint8_t connection, const uint8_t *value, size_t length);
#endif

/* Whether to advertise now (for 60 s after a tap, and while it has a key), and whether to drop a connection (10 s without
 * a session). Ask twice a second. tapped is called by teds_nfc_field. */
void teds_ble_tapped(teds_node *node);
bool teds_ble_advertises(const teds_node *node);
bool teds_ble_drops(teds_node *node, uint8_t connection);
#endif

/* An event sensor has seen something at `tick`: the one function that an interrupt may call, each sensor from one of
 * its own. `octets` is a data set. Where its ring is full the event is lost, and the counter of its stream shows it. */
void teds_sensor_event(teds_node *node, uint8_t channel, uint64_t tick, const uint8_t *octets, bool valid);

/* Data messages that could not leave in time, since the start. */
uint64_t teds_node_missed(const teds_node *node);

#endif
