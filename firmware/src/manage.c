/* SPDX-License-Identifier: Apache-2.0 */
/* Manage (profile.md, "Firmware"): one SMP packet in, one out. The port's manager gets a packet only if it is on a
 * short list, has an unambiguous body and comes at a safe time. Two packets in one, erasing storage, making an image
 * permanent before it ran, and recovery modes are always refused. The boot loader decides if an image may run. */
#include "manage.h"
#include "about.h"
#include "clock.h"
#include "security_teds.h"
#include "inside.h"

#if TEDS_MANAGED

#define HEADER_OCTETS 8u
#define SHORTEST (HEADER_OCTETS + 1u)
/* The longest packet: less a sealed command's headers, counter, tag and longest padding. */
#define LONGEST (TEDS_MAX_MESSAGE - 53u)
#define UPLOAD_NS (60u * TEDS_SECOND)   /* an upload ends after so long without a good packet */
#define ANOTHER_NS (10u * TEDS_SECOND)  /* between starts of different uploads, because each erases flash */
#define TRIAL_NS (600u * TEDS_SECOND)
#define SHA_OCTETS 32u
#define DEPTH 8u /* nesting limit of maps and arrays */
#define AN_ANSWER 1u /* bit in the first octet of an answer */

/* -- a CBOR reader (RFC 8949) for this filter ---------------------------------------------------------------------- */

enum { UNSIGNED = 0, OCTETS = 2, TEXT = 3, ARRAY = 4, MAP = 5, TAG = 6, SIMPLE = 7 };
enum { FALSE_VALUE = 20, NULL_VALUE = 22 }; /* simple values; between them lies true, and no other one is accepted */
#define OPEN_END 31u /* of an array or map of indefinite length; as a simple value, its end */

typedef struct reading {
    const uint8_t *at, *end;
} reading;

typedef struct item {
    uint8_t major;
    bool open;
    uint32_t value;        /* number, length or count; UINT32_MAX if it is more */
    const uint8_t *octets; /* of a string: where they begin */
} item;

/* Read an item's head, and a string's octets; false if it is cut off or of a kind that is never accepted (tags,
 * floating numbers, strings in pieces, text that is not UTF-8). */
static bool read_item(reading *in, item *out)
{
    uint8_t additional;
    if (in->at == in->end) {
        return false;
    }
    out->major = (uint8_t)(*in->at >> 5);
    additional = *in->at++ & 31u;
    out->open = additional == OPEN_END;
    out->value = additional;
    out->octets = in->at;
    if (out->open) {
        return out->major == ARRAY || out->major == MAP || out->major == SIMPLE;
    }
    if (out->major == TAG || additional > 27 ||
        (out->major == SIMPLE && (additional < FALSE_VALUE || additional > NULL_VALUE))) {
        return false;
    }
    if (additional >= 24) {
        const size_t octets = (size_t)1 << (additional - 24u);
        bool more = false;
        if (octets > (size_t)(in->end - in->at)) {
            return false;
        }
        out->value = 0;
        for (size_t i = 0; i < octets; i++) {
            more = more || out->value > 0xFFFFFFu;
            out->value = out->value << 8 | *in->at++;
        }
        out->value = more ? UINT32_MAX : out->value;
    }
    out->octets = in->at;
    if (out->major == OCTETS || out->major == TEXT) {
        if (out->value > (size_t)(in->end - in->at)) {
            return false;
        }
        in->at += out->value;
    }
    return out->major != TEXT || teds_is_utf8(out->octets, out->value);
}

/* Members of an upload's packet, or of the answer to one. */
typedef struct packet_map {
    bool off_there, length_there, sha_there, refuses, complete;
    uint32_t off, length;
    const uint8_t *sha;
    uint8_t sha_length;
} packet_map;

enum { IGNORED_MEMBER, OFF, LENGTH, SHA, REFUSAL, MATCH };

static unsigned find_key(const item *key)
{
    static const struct {
        const char *name;
        uint8_t length, key;
    } known[] = {{"off", 3, OFF},    {"len", 3, LENGTH},  {"sha", 3, SHA},
                 {"rc", 2, REFUSAL}, {"err", 3, REFUSAL}, {"match", 5, MATCH}};
    for (size_t i = 0; i < sizeof known / sizeof known[0]; i++) {
        if (key->value == known[i].length && memcmp(key->octets, known[i].name, key->value) == 0) {
            return known[i].key;
        }
    }
    return IGNORED_MEMBER;
}

