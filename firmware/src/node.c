/* One node: which command may be run when (security-teds.md, 4), routing, and the commands that need little. */
#include "inside.h"

#define ADDRESS_NS (10u * TEDS_SECOND)
#define STRANGER_NS TEDS_SECOND
#define KEEP_NS (20u * TEDS_SECOND)

/* -- permission: the first question asked of a command --------------------------------------------------------------- */

static bool is_security_function(uint8_t function)
{
    return (function >= TEDS_REQUEST && function <= TEDS_CLOSE) ||
           (function >= TEDS_IDENTIFY && function <= TEDS_DRIVE);
}

static bool is_teds_function(const teds_command *command)
{
    return command->command_class == TEDS_CLASS_COMMON && command->function >= TEDS_QUERY &&
           command->function <= TEDS_UPDATE;
}

/* A board without channels offers none of operation.md. */
static bool measures(const teds_node *node, const teds_command *command)
{
#if TEDS_OPERATION
    return node->port->channel_count > 0 && teds_operation_knows(command);
#else
    (void)node;
    (void)command;
    return false;
#endif
}

/* No stranger's point arithmetic may hold up the values of a claimed actuator. */
static int spare_actuators(const teds_node *node)
{
#if TEDS_OPERATION
    if (!node->config->quick_points && teds_actuator_claimed(node)) {
        return -TEDS_BUSY;
    }
#else
    (void)node;
#endif
    return 0;
}

/* While a stream runs, plain Read and List beyond one a second get 17, together and over all links. */
static int hold_strangers_back(teds_node *node)
{
#if TEDS_OPERATION
    uint64_t now = teds_now(node);
    if (!teds_streams_running(node)) {
        return 0;
    }
    if (node->stranger_seen && now < node->stranger_at + STRANGER_NS) {
        return -TEDS_BUSY;
    }
    node->stranger_seen = true;
    node->stranger_at = now;
#else
    (void)node;
#endif
    return 0;
}

static int plain_security(teds_node *node, const teds_command *command, const teds_origin *origin)
{
    switch (command->function) {
    case TEDS_REQUEST:
    case TEDS_CONFIRM:
    case TEDS_SET_CAN_ADDRESS: return origin->arrival->tapped ? 0 : -TEDS_NOT_PERMITTED;
    case TEDS_OPEN:
        if (teds_in_factory(node)) {
            return -TEDS_WRONG_STATE;
        }
        return command->length == 89 ? spare_actuators(node) : 0;
    case TEDS_SEALED:
        return !teds_in_factory(node) && teds_any_on(node, origin->link) ? 0 : -TEDS_WRONG_STATE;
    case TEDS_IDENTIFY: return 0;
    case TEDS_PROVE: return spare_actuators(node);
    case TEDS_RESET: return teds_in_factory(node) ? 0 : -TEDS_NOT_PERMITTED;
    case TEDS_LIST: return hold_strangers_back(node);
    default: return -TEDS_NOT_PERMITTED; /* Close, and what measures */
    }
}

static int plain(teds_node *node, const teds_command *command)
{
    if (!is_teds_function(command) || command->function > TEDS_READ) {
        return -TEDS_NOT_PERMITTED;
    }
    return command->function == TEDS_READ ? hold_strangers_back(node) : 0;
}

static int inner_security(const teds_node *node, const teds_command *command)
{
    if (command->function == TEDS_OPEN || command->function == TEDS_SEALED) {
        return -TEDS_NOT_PERMITTED;
    }
    return command->function >= TEDS_SAMPLE && !measures(node, command) ? -TEDS_UNKNOWN_COMMAND : 0;
}

static int permitted(teds_node *node, const teds_command *command, const teds_origin *origin)
{
    int refused = 0;
    const bool inside = origin->session >= 0;
    if (command->command_class == TEDS_CLASS_SECURITY) {
        if (command->channel != 0 || !is_security_function(command->function)) {
            return -TEDS_UNKNOWN_COMMAND;
        }
        refused = inside ? inner_security(node, command) : plain_security(node, command, origin);
    } else if (!inside) {
        refused = plain(node, command);
    } else if (!measures(node, command) && !is_teds_function(command)) {
        refused = -TEDS_UNKNOWN_COMMAND;
    }
#if TEDS_OPERATION
    if (!refused && ((command->command_class == TEDS_CLASS_COMMON &&
                      (command->function == TEDS_WRITE || command->function == TEDS_UPDATE)) ||
                     (command->command_class == TEDS_CLASS_SECURITY && command->function == TEDS_SET_CAN_ADDRESS))) {
        refused = teds_demand_configuration(
            node, origin, command->command_class == TEDS_CLASS_COMMON && command->function == TEDS_WRITE);
    }
#endif
    return refused;
}

