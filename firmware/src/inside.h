/* SPDX-License-Identifier: Apache-2.0 */
/* What the files of src/ ask of each other. Not for boards. */
#ifndef TEDS_INSIDE_H
#define TEDS_INSIDE_H

#include "octets.h"
#include "teds/node.h"

/* Why a node refuses (security-teds.md 4, operation.md 8). Handlers give octets of payload, or a reason negated. */
enum {
    TEDS_UNKNOWN_COMMAND = 1,
    TEDS_WRONG_STATE = 2,
    TEDS_NOT_PERMITTED = 3,
    TEDS_BAD_FORM = 4,
    TEDS_BAD_SIGNATURE = 5,
    TEDS_DIGEST_MISMATCH = 6,
    TEDS_STALE_SEQUENCE = 7,
    TEDS_WRONG_EPOCH = 8,
    TEDS_WRONG_UUID = 9,
    TEDS_TOO_LARGE = 10,
    TEDS_FAILURE = 11,
    TEDS_BAD_TAG = 12,
    TEDS_REPLAY = 13,
    TEDS_UNTRUSTED = 14,
    TEDS_BAD_POINT = 15,
    TEDS_UNKNOWN_KEY = 16,
    TEDS_BUSY = 17,
    TEDS_NO_SUCH_TEDS = 18,
    TEDS_OUT_OF_RANGE = 19,
    TEDS_TOO_LATE = 20,
    TEDS_DOES_NOT_FIT = 21,
    TEDS_NO_ROOM = 22,
    TEDS_FAULT_REASON = 23
};

enum { TEDS_CLASS_COMMON = 1, TEDS_CLASS_OPERATE = 3, TEDS_CLASS_EITHER = 4, TEDS_CLASS_SECURITY = 128 };

/* Functions of class 128. */
enum {
    TEDS_REQUEST = 1,
    TEDS_CONFIRM = 2,
    TEDS_OPEN = 3,
    TEDS_SEALED = 4,
    TEDS_CLOSE = 5,
    TEDS_NO_FUNCTION = 6,
    TEDS_IDENTIFY = 7,
    TEDS_PROVE = 8,
    TEDS_RESET = 9,
    TEDS_SET_CAN_ADDRESS = 10,
    TEDS_LIST = 11,
    TEDS_SAMPLE = 12,
    TEDS_SET = 13,
    TEDS_SUBSCRIBE = 14,
    TEDS_STOP = 15,
    TEDS_CLOCK = 16,
    TEDS_ARM = 17,
    TEDS_POWER = 18,
    TEDS_OPERATION_STATE = 19,
    TEDS_DRIVE = 20
};

/* Functions of class 1. */
enum { TEDS_QUERY = 1, TEDS_READ = 2, TEDS_WRITE = 3, TEDS_UPDATE = 4, TEDS_SELF_TEST = 5 };

#define TEDS_SECOND UINT64_C(1000000000)
#define TEDS_NEVER UINT64_MAX
#define TEDS_KEYED 1u
#define TEDS_PROVISIONED 2u
#define TEDS_LAST_ADDRESS 239u
#define TEDS_SECURITY_ID 0x0080u /* channel 0, access code 128 */
#define TEDS_INITIAL_OCTETS 237u
#define TEDS_OPEN_OCTETS 89u /* keyId, Es, mac */
/* Payload that a reply in a session carries: headers, counter, tag and the longest padding taken off. */
#define TEDS_ROOM (TEDS_MAX_MESSAGE - 42u)

typedef struct teds_command {
    uint16_t channel;
    uint8_t command_class, function;
    const uint8_t *payload;
    size_t length;
    const struct known *known; /* in the table of node.c; NULL: Sealed */
} teds_command;

/* What is to end when the reply is made. */
enum { TEDS_AFTER_NOTHING, TEDS_AFTER_END_SESSION, TEDS_AFTER_END_ALL };

typedef struct teds_origin {
    teds_link link;
    const teds_arrival *arrival;
    teds_session *session; /* NULL: outside */
    uint8_t after;
} teds_origin;

/* Runs a command whose length and permission are right: the reply's payload goes to `out`, its length or a reason
 * negated is given. */
typedef int teds_handler(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out);

uint64_t teds_now(const teds_node *node);
/* `due` becomes `at` where that is earlier. */
void teds_sooner(uint64_t *due, uint64_t at);