/* Store a value; false for another type or a duplicate, of which the manager could use the other one. */
static bool note_value(packet_map *out, unsigned key, const item *value)
{
    bool good = true;
    switch (key) {
    case OFF:
        good = !out->off_there && value->major == UNSIGNED;
        out->off_there = true;
        out->off = value->value;
        break;
    case LENGTH:
        good = !out->length_there && value->major == UNSIGNED;
        out->length_there = true;
        out->length = value->value;
        break;
    case SHA:
        good = !out->sha_there && value->major == OCTETS && value->value <= SHA_OCTETS;
        out->sha_there = true;
        out->sha = value->octets;
        out->sha_length = (uint8_t)value->value;
        break;
    case REFUSAL: out->refuses = true; break;
    case MATCH: out->complete = true; break;
    default: break;
    }
    return good;
}

/* A map or array that is being read. */
typedef struct level {
    bool map, open, odd; /* odd: a key was read, its value is next */
    uint32_t left;
} level;

/* True if the octets are one map and nothing else, with keys of text alone, at every depth. `plain`: of definite length
 * and without nested maps or arrays. `out` receives the members of the outer map; NULL: they are skipped. */
static bool read_map(const uint8_t *octets, size_t length, bool plain, packet_map *out)
{
    reading in = {octets, octets + length};
    level levels[DEPTH];
    size_t depth = 0;
    unsigned key = IGNORED_MEMBER;
    memset(levels, 0, sizeof levels);
    do {
        level *in_it = depth > 0 ? &levels[depth - 1] : NULL;
        item it;
        if (!read_item(&in, &it) || (in_it == NULL && it.major != MAP)) {
            return false;
        }
        if (it.major == SIMPLE && it.open) {
            if (in_it == NULL || !in_it->open || in_it->odd) {
                return false;
            }
            depth--;
        } else {
            const bool container = it.major == ARRAY || it.major == MAP;
            if (in_it != NULL && in_it->map && !in_it->odd && it.major != TEXT) {
                return false;
            }
            if (depth == 1) {
                if ((plain && container) || (out != NULL && in_it->odd && !note_value(out, key, &it))) {
                    return false;
                }
                key = in_it->odd ? IGNORED_MEMBER : find_key(&it);
            }
            if (in_it != NULL) {
                in_it->odd = in_it->map && !in_it->odd;
                in_it->left -= in_it->open ? 0u : 1u;
            }
            if (container) {
                if (depth == DEPTH || (plain && it.open) || (!it.open && it.value > (size_t)(in.end - in.at))) {
                    return false;
                }
                levels[depth].map = it.major == MAP;
                levels[depth].open = it.open;
                levels[depth].odd = false;
                levels[depth].left = it.major == MAP ? 2u * it.value : it.value;
                depth++;
            }
        }
        while (depth > 0 && !levels[depth - 1].open && levels[depth - 1].left == 0) {
            depth--;
        }
    } while (depth > 0);
    return in.at == in.end;
}

/* -- the list of permitted requests -------------------------------------------------------------------------------- */

typedef enum request { READS, ECHO, RESTART, CONFIRM, TRY, UPLOAD, NOT_LISTED, BAD_BODY } request;

#define GROUP_IMAGE 1u
enum { OP_READ = 0x08, OP_WRITE = 0x0A };

static bool is_body(const uint8_t *body, size_t length, const uint8_t *is, size_t octets)
{
    return length == octets && memcmp(body, is, octets) == 0;
}

/* Requests of 1/0: the three permitted bodies, compared octet by octet. None makes an image permanent that has not run.
 * */
static request classify_state(const uint8_t *body, size_t length)
{
    static const uint8_t confirm[] = {0xA1, 0x67, 'c', 'o', 'n', 'f', 'i', 'r', 'm', 0xF5};
    static const uint8_t hash[] = {0xA1, 0x64, 'h', 'a', 's', 'h', 0x58, 0x20};
    static const uint8_t after[] = {0x67, 'c', 'o', 'n', 'f', 'i', 'r', 'm', 0xF4};
    const size_t one = sizeof hash + SHA_OCTETS;
    if (is_body(body, length, confirm, sizeof confirm)) {
        return CONFIRM;
    }
    if (length < one || memcmp(body + 1, hash + 1, sizeof hash - 1) != 0) {
        return BAD_BODY;
    }
    if (body[0] == hash[0] ? length == one
                           : body[0] == 0xA2 && is_body(body + one, length - one, after, sizeof after)) {
        return TRY;
    }
    return BAD_BODY;
}