/* -- class 128, the small ones ---------------------------------------------------------------------------------------- */

void teds_node_identify(const teds_node *node, uint8_t out[23])
{
    const teds_state *state = &node->state;
    out[0] = 1;
    memcpy(out + 1, node->uuid, 10);
    out[11] = teds_in_factory(node) ? 0 : (state->flags & TEDS_PROVISIONED) != 0 ? 2 : 1;
    teds_put32(out + 12, state->epoch);
    teds_put32(out + 16, state->sequence);
    teds_put16(out + 20, TEDS_MAX_MESSAGE);
    out[22] = node->can.address;
}

static int identify(const teds_node *node, const teds_command *command, uint8_t *out)
{
    if (command->length != 0) {
        return -TEDS_BAD_FORM;
    }
    teds_node_identify(node, out);
    return 23;
}

static int prove(const teds_node *node, const teds_command *command, uint8_t *out)
{
    const teds_part parts[] = {{(const uint8_t *)"TEDS1 prove", 12}, {node->uuid, 10}, {command->payload, 32}};
    uint8_t hash[32];
    if (command->length != 32) {
        return -TEDS_BAD_FORM;
    }
    teds_sha256_parts(node, parts, 3, hash);
    return teds_sign(node, hash, out) == 0 ? 64 : -TEDS_FAILURE;
}

static int reset(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    uint8_t epoch[4], hash[32];
    const teds_part parts[] = {
        {(const uint8_t *)"TEDS1 reset", 12}, {node->uuid, 10}, {epoch, 4}, {command->payload, 32}};
    if (command->length != 32) {
        return -TEDS_BAD_FORM;
    }
    teds_put32(epoch, node->state.epoch);
    teds_sha256_parts(node, parts, 4, hash);
    if (teds_sign(node, hash, out) != 0) {
        return -TEDS_FAILURE;
    }
    if (!teds_in_factory(node)) {
        int failed;
#if TEDS_OPERATION
        teds_everything_safe(node);
#endif
        failed = teds_to_factory(node);
        if (failed) {
            return failed;
        }
        origin->after = TEDS_AFTER_END_ALL;
    }
    teds_pending_forget(node);
    return 64;
}

static int set_can_address(teds_node *node, const teds_command *command, const teds_origin *origin)
{
    teds_state state = node->state;
    uint64_t now = teds_now(node);
    int failed;
    if (command->length != 1 || command->payload[0] == 0 || command->payload[0] > TEDS_LAST_ADDRESS) {
        return -TEDS_BAD_FORM;
    }
    if (command->payload[0] != state.address) {
        if (node->address_written && now < node->address_written_at + ADDRESS_NS) {
            return -TEDS_BUSY;
        }
        state.address = command->payload[0];
        failed = teds_store_state(node, &state);
        if (failed) {
            return failed;
        }
        node->address_written = true;
        node->address_written_at = now;
    }
    node->can.moves_to = command->payload[0]; /* when the reply has left */
    node->can.moves_link = origin->link;
    return 0;
}

static int list(const teds_node *node, const teds_command *command, uint8_t *out)
{
    int32_t after = -1;
    uint16_t id;
    int length = 0, more;
    if (command->length != 0) {
        return -TEDS_BAD_FORM;
    }
    for (; (more = teds_next_id(node, after, &id)) > 0; after = id) {
        if ((size_t)length + 3 > TEDS_ROOM) {
            return -TEDS_TOO_LARGE;
        }
        teds_put16(out + length, id >> 8);
        out[length + 2] = (uint8_t)id;
        length += 3;
    }
    return more < 0 ? -TEDS_FAILURE : length;
}

/* -- routing ---------------------------------------------------------------------------------------------------------- */