/* -- agree.c: Request, Confirm, hashes and keys ------------------------------------------------------------------- */
void teds_sha256_parts(const teds_node *node, const teds_part *parts, size_t count, uint8_t out[32]);
int teds_hkdf_expand(const teds_node *node, const uint8_t prk[32], const teds_part *info, size_t count, uint8_t *out,
                     size_t length);
/* The first of the parts is the key material, the others are the info. */
int teds_hkdf(const teds_node *node, const uint8_t salt[16], const teds_part *parts, size_t count, uint8_t *out,
              size_t length);
/* The first 16 octets of an HMAC. */
int teds_mac(const teds_node *node, const uint8_t *key, size_t key_length, const teds_part *parts, size_t count,
             uint8_t out[16]);
bool teds_point_good(const teds_node *node, const uint8_t point[65]);
/* Signatures are over the SHA-256 of the parts one after another. */
bool teds_verify(const teds_node *node, const uint8_t point[65], const teds_part *parts, size_t count,
                 const uint8_t signature[64]);
/* Whether this CA vouches for that station. */
bool teds_certified(const teds_node *node, const uint8_t station[65], const uint8_t ca[65],
                    const uint8_t signature[64]);
int teds_sign(const teds_node *node, const teds_part *parts, size_t count, uint8_t out[64]);
/* The one-time key of the next Request or Open, where it was not made ahead; dropped after its one use. */
int teds_one_time_make(teds_node *node);
void teds_one_time_drop(teds_node *node);
teds_handler teds_request, teds_confirm;
/* T; and Z, from it link key, node's tag and station's tag. Functions of their own, so that what they need is gone from
 * the stack when the reply is signed, which takes most of it. */
int teds_transcript(teds_node *node, const uint8_t *request, const uint8_t *reply_head, uint8_t out[32]);
int teds_agree(teds_node *node, const uint8_t *payload, const uint8_t nonce[16], const uint8_t script[32],
               uint8_t node_tag[16]);
void teds_pending_forget(teds_node *node);

/* -- session.c ----------------------------------------------------------------------------------------------------- */
teds_handler teds_open;
teds_session *teds_session_on(teds_node *node, teds_link link);
bool teds_any_on(teds_node *node, teds_link link);
/* Ends what is over; when the next of them is. */
uint64_t teds_sessions_poll(teds_node *node, uint64_t now);
typedef struct teds_taken {
    teds_session *session; /* NULL: there was no room for it */
    uint32_t counter;
    uint8_t to_station[16];
    size_t length; /* of the inner frame */
} teds_taken;
int teds_take_sealed(teds_node *node, teds_link link, const teds_arrival *arrival, const uint8_t *payload,
                     size_t length, uint8_t *plain, teds_taken *taken);
int teds_seal_reply(const teds_node *node, const uint8_t key[16], uint32_t counter, uint8_t *payload, size_t inner,
                    size_t *length);
void teds_session_end(teds_node *node, teds_session *session);
void teds_end_everything(teds_node *node);
/* Loss of a link, but for the move that 128.10 may have left. */
void teds_link_forget(teds_node *node, teds_link link);

/* -- security_teds.c ----------------------------------------------------------------------------------------------- */
enum { TEDS_SIGNATURE, TEDS_STATION, TEDS_STATION_SIGNATURE }; /* 100, 103, 104 */
typedef struct teds_signed {
    uint8_t decoded[3][66]; /* these fields without their base64 */
    bool others;            /* 101 or 102 is not this node's own */
    uint32_t numbers[2];    /* 106 sequence, 107 key epoch */
    const uint8_t *blocks;  /* the first tuple of type 108 */
    size_t block_count;
    size_t signature_at; /* of its tuple, in the data block */
} teds_signed;
void teds_initial(const teds_node *node, uint8_t out[TEDS_INITIAL_OCTETS]);
bool teds_security_parse(const teds_node *node, const uint8_t *block, size_t length, teds_signed *out);
uint16_t teds_checksum(const uint8_t *octets, size_t length);
bool teds_own_check(uint8_t code, const uint8_t *teds, size_t length);