static request classify_packet(const uint8_t *packet)
{
    static const struct {
        uint8_t operation, group, id, request;
    } list[] = {
        {OP_READ, 0, 6, READS},   {OP_READ, 0, 8, READS},    {OP_READ, 1, 0, READS},  {OP_READ, 1, 6, READS},
        {OP_WRITE, 0, 0, ECHO},   {OP_WRITE, 0, 5, RESTART}, {OP_WRITE, 1, 0, TRY},   {OP_WRITE, 1, 1, UPLOAD},
    };
    for (size_t i = 0; i < sizeof list / sizeof list[0]; i++) {
        if (packet[0] == list[i].operation && teds_get16(packet + 4) == list[i].group && packet[7] == list[i].id) {
            return (request)list[i].request;
        }
    }
    return NOT_LISTED;
}

/* Classify a packet. `out`: the members of an upload. */
static request classify_request(const uint8_t *packet, size_t length, packet_map *out)
{
    const uint8_t *body = packet + HEADER_OCTETS;
    const size_t octets = length - HEADER_OCTETS;
    request asked = classify_packet(packet);
    switch (asked) {
    case RESTART: return octets == 1 && body[0] == 0xA0 ? RESTART : BAD_BODY;
    case TRY: return classify_state(body, octets);
    case UPLOAD: return read_map(body, octets, true, out) && out->off_there ? UPLOAD : BAD_BODY;
    case READS:
    case ECHO: return read_map(body, octets, false, NULL) ? asked : BAD_BODY;
    default: return NOT_LISTED;
    }
}

/* -- when a request is permitted ----------------------------------------------------------------------------------- */

static bool is_upload_alive(teds_node *node)
{
    if (node->managed.upload_of != NULL && teds_now(node) >= node->managed.upload_until) {
        node->managed.upload_of = NULL;
    }
    return node->managed.upload_of != NULL;
}

static bool has_any_claim(const teds_node *node)
{
#if TEDS_OPERATION
    for (const teds_session *each = node->sessions; each < node->sessions + TEDS_SESSIONS; each++) {
        if (each->claims != 0) {
            return true;
        }
    }
#else
    (void)node;
#endif
    return false;
}

/* True if an upload of another image begins too soon after the last one. */
static bool is_too_soon(const teds_node *node, const packet_map *upload)
{
    const teds_managed *own = &node->managed;
    return upload->off == 0 && own->begun && teds_now(node) < own->sha_until &&
           (upload->sha_length != own->sha_length || (own->sha_length > 0 && memcmp(upload->sha, own->sha, own->sha_length) != 0));
}

static int check_moment(teds_node *node, request asked, const packet_map *upload, const teds_session *session)
{
    if (asked == CONFIRM) {
        return teds_on_trial(node) ? 0 : -TEDS_WRONG_STATE;
    }
    if (asked == READS || asked == ECHO) {
        return 0;
    }
    if (has_any_claim(node) || (node->staging_of != NULL && node->staging_of != session) ||
        (is_upload_alive(node) && node->managed.upload_of != session)) {
        return -TEDS_BUSY;
    }
    if (asked != RESTART && (node->firmware & (TEDS_FIRMWARE_ON_TRIAL | TEDS_FIRMWARE_PENDING)) != 0) {
        return -TEDS_BUSY; /* the second slot has the image to revert to */
    }
    return asked == UPLOAD && is_too_soon(node, upload) ? -TEDS_BUSY : 0;
}

/* Refuse commands that would change stored state during a trial, or that must not run during an upload. */
int teds_demand_no_image(teds_node *node, const teds_command *command)
{
    const uint8_t function = command->function;
    const bool common = command->command_class == TEDS_CLASS_COMMON;
    const bool security = command->command_class == TEDS_CLASS_SECURITY;
    if (teds_on_trial(node) &&
        ((common && (function == TEDS_WRITE || function == TEDS_UPDATE)) ||
         (security && (function == TEDS_REQUEST || function == TEDS_CONFIRM || function == TEDS_RESET ||
                       function == TEDS_SET_CAN_ADDRESS)))) {
        return -TEDS_BUSY;
    }
    if (((common && function == TEDS_WRITE) || (command->command_class == TEDS_CLASS_EITHER && function == 1)) &&
        is_upload_alive(node)) {
        return -TEDS_BUSY;
    }
    return 0;
}

/* -- running a packet ---------------------------------------------------------------------------------------------- */

static int plan_restart(teds_node *node, const uint8_t *packet, teds_link link, uint8_t *out)
{
    memmove(out, packet, SHORTEST);
    out[0] = OP_WRITE | AN_ANSWER;
    node->managed.restarts = true;
    node->managed.restart_link = link;
    return (int)SHORTEST;
}