/* A command that is permitted and whose length is right, other than Sealed. */
static int run_known(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    if (is_teds_function(command)) {
        switch (command->function) {
        case TEDS_QUERY: return teds_query(node, command, out);
        case TEDS_READ: return teds_read(node, command, out);
        case TEDS_WRITE: return teds_write(node, command, origin);
        default: return teds_update(node, command, origin, out);
        }
    }
    if (command->command_class == TEDS_CLASS_SECURITY && command->function < TEDS_SAMPLE) {
        switch (command->function) {
        case TEDS_REQUEST: return teds_request(node, command, origin, out);
        case TEDS_CONFIRM: return teds_confirm(node, command, origin);
        case TEDS_OPEN: return teds_open(node, command, origin, out);
        case TEDS_IDENTIFY: return identify(node, command, out);
        case TEDS_PROVE: return prove(node, command, out);
        case TEDS_RESET: return reset(node, command, origin, out);
        case TEDS_SET_CAN_ADDRESS: return set_can_address(node, command, origin);
        case TEDS_LIST: return list(node, command, out);
        default: /* Close */
            if (command->length != 0) {
                return -TEDS_BAD_FORM;
            }
            origin->after = TEDS_AFTER_END_SESSION;
            return 0;
        }
    }
#if TEDS_OPERATION
    return teds_operation_run(node, command, origin, out);
#else
    return -TEDS_UNKNOWN_COMMAND;
#endif
}

static int cut(teds_node *node, const uint8_t *frame, size_t length, const teds_origin *origin, teds_command *command)
{
    int refused;
    if (length < 6) {
        return -TEDS_BAD_FORM;
    }
    command->channel = teds_get16(frame);
    command->command_class = frame[2];
    command->function = frame[3];
    command->payload = frame + 6;
    command->length = length - 6;
    refused = permitted(node, command, origin);
    if (refused) {
        return refused;
    }
    return teds_get16(frame + 4) == command->length ? 0 : -TEDS_BAD_FORM;
}

/* The reply frame around a handler's outcome, whose payload stands at reply + 3. */
static size_t close_reply(uint8_t *reply, int outcome)
{
    reply[0] = outcome >= 0;
    if (outcome < 0) {
        reply[3] = (uint8_t)-outcome;
        outcome = 1;
    }
    teds_put16(reply + 1, (uint16_t)outcome);
    return 3 + (size_t)outcome;
}

static void run_after(teds_node *node, const teds_origin *origin)
{
    if (origin->after == TEDS_AFTER_END_ALL) {
        teds_end_everything(node);
    } else if (origin->after == TEDS_AFTER_END_SESSION) {
        teds_session_end(node, origin->session);
    }
}

/* The payload of Sealed's reply at `out`. The inner command is deciphered to the end of the reply's own room, which
 * nobody reads any more; its reply grows from the front. */
static int sealed(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    teds_taken taken = {0};
    uint8_t *reply = out + 4;
    uint8_t *inner = out + (TEDS_MAX_MESSAGE - 3) - (command->length >= 36 ? command->length - 20 : 0);
    size_t length;
    int outcome;
#if TEDS_OPERATION
    (void)teds_operation_poll(node, teds_now(node)); /* a lease that ran out before is over: this does not revive it */
#endif
    outcome = teds_take_sealed(node, origin->link, origin->arrival, command->payload, command->length, inner, &taken);
    if (outcome) {
        return outcome;
    }
    if (taken.session < 0) {
        outcome = -TEDS_NO_ROOM;
    } else {
        teds_command within;
        origin->session = taken.session;
        outcome = cut(node, inner, taken.length, origin, &within);
        if (!outcome) {
            outcome = run_known(node, &within, origin, reply + 3);
        }
        if (taken.counter == UINT32_MAX && origin->after == TEDS_AFTER_NOTHING) {
            origin->after = TEDS_AFTER_END_SESSION;
        }
    }
    outcome = teds_seal_reply(node, taken.to_station, taken.counter, out, close_reply(reply, outcome), &length);
    teds_wipe(&taken, sizeof taken);
    return outcome ? -TEDS_FAILURE : (int)length;
}

