/* SPDX-License-Identifier: Apache-2.0 */
/* Names that all of src/ shares: reasons, commands, the origin of a command. Not for boards.
 *
 * Handlers have the names of their commands (teds_request, teds_sample); other shared functions begin with their
 * subject (teds_session_end, teds_slots_write). Includes go one way; README.md lists the sources from the bottom up. */
#ifndef TEDS_INSIDE_H
#define TEDS_INSIDE_H

#include "octets.h"
#include "teds/node.h"

/* Reasons of refusals (security-teds.md 4, operation.md 8). Handlers return octets of payload, or a reason negated. */
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
    TEDS_DRIVE = 20,
    TEDS_ABOUT = 21,
    TEDS_LOCATE = 22,
    TEDS_MANAGE = 23
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
/* Payload that fits into a reply in a session: less headers, counter, tag and the longest padding. */
#define TEDS_ROOM (TEDS_MAX_MESSAGE - 42u)

typedef struct teds_command {
    uint16_t channel;
    uint8_t command_class, function;
    const uint8_t *payload;
    size_t length;
    const struct known *known; /* in the table of commands.c; NULL: Sealed */
} teds_command;

/* What ends after the reply was made. */
enum { TEDS_AFTER_NOTHING, TEDS_AFTER_END_SESSION, TEDS_AFTER_END_ALL };

typedef struct teds_origin {
    teds_link link;
    const teds_arrival *arrival;
    teds_session *session; /* NULL: outside a session */
    uint8_t after;
} teds_origin;

/* Runs a command whose length and permission were checked: writes the reply's payload to `out`, and returns its length
 * or a reason negated. */
typedef int teds_handler(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out);

static inline bool teds_has_nfc(const teds_node *node)
{
    return TEDS_NFC && node->config->nfc.present;
}
/* True if the boot loader will revert the running image unless it is confirmed: stored data must not change. */
static inline bool teds_on_trial(const teds_node *node)
{
    return TEDS_MANAGED && (node->firmware & TEDS_FIRMWARE_ON_TRIAL) != 0;
}
static inline bool teds_in_factory(const teds_node *node)
{
    return (node->state.flags & TEDS_KEYED) == 0;
}

#endif