static void begin_upload(teds_managed *own, const packet_map *upload, uint64_t now)
{
    own->begun = true;
    own->sha_until = now + ANOTHER_NS;
    own->upload_octets = upload->length;
    own->sha_length = upload->sha_length;
    if (upload->sha_length > 0) {
        memcpy(own->sha, upload->sha, upload->sha_length);
    }
}

static void continue_upload(teds_node *node, teds_session *session, const packet_map *answer)
{
    teds_managed *own = &node->managed;
    if (answer->refuses) {
        return;
    }
    /* Without `len` an upload is never complete by `off`. With it, `off` at or beyond `len` ends the upload. */
    own->upload_of = answer->complete || (answer->off_there && own->upload_octets != 0 && answer->off >= own->upload_octets)
                         ? NULL
                         : session;
    own->upload_until = teds_now(node) + UPLOAD_NS;
}

/* Read the state of the images again. Once a trial is confirmed, the slot whose erasure it delayed may be erased. */
static void note_images(teds_node *node)
{
    const bool was = teds_on_trial(node);
    teds_firmware own;
    (void)teds_firmware_read(node, &own);
    if (was && !teds_on_trial(node) && node->free_slot_dirty) {
        node->old_slot_due = true;
        node->old_slot_by = teds_now(node);
    }
}

static bool is_answer(const uint8_t head[HEADER_OCTETS], const uint8_t *out, size_t length)
{
    return length >= SHORTEST && out[0] == (head[0] | AN_ANSWER) && out[1] == 0 &&
           teds_get16(out + 2) == length - HEADER_OCTETS && memcmp(out + 4, head + 4, 4) == 0;
}

int teds_manage(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const teds_port *port = node->port;
    const uint8_t *packet = command->payload;
    size_t length = command->length;
    const size_t most = port->manage_octets != 0 && port->manage_octets < LONGEST ? port->manage_octets : LONGEST;
    uint8_t head[HEADER_OCTETS];
    packet_map upload = {0}, answer = {0};
    request asked;
    int failed;
    if ((node->firmware & TEDS_FIRMWARE_MANAGES) == 0) {
        return -TEDS_UNKNOWN_COMMAND;
    }
    if (length > most) {
        return -TEDS_TOO_LARGE;
    }
    if (length < SHORTEST || (packet[0] != OP_READ && packet[0] != OP_WRITE) || packet[1] != 0 ||
        teds_get16(packet + 2) != length - HEADER_OCTETS) {
        return -TEDS_BAD_FORM;
    }
    asked = classify_request(packet, length, &upload);
    if (asked == NOT_LISTED || asked == BAD_BODY) {
        return asked == NOT_LISTED ? -TEDS_NOT_PERMITTED : -TEDS_BAD_FORM;
    }
    failed = check_moment(node, asked, &upload, origin->session);
    if (failed) {
        return failed;
    }
    if (asked == RESTART) {
        return plan_restart(node, packet, origin->link, out);
    }
    if (asked == UPLOAD && upload.off == 0) {
        begin_upload(&node->managed, &upload, teds_now(node));
    }
    memcpy(head, packet, sizeof head); /* the answer overwrites it */
    length = port->manage(port->user, packet, length, out, most);
    if (asked == CONFIRM || asked == TRY) {
        note_images(node);
    }
    if (length > most || !is_answer(head, out, length) ||
        !read_map(out + HEADER_OCTETS, length - HEADER_OCTETS, false, asked == UPLOAD ? &answer : NULL)) {
        return -TEDS_FAILURE;
    }
    if (asked == UPLOAD) {
        continue_upload(node, origin->session, &answer);
    }
    return (int)length;
}

/* -- effects on other commands ------------------------------------------------------------------------------------- */

void teds_upload_end(teds_node *node, const teds_session *session)
{
    if (node->managed.upload_of == session) {
        node->managed.upload_of = NULL;
    }
}

void teds_restart_after(teds_node *node, teds_link link)
{
    if (node->managed.restarts && node->managed.restart_link == link) {
        node->managed.restarts = false;
        node->port->restart(node->port->user);
    }
}

uint64_t teds_trial_poll(teds_node *node, uint64_t now)
{
    if (!teds_on_trial(node)) {
        return TEDS_NEVER;
    }
    if (now >= TRIAL_NS && node->port->restart != NULL) {
        node->port->restart(node->port->user);
    }
    return now >= TRIAL_NS ? TEDS_NEVER : TRIAL_NS;
}

#endif