size_t teds_node_handle(teds_node *node, teds_link link, const teds_arrival *arrival, const uint8_t *frame,
                        size_t length, uint8_t *reply)
{
    teds_origin origin = {link, arrival, -1, TEDS_AFTER_NOTHING};
    teds_command command;
    int outcome;
    size_t octets;
    teds_sessions_expire(node, teds_now(node));
    if (length > TEDS_MAX_MESSAGE) {
        return close_reply(reply, -TEDS_TOO_LARGE);
    }
    outcome = cut(node, frame, length, &origin, &command);
    if (!outcome && command.command_class == TEDS_CLASS_SECURITY && command.function == TEDS_SEALED) {
        outcome = sealed(node, &command, &origin, reply + 3);
    } else if (!outcome) {
        outcome = run_known(node, &command, &origin, reply + 3);
    }
    octets = close_reply(reply, outcome);
    run_after(node, &origin);
    return octets;
}

/* -- stored replies ----------------------------------------------------------------------------------------------------- */

static bool is_being_sent(const teds_node *node, int8_t place)
{
    for (size_t i = 0; i < TEDS_CAN_LINES; i++) {
        if (node->can.lines[i].used && node->can.lines[i].out_state != TEDS_OUT_IDLE &&
            node->can.lines[i].out_reply == place) {
            return true;
        }
    }
#if TEDS_NFC
    if (node->nfc.answered && node->nfc.reply == place) {
        return true;
    }
#endif
#if TEDS_BLE
    return teds_ble_sends(node, place);
#else
    return false;
#endif
}

/* A link's place: its own, a free one, the oldest of those whose link has no session; of these rather one that is not
 * being sent. There is always one: there are more places than sessions. */
teds_stored_reply *teds_reply_place(teds_node *node, teds_link link)
{
    teds_stored_reply *found = NULL;
    bool found_sent = true;
    for (int8_t i = 0; i < TEDS_REPLIES; i++) {
        if (node->replies[i].used && node->replies[i].link == link) {
            return &node->replies[i];
        }
    }
    for (int8_t i = 0; i < TEDS_REPLIES; i++) {
        teds_stored_reply *each = &node->replies[i];
        bool sent = is_being_sent(node, i);
        if (each->used && teds_session_on(node, each->link) >= 0) {
            continue;
        }
        if (found == NULL || (found->used && !each->used) ||
            (found->used && ((found_sent && !sent) || (found_sent == sent && each->at < found->at)))) {
            found = each;
            found_sent = sent;
        }
    }
    if (found == NULL) {
        found = &node->replies[0];
    }
    for (size_t i = 0; i < TEDS_CAN_LINES; i++) {
        teds_line *line = &node->can.lines[i];
        if (line->out_state != TEDS_OUT_IDLE && line->out_reply == (int8_t)(found - node->replies)) {
            line->out_state = TEDS_OUT_IDLE;
        }
    }
#if TEDS_NFC
    node->nfc.answered = node->nfc.answered && node->nfc.reply != (int8_t)(found - node->replies);
#endif
#if TEDS_BLE
    teds_ble_forget(node, (int8_t)(found - node->replies));
#endif
    found->used = true;
    found->stored = false;
    found->link = link;
    return found;
}

/* Identify, Prove, List, Query and Read outside Sealed are always run anew. */
static bool always_anew(const uint8_t *frame, size_t length)
{
    if (length < 4) {
        return false;
    }
    if (frame[2] == TEDS_CLASS_COMMON) {
        return frame[3] == TEDS_QUERY || frame[3] == TEDS_READ;
    }
    return frame[2] == TEDS_CLASS_SECURITY &&
           (frame[3] == TEDS_IDENTIFY || frame[3] == TEDS_PROVE || frame[3] == TEDS_LIST);
}

teds_stored_reply *teds_answer(teds_node *node, teds_link link, const teds_arrival *arrival, const uint8_t *transaction,
                               size_t transaction_length, const uint8_t *frame, size_t length)
{
    const teds_part parts[] = {{transaction, transaction_length}, {frame, length < TEDS_MAX_MESSAGE ? length : TEDS_MAX_MESSAGE}};
    teds_stored_reply *place = teds_reply_place(node, link);
    uint8_t digest[32];
    teds_sha256_parts(node, parts, 2, digest);
    if (!place->stored || memcmp(digest, place->digest, 32) != 0 || teds_now(node) >= place->at + KEEP_NS ||
        always_anew(frame, length)) {
        place->stored = false;
        place->length = (uint16_t)(1 + teds_node_handle(node, link, arrival, frame, length, place->octets + 1));
        memcpy(place->digest, digest, 32);
        place->used = true; /* its link may have ended by its own command */
        place->stored = length <= TEDS_MAX_MESSAGE;
        place->link = link;
        place->at = teds_now(node);
    }
    return place;
}