/* -- teds_store.c -------------------------------------------------------------------------------------------------- */
/* A TEDS is named channel << 8 | access code. */
typedef struct teds_source {
    uint32_t length, at;
    const uint8_t *octets; /* NULL: in flash, at `at`; the initial Security TEDS: length alone */
    bool initial, read_only, unreadable;
} teds_source;
int teds_store_load(teds_node *node);
bool teds_storable(uint16_t channel, uint8_t code);
bool teds_find(const teds_node *node, uint16_t id, teds_source *out);
/* What stands there after a commit: the staged image, or else what teds_find finds. */
bool teds_find_new(const teds_node *node, uint16_t id, teds_source *out);
int teds_source_read(const teds_node *node, const teds_source *source, uint32_t at, uint8_t *out, size_t length);
int teds_source_hash(const teds_node *node, const teds_source *source, uint8_t out[32]);
/* Of these, the lowest id above `after` (-1: the first); TEDS_NO_ID at the end, TEDS_UNREADABLE where flash failed. */
enum { TEDS_NO_ID = 0x10000, TEDS_UNREADABLE = 0x10001 };
enum { TEDS_STORED = 1, TEDS_NOT_STORED = 2, TEDS_STAGED = 4 }; /* NOT_STORED: fixed ones, and the Security TEDS */
int32_t teds_next_id(const teds_node *node, int32_t after, unsigned among);
/* Through the tuples of a TEDS: type 1, length `width`, value. */
typedef struct teds_walk {
    const teds_node *node;
    teds_source source;
    uint32_t at, end, width;
} teds_walk;
uint32_t teds_number_at(const teds_walk *in, uint32_t at, uint32_t octets);
bool teds_next_tuple(teds_walk *in, uint8_t *type, uint32_t *value, uint32_t *length);
teds_handler teds_query, teds_read, teds_write, teds_update;
const uint8_t *teds_staged(const teds_node *node, uint16_t id, size_t *length);
void teds_staging_drop(teds_node *node);
int teds_make_blank(teds_node *node);
/* Write a whole new state, with the TEDS that stay. A commit says which it lists, and what is staged comes to them;
 * without one (NULL) all stay, but for the Security TEDS where the new state is not provisioned. */
int teds_store_write(teds_node *node, const teds_state *state, const teds_signed *commit);
/* Erase the old slot where nobody waits for anything. */
void teds_store_poll(teds_node *node, uint64_t now);

/* -- commit.c ------------------------------------------------------------------------------------------------------ */
int teds_commit(teds_node *node);
/* Its last step; apart, so that the new state is not on the stack beside a verification. */
int teds_commit_state(teds_node *node, const teds_signed *teds);
int teds_to_factory(teds_node *node);
bool teds_lists(const teds_signed *teds, uint16_t id);

/* -- node.c -------------------------------------------------------------------------------------------------------- */
teds_stored_reply *teds_reply_place(teds_node *node, teds_link link);
/* As many places of stored replies as sessions: the compiler leaves the question out of every other build. */
#define TEDS_PLACES_MAY_LACK (TEDS_REPLIES == TEDS_SESSIONS)
/* Run a request, or take up the stored reply of an octet-equal one: the reply's place, octets from 1 on; NULL: there is
 * none, nothing was run (never where there are more places than sessions). */
teds_stored_reply *teds_answer(teds_node *node, teds_link link, const teds_arrival *arrival, const uint8_t *transaction,
                               size_t transaction_length, const uint8_t *frame, size_t length);
static inline bool teds_has_nfc(const teds_node *node)
{
    return TEDS_NFC && node->config->nfc.present;
}
static inline bool teds_in_factory(const teds_node *node)
{
    return (node->state.flags & TEDS_KEYED) == 0;
}

/* As Identify and Announce tell it: 0 factory, 1 keyed, 2 provisioned. */
uint8_t teds_state_octet(const teds_node *node);

/* -- isotp.c ------------------------------------------------------------------------------------------------------- */
enum { TEDS_OUT_IDLE, TEDS_OUT_FIRST, TEDS_OUT_WAITS, TEDS_OUT_RUNS };
void teds_isotp_begin(teds_line *line, const uint8_t *octets, size_t length, bool fd);
bool teds_isotp_next(teds_line *line, teds_can_frame *frame, uint64_t now);
#define TEDS_N_BS TEDS_SECOND /* a flow control is waited for so long */
uint32_t teds_isotp_gap(uint8_t stmin);
void teds_isotp_flow(teds_line *line, const uint8_t *data, size_t length, uint64_t now);
bool teds_isotp_single(const uint8_t *data, size_t length, const uint8_t **body, size_t *octets);
void teds_can_pad(teds_can_frame *frame, size_t used);

/* -- can.c --------------------------------------------------------------------------------------------------------- */
void teds_can_move(teds_node *node, uint8_t address);
bool teds_can_sending(const teds_node *node);
/* What Identify says is another thing from now on: answers to everyone that are under way end. */
void teds_can_identity_changed(teds_node *node);
uint64_t teds_can_poll(teds_node *node, uint64_t now);
uint8_t teds_default_address(const teds_node *node);