/* -- the life of a node -------------------------------------------------------------------------------------------------- */

int teds_node_init(teds_node *node, const teds_config *config, const teds_port *port)
{
    uint8_t counter[8];
    int failed;
    memset(node, 0, sizeof *node);
    node->config = config;
    node->port = port;
    node->can.rx_line = -1;
    if (port->unit == 0 || port->unit > 32 || (port->unit & (port->unit - 1)) != 0 ||
        port->slot_octets < TEDS_STAGING + 256u || port->identity_octets < 192 ||
        (config->nfc.present && config->nfc.max_ndef != 0 && config->nfc.max_ndef < 160)) {
        return TEDS_E_USAGE;
    }
#if TEDS_OPERATION
    if (!teds_channels_good(port)) {
        return TEDS_E_USAGE;
    }
#endif
    failed = teds_store_load(node);
    if (failed) {
        return failed;
    }
    /* c of Open is random at each start, so that no mac from before it is good again */
    if (port->random(port->user, counter, sizeof counter) != 0) {
        return TEDS_E_RANDOM;
    }
    node->opens = teds_get64(counter);
    node->can.address = node->state.address;
#if TEDS_OPERATION
    teds_operation_start(node);
#endif
#if TEDS_NFC
    teds_nfc_start(node);
#endif
    return 0;
}

void teds_node_reply_left(teds_node *node, teds_link link)
{
#if TEDS_OPERATION
    teds_streams_ready(node, teds_session_on(node, link));
#endif
    if (node->can.moves_to != 0 && node->can.moves_link == link) {
        teds_can_move(node, node->can.moves_to);
    }
}

void teds_link_forget(teds_node *node, teds_link link)
{
    teds_session_end(node, teds_session_on(node, link));
    for (size_t i = 0; i < TEDS_SESSIONS; i++) {
        if (node->half_open[i].used && node->half_open[i].link == link) {
            teds_wipe(&node->half_open[i], sizeof node->half_open[i]);
        }
    }
    for (size_t i = 0; i < TEDS_REPLIES; i++) {
        if (node->replies[i].used && node->replies[i].link == link) {
            node->replies[i].used = false;
            node->replies[i].stored = false;
        }
    }
    if (node->pending.used && node->pending.link == link) {
        teds_pending_forget(node);
    }
}

void teds_node_link_lost(teds_node *node, teds_link link)
{
    teds_link_forget(node, link);
    if (node->can.moves_to != 0 && node->can.moves_link == link) {
        teds_can_move(node, node->can.moves_to); /* nobody waits for the reply any more */
    }
}

int teds_node_reset_by_hand(teds_node *node)
{
    int failed;
#if TEDS_OPERATION
    teds_everything_safe(node);
#endif
    failed = teds_in_factory(node) ? 0 : teds_to_factory(node); /* no write where nothing changes */
    if (failed) {
        return TEDS_E_FLASH;
    }
    teds_end_everything(node);
    return 0;
}

uint64_t teds_node_poll(teds_node *node, uint64_t now)
{
    uint64_t due, next = TEDS_NEVER;
    teds_sessions_expire(node, now);
#if TEDS_OPERATION
    next = teds_operation_poll(node, now);
#endif
#if TEDS_NFC
    teds_nfc_poll(node);
#endif
    due = teds_can_poll(node, now);
    next = due < next ? due : next;
    due = teds_store_poll(node, now);
    next = due < next ? due : next;
    due = teds_sessions_due(node);
    return due < next ? due : next;
}

bool teds_idle_work(teds_node *node)
{
    const teds_port *port = node->port;
    if (node->one_time.ready || port->p256_make(port->user, TEDS_KEY_AGREES, &node->one_time.key,
                                                node->one_time.point) != 0) {
        return false;
    }
    node->one_time.ready = true;
    return true;
}

uint64_t teds_node_missed(const teds_node *node)
{
#if TEDS_OPERATION
    uint64_t missed = node->missed;
    for (size_t i = 0; i < TEDS_STREAMS; i++) {
        missed += node->streams[i].used ? node->streams[i].missed : 0;
    }
    return missed;
#else
    (void)node;
    return 0;
#endif
}