/* -- ndef.c, tnep.c, t4t.c ----------------------------------------------------------------------------------------- */
#if TEDS_NFC
#define TEDS_TIM_TYPE "teds-provision:tim"
enum { TEDS_NDEF_WELL_KNOWN = 1, TEDS_NDEF_MIME = 2, TEDS_NDEF_EXTERNAL = 4, TEDS_NDEF_BEGINS = 0x80, TEDS_NDEF_ENDS = 0x40 };
enum { TEDS_NFC_QUIET, TEDS_NFC_WRITTEN };
/* What of a message the profile looks at; NULL: no such record. */
typedef struct teds_ndef {
    bool any, charges; /* the first record says how the reader charges */
    bool chunked;      /* a record came in chunks, which are put together: behind them the message is no message any more */
    const uint8_t *selection, *payload;
    size_t selection_length, payload_length;
} teds_ndef;
bool teds_ndef_read(uint8_t *message, size_t length, teds_ndef *out);
/* A record up to its payload; gives its octets. */
size_t teds_ndef_head(uint8_t *at, uint8_t marks, uint8_t tnf, const char *type, size_t type_length, size_t payload);
/* True if the application's services have names and room in the initial message. */
bool teds_nfc_services_good(const teds_config *config);
void teds_nfc_start(teds_node *node);
void teds_nfc_came(teds_node *node, size_t length);
void teds_nfc_poll(teds_node *node);
#endif

/* -- ble.c ----------------------------------------------------------------------------------------------------------- */
#if TEDS_BLE
bool teds_ble_sends(const teds_node *node, const teds_stored_reply *reply);
void teds_ble_forget(teds_node *node, const teds_stored_reply *reply);
/* Octets of the longest data message of a connection; 0: its station does not hear them. */
uint16_t teds_ble_longest(const teds_node *node, teds_link link);
#endif

/* -- operation.c, stream.c ----------------------------------------------------------------------------------------- */
#if TEDS_OPERATION
bool teds_channels_good(const teds_port *port);
void teds_operation_start(teds_node *node);
teds_handler teds_operate, teds_idle, teds_read_data_set, teds_write_data_set, teds_self_test, teds_sample, teds_set,
    teds_clock, teds_power_state, teds_operation_state;
int teds_demand_configuration(teds_node *node, const teds_origin *origin, bool writes);
void teds_yield_sensors(teds_node *node, teds_session *session);
void teds_claims_end(teds_node *node, teds_session *session, uint32_t places, bool stopped);
void teds_everything_safe(teds_node *node);
uint64_t teds_operation_poll(teds_node *node, uint64_t now);
bool teds_actuator_claimed(const teds_node *node);
int teds_place_of(const teds_node *node, uint8_t channel);
bool teds_value(const teds_node *node, int place, uint64_t tick, uint8_t *out);
int teds_channel_fits(const teds_node *node, int place, uint64_t *period);
int teds_channel_list(const uint8_t *octets, size_t length, size_t most);

int teds_apply(teds_node *node, const uint8_t *pairs, size_t length);
bool teds_is_claimed(const teds_origin *origin, int place);
int teds_run_key(const teds_node *node, const teds_session *session, const char *label, size_t length, uint8_t out[16]);

teds_handler teds_drive;
void teds_drive_frame(teds_node *node, teds_link link, const uint8_t *octets, size_t length);
void teds_drive_message(teds_node *node, teds_link link, const uint8_t *octets, size_t length);
void teds_drive_end(teds_session *session, uint32_t places);

teds_handler teds_subscribe, teds_stop, teds_arm;
void teds_trigger(teds_node *node, teds_link link, const uint8_t *token, uint64_t tick);
void teds_streams_sample(teds_node *node, uint64_t now);
uint64_t teds_streams_due(teds_node *node);
void teds_streams_end(teds_node *node, teds_session *session, uint32_t places);
void teds_streams_ready(teds_node *node, teds_session *session);
bool teds_streams_running(const teds_node *node);
bool teds_data_next(teds_node *node, teds_can_frame *frame, uint64_t now);
/* A data message over BLE: stream, message; 0: none may leave now. */
size_t teds_data_notify(teds_node *node, teds_link *link, uint8_t *out, uint64_t now);
uint64_t teds_data_due(teds_node *node);
#endif

#endif
