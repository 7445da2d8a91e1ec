/* SPDX-License-Identifier: Apache-2.0 */
/* Where a node's state and TEDS lie: two slots of flash that take turns, a staging arena in RAM; Query, Read, Write and
 * Update over them (security-teds.md, 4 and 5).
 *
 * The rule: erase the free slot, write head, records and CRC in ascending units, read it back; only then it counts and
 * RAM follows. The old slot is erased when the reply has left. At a start the good slot with the higher counter counts,
 * and the other one is erased if it is not blank: whatever was cut, there is the old state or the new one, whole.
 */
#include "teds_store.h"
#include "agree.h"
#include "ble.h"
#include "can.h"
#include "clock.h"
#include "commit.h"
#include "operation.h"
#include "security_teds.h"
#include "inside.h"

/* identity area: magic 4, version 1, 0 0 0, UUID 10, key 32, point 65, field 102 64, zeros, CRC-32 in the last 4 */
#define IDENTITY_OCTETS 192u
/* head of a slot: magic 4, version 1, flags 1, address 1, 0, counter 4, octets of all but the CRC 4, octets of records 4,
 * epoch 4, sequence 4, key 16, station 65, CA 65, zeros; then records: id 2, 0 0, length 4, TEDS; CRC-32 ends the slot */
#define HEAD_OCTETS 192u
#define NUMBERS_OCTETS 28u /* of the head, up to the key */
#define RECORD_OCTETS 8u
#define UNIT_MOST 32u
#define PIECE 64u
#define STAGED_NS (60u * TEDS_SECOND)
#define OLD_SLOT_NS (15u * TEDS_SECOND) /* no station repeats a command after that */
static const uint8_t IDENTITY_MAGIC[8] = {'T', 'I', 'D', 'N', 1, 0, 0, 0};
static const uint8_t SLOT_MAGIC[5] = {'T', 'S', 'L', 'T', 1};
#define FORM_AT 4u /* in both; what is before it, a slot's length and the CRC are the same in every form */

/* -- writing one area, unit by unit --------------------------------------------------------------------------------- */

typedef struct writing {
    const teds_port *port;
    int area, failed;
    uint32_t at, crc;
    uint8_t fill, buffer[UNIT_MOST];
} writing;

static void put(writing *into, const void *data, size_t length)
{
    const uint8_t *octets = data;
    into->crc = teds_crc32(into->crc, octets, length);
    for (size_t i = 0; i < length && !into->failed; i++) {
        into->buffer[into->fill++] = octets[i];
        if (into->fill == into->port->unit) {
            into->failed = into->port->write(into->port->user, into->area, into->at, into->buffer, into->fill);
            into->at += into->fill;
            into->fill = 0;
        }
    }
}

static void put_zeros(writing *into, uint32_t until)
{
    static const uint8_t zero = 0;
    while (into->at + into->fill < until && !into->failed) {
        put(into, &zero, 1);
    }
}

/* CRC-32 as the last 4 octets of the last unit. */
static int close_area(writing *into, uint32_t total)
{
    uint8_t crc[4];
    put_zeros(into, total - 4);
    teds_put32(crc, into->crc);
    put(into, crc, 4);
    return into->failed;
}

static uint32_t whole_units(const teds_port *port, uint32_t octets)
{
    return (octets + port->unit - 1) & ~(uint32_t)(port->unit - 1); /* a power of two */
}

static int read_area(const teds_port *port, int area, uint32_t at, void *out, size_t length)
{
    return port->read(port->user, area, at, out, length);
}

/* Whether an area is blank; the rest of a torn slot may lie anywhere in it. CRC-32 of its first `octets` on the way. */
static int look_over(const teds_port *port, int area, uint32_t octets, bool *blank, uint32_t *crc)
{
    uint8_t piece[PIECE];
    *blank = true;
    *crc = 0;
    for (uint32_t at = 0; at < octets; at += sizeof piece) {
        const size_t length = octets - at < sizeof piece ? octets - at : sizeof piece;
        if (read_area(port, area, at, piece, length) != 0) {
            return TEDS_E_FLASH;
        }
        *crc = teds_crc32(*crc, piece, length);
        for (size_t i = 0; i < length; i++) {
            *blank = *blank && piece[i] == port->erased;
        }
    }
    return 0;
}

/* CRC-32 of the first `total` - 4 octets against the 4 that follow. */
static int crc_good(const teds_port *port, int area, uint32_t total, bool *good)
{
    uint8_t last[4];
    uint32_t crc;
    bool blank;
    if (look_over(port, area, total - 4, &blank, &crc) != 0 || read_area(port, area, total - 4, last, 4) != 0) {
        return TEDS_E_FLASH;
    }
    *good = teds_get32(last) == crc;
    return 0;
}

/* -- identity ------------------------------------------------------------------------------------------------------- */

static int make_identity(teds_node *node)
{
    const teds_port *port = node->port;
    teds_identity *own = &node->identity;
    const teds_part parts[] = {{(const uint8_t *)"TEDS1 node key", 15}, {own->uuid, 10}, {own->point, 65}};
    writing into = {.port = port, .area = TEDS_IDENTITY};
    memcpy(own->uuid, node->config->uuid, 10);
    if (port->p256_make(port->user, TEDS_KEY_SIGNS, &own->key, own->point) != 0) {
        return TEDS_E_RANDOM;
    }
    if (teds_sign(node, parts, 3, own->signature) != 0) {
        return TEDS_E_CRYPTO;
    }
    put(&into, IDENTITY_MAGIC, sizeof IDENTITY_MAGIC);
    put(&into, own, sizeof *own);
    return close_area(&into, IDENTITY_OCTETS) != 0 ? TEDS_E_FLASH : 0;
}

static int read_identity(teds_node *node, bool *good)
{
    const teds_port *port = node->port;
    uint8_t magic[sizeof IDENTITY_MAGIC];
    if (read_area(port, TEDS_IDENTITY, 0, magic, sizeof magic) != 0 ||
        read_area(port, TEDS_IDENTITY, sizeof magic, &node->identity, sizeof node->identity) != 0 ||
        crc_good(port, TEDS_IDENTITY, IDENTITY_OCTETS, good) != 0) {
        return TEDS_E_FLASH;
    }
    if (*good && memcmp(magic, IDENTITY_MAGIC, FORM_AT) == 0 && magic[FORM_AT] != IDENTITY_MAGIC[FORM_AT]) {
        return TEDS_E_FORM;
    }
    *good = *good && memcmp(magic, IDENTITY_MAGIC, sizeof magic) == 0;
    return 0;
}

/* A torn identity is no one's while both slots are blank: the first start writes a slot before the node shows its key. */
static int forget_torn_identity(const teds_port *port)
{
    for (int area = TEDS_SLOT_A; area <= TEDS_SLOT_B; area++) {
        uint32_t crc;
        bool blank;
        if (look_over(port, area, port->slot_octets, &blank, &crc) != 0) {
            return TEDS_E_FLASH;
        }
        if (!blank) {
            return TEDS_E_IDENTITY;
        }
    }
    return port->erase(port->user, TEDS_IDENTITY) != 0 ? TEDS_E_FLASH : 0;
}

static int load_identity(teds_node *node)
{
    const teds_port *port = node->port;
    uint32_t crc;
    bool blank, good;
    int failed;
    if (look_over(port, TEDS_IDENTITY, port->identity_octets, &blank, &crc) != 0) {
        return TEDS_E_FLASH;
    }
    if (!blank) {
        failed = read_identity(node, &good);
        if (failed || good) {
            return failed;
        }
        failed = teds_on_trial(node) ? TEDS_E_IDENTITY : forget_torn_identity(port);
        if (failed) {
            return failed;
        }
    }
    failed = teds_on_trial(node) ? TEDS_E_IDENTITY : make_identity(node);
    if (!failed) {
        failed = read_identity(node, &good);
    }
    return failed || good ? failed : TEDS_E_FLASH; /* it does not read back as it was written just now */
}

/* -- slots ---------------------------------------------------------------------------------------------------------- */

/* Whether a slot is good; the numbers of its head. One that is whole in a form of other firmware is never taken for torn:
 * the start fails, and an image on trial reverts. */
static int look(const teds_port *port, int area, uint8_t head[NUMBERS_OCTETS], bool *good)
{
    uint32_t total;
    int failed;
    *good = false;
    if (read_area(port, area, 0, head, NUMBERS_OCTETS) != 0) {
        return TEDS_E_FLASH;
    }
    total = teds_get32(head + 12);
    if (memcmp(head, SLOT_MAGIC, FORM_AT) != 0 || total < NUMBERS_OCTETS + 4 || total > port->slot_octets) {
        return 0;
    }
    failed = crc_good(port, area, total, good);
    if (!failed && *good && head[FORM_AT] != SLOT_MAGIC[FORM_AT]) {
        return TEDS_E_FORM;
    }
    *good = *good && total >= HEAD_OCTETS + 4 && teds_get32(head + 16) <= total - HEAD_OCTETS - 4;
    return failed;
}

static int take_slot(teds_node *node, int area, const uint8_t head[NUMBERS_OCTETS])
{
    teds_state *state = &node->state;
    state->flags = head[5];
    state->address = head[6];
    node->slot = (uint8_t)area;
    node->slot_counter = teds_get32(head + 8);
    node->records_end = HEAD_OCTETS + teds_get32(head + 16);
    state->epoch = teds_get32(head + 20);
    state->sequence = teds_get32(head + 24);
    return read_area(node->port, area, NUMBERS_OCTETS, &state->agreed, sizeof state->agreed) != 0 ? TEDS_E_FLASH : 0;
}

int teds_store_load(teds_node *node)
{
    const teds_port *port = node->port;
    uint8_t head[2][NUMBERS_OCTETS];
    bool good[2], blank;
    uint32_t crc;
    int failed = load_identity(node);
    node->records_end = HEAD_OCTETS;
    if (failed) {
        return failed;
    }
    for (int i = 0; i < 2; i++) {
        failed = look(port, TEDS_SLOT_A + i, head[i], &good[i]);
        if (failed) {
            return failed;
        }
    }
    if (good[0] && good[1]) {
        good[teds_get32(head[0] + 8) > teds_get32(head[1] + 8) ? 1 : 0] = false;
    }
    if (teds_on_trial(node) && !good[0] && !good[1]) {
        return TEDS_E_IDENTITY;
    }
    for (int i = 0; i < 2; i++) {
        if (good[i]) {
            continue;
        }
        if (teds_on_trial(node)) {
            node->free_slot_dirty = true; /* erased when the image is confirmed */
            continue;
        }
        if (look_over(port, TEDS_SLOT_A + i, port->slot_octets, &blank, &crc) != 0 ||
            (!blank && port->erase(port->user, TEDS_SLOT_A + i) != 0)) {
            if (!good[0] && !good[1]) {
                return TEDS_E_FLASH;
            }
            node->free_slot_dirty = node->spare_slot_fails = true; /* the other one is whole: enough to measure */
        }
    }
    if (good[0] || good[1]) {
        return take_slot(node, good[0] ? TEDS_SLOT_A : TEDS_SLOT_B, head[good[0] ? 0 : 1]);
    }
    node->slot = TEDS_SLOT_B; /* nothing is stored: A is written now, so that it shows that the identity counts */
    node->state.address = teds_default_address(node);
    if (teds_store_write(node, &node->state, NULL) != 0) {
        return TEDS_E_FLASH;
    }
    node->free_slot_dirty = node->old_slot_due = false; /* B is blank */
    return 0;
}

static int free_slot(const teds_node *node)
{
    return node->slot == TEDS_SLOT_A ? TEDS_SLOT_B : TEDS_SLOT_A;
}

int teds_make_blank(teds_node *node)
{
    if (node->free_slot_dirty) {
        node->spare_slot_fails = node->port->erase(node->port->user, free_slot(node)) != 0;
        if (node->spare_slot_fails) {
            return -TEDS_FAILURE;
        }
        node->free_slot_dirty = false;
        node->old_slot_due = false;
    }
    return 0;
}

void teds_store_poll(teds_node *node, uint64_t now)
{
    bool waits = teds_can_sending(node);
#if TEDS_NFC
    waits = waits || now < node->nfc.busy_until;
#endif
#if TEDS_BLE
    for (const teds_stored_reply *each = node->replies; each < node->replies + TEDS_REPLIES; each++) {
        waits = waits || teds_ble_sends(node, each);
    }
#endif
    if (node->old_slot_due && (!waits || now >= node->old_slot_by)) {
        node->old_slot_due = false; /* where it fails, the next Write or start erases it */
        (void)teds_make_blank(node);
    }
}

/* The record at `at`, or false at the end. Moves `at` behind it; where flash cannot be read it stays before the end. */
static bool next_record(const teds_node *node, uint32_t *at, uint16_t *id, teds_source *source)
{
    uint8_t head[RECORD_OCTETS];
    if (*at + RECORD_OCTETS > node->records_end || read_area(node->port, node->slot, *at, head, sizeof head) != 0) {
        return false;
    }
    *id = teds_get16(head);
    *source = (teds_source){.length = teds_get32(head + 4), .at = *at + RECORD_OCTETS};
    *at = source->at + source->length;
    return *at <= node->records_end;
}

static bool find_stored(const teds_node *node, uint16_t id, teds_source *out)
{
    uint32_t at = HEAD_OCTETS;
    uint16_t each;
    while (next_record(node, &at, &each, out)) {
        if (each == id) {
            return true;
        }
    }
    /* where nobody knows whether it is there, reading it fails, so that it is no 18 */
    *out = (teds_source){.unreadable = at != node->records_end, .length = 12};
    return out->unreadable;
}

static void copy_record(const teds_node *node, writing *into, uint16_t id, const teds_source *source)
{
    uint8_t head[RECORD_OCTETS] = {0}, piece[PIECE];
    teds_put16(head, id);
    teds_put32(head + 4, source->length);
    put(into, head, sizeof head);
    for (uint32_t at = 0; at < source->length && !into->failed; at += sizeof piece) {
        size_t octets = source->length - at < sizeof piece ? source->length - at : sizeof piece;
        into->failed = teds_source_read(node, source, at, piece, octets);
        put(into, piece, octets);
    }
}

static bool find_staged(const teds_node *node, uint16_t id, teds_source *out);

/* The records of the new slot, ascending: written to `into`, or (NULL) only counted. -1: the old slot cannot be read. */
static int32_t records(const teds_node *node, writing *into, const teds_state *state, const teds_signed *commit)
{
    const unsigned among = commit != NULL ? TEDS_STORED | TEDS_STAGED : TEDS_STORED;
    int32_t id = -1, octets = 0;
    while ((id = teds_next_id(node, id, among)) < TEDS_NO_ID) {
        teds_source source;
        if (commit == NULL || !find_staged(node, (uint16_t)id, &source)) {
            if (commit != NULL ? !teds_lists(commit, (uint16_t)id)
                               : id == (int32_t)TEDS_SECURITY_ID && (state->flags & TEDS_PROVISIONED) == 0) {
                continue;
            }
            if (!find_stored(node, (uint16_t)id, &source)) {
                return -1;
            }
        }
        octets += (int32_t)(RECORD_OCTETS + source.length);
        if (into != NULL) {
            copy_record(node, into, (uint16_t)id, &source);
        }
    }
    return id == TEDS_NO_ID ? octets : -1;
}

int teds_store_write(teds_node *node, const teds_state *state, const teds_signed *commit)
{
    const teds_port *port = node->port;
    const int32_t octets = records(node, NULL, state, commit);
    uint32_t total;
    uint8_t head[NUMBERS_OCTETS] = {0};
    writing into = {.port = port, .area = free_slot(node)};
    bool good = false;
    if (octets < 0) {
        return -TEDS_FAILURE;
    }
    total = whole_units(port, HEAD_OCTETS + (uint32_t)octets + 4);
    if (total > port->slot_octets) {
        return -TEDS_TOO_LARGE;
    }
    if (teds_make_blank(node) != 0) {
        return -TEDS_FAILURE;
    }
    memcpy(head, SLOT_MAGIC, sizeof SLOT_MAGIC);
    head[5] = state->flags;
    head[6] = state->address;
    teds_put32(head + 8, node->slot_counter + 1);
    teds_put32(head + 12, total);
    teds_put32(head + 16, (uint32_t)octets);
    teds_put32(head + 20, state->epoch);
    teds_put32(head + 24, state->sequence);
    node->free_slot_dirty = true; /* from here on; afterwards it is the old one */
    put(&into, head, sizeof head);
    put(&into, &state->agreed, sizeof state->agreed);
    put_zeros(&into, HEAD_OCTETS);
    good = records(node, &into, state, commit) == octets && close_area(&into, total) == 0 &&
           crc_good(port, into.area, total, &good) == 0 && good;
    teds_wipe(into.buffer, sizeof into.buffer);
    if (!good) {
        /* A slot that is whole and cannot be read back now would count at the next start: it has to go. */
        (void)teds_make_blank(node);
        return -TEDS_FAILURE;
    }
    node->state = *state;
    node->slot = (uint8_t)into.area;
    node->slot_counter++;
    node->records_end = HEAD_OCTETS + (uint32_t)octets;
    node->old_slot_due = true;
    node->old_slot_by = teds_now(node) + OLD_SLOT_NS;
    teds_can_identity_changed(node);
    return 0;
}

/* -- what is there -------------------------------------------------------------------------------------------------- */

bool teds_storable(uint16_t channel, uint8_t code)
{
    return channel <= 255 && ((code >= 1 && code <= 17) || (code >= 128 && code <= 135));
}

static uint16_t id_of(const teds_fixed *each)
{
    return (uint16_t)((uint32_t)each->channel << 8 | each->code);
}

static bool find_fixed(const teds_node *node, uint16_t id, teds_source *out)
{
    for (size_t i = 0; i < node->config->fixed_count; i++) {
        const teds_fixed *each = &node->config->fixed[i];
        if (id_of(each) == id) {
            *out = (teds_source){.octets = each->octets, .length = each->length, .read_only = true};
            return true;
        }
    }
    return false;
}

static bool find_staged(const teds_node *node, uint16_t id, teds_source *out)
{
    size_t length;
    *out = (teds_source){.octets = teds_staged(node, id, &length)};
    out->length = (uint32_t)length;
    return out->octets != NULL;
}

bool teds_find(const teds_node *node, uint16_t id, teds_source *out)
{
    if (id == TEDS_SECURITY_ID && (node->state.flags & TEDS_PROVISIONED) == 0) {
        *out = (teds_source){.initial = true, .length = TEDS_INITIAL_OCTETS};
        return true;
    }
    return find_fixed(node, id, out) || find_stored(node, id, out);
}

bool teds_find_new(const teds_node *node, uint16_t id, teds_source *out)
{
    return find_staged(node, id, out) || teds_find(node, id, out);
}

int teds_source_read(const teds_node *node, const teds_source *source, uint32_t at, uint8_t *out, size_t length)
{
    if (source->unreadable) {
        return TEDS_E_FLASH;
    }
    if (source->initial) {
        uint8_t teds[TEDS_INITIAL_OCTETS];
        teds_initial(node, teds);
        memcpy(out, teds + at, length);
        return 0;
    }
    if (source->octets != NULL) {
        memcpy(out, source->octets + at, length);
        return 0;
    }
    return read_area(node->port, node->slot, source->at + at, out, length);
}

int teds_source_hash(const teds_node *node, const teds_source *source, uint8_t out[32])
{
    const teds_port *port = node->port;
    uint8_t piece[PIECE];
    teds_sha256 state;
    int failed = 0;
    port->sha256_start(port->user, &state);
    for (uint32_t at = 0; at < source->length && !failed; at += sizeof piece) {
        size_t length = source->length - at < sizeof piece ? source->length - at : sizeof piece;
        failed = teds_source_read(node, source, at, piece, length);
        port->sha256_update(port->user, &state, piece, length);
    }
    port->sha256_finish(port->user, &state, out);
    return failed;
}

static void nearer(uint32_t id, int32_t after, int32_t *found)
{
    if ((int32_t)id > after && (int32_t)id < *found) {
        *found = (int32_t)id;
    }
}

int32_t teds_next_id(const teds_node *node, int32_t after, unsigned among)
{
    int32_t found = TEDS_NO_ID;
    uint32_t at = HEAD_OCTETS;
    uint16_t id;
    teds_source source;
    if ((among & TEDS_STORED) != 0) {
        while (next_record(node, &at, &id, &source)) {
            nearer(id, after, &found);
        }
        if (at != node->records_end) {
            return TEDS_UNREADABLE;
        }
    }
    if ((among & TEDS_NOT_STORED) != 0) {
        for (size_t i = 0; i < node->config->fixed_count; i++) {
            nearer(id_of(&node->config->fixed[i]), after, &found);
        }
        nearer(TEDS_SECURITY_ID, after, &found);
    }
    if ((among & TEDS_STAGED) != 0) {
        for (at = 0; at < node->staging_end; at += 4u + teds_get16(node->staging + at + 2)) {
            nearer(teds_get16(node->staging + at), after, &found);
        }
    }
    return found;
}

/* -- tuples --------------------------------------------------------------------------------------------------------- */

/* UINT32_MAX: it does not fit, or cannot be read. */
static uint32_t number(const teds_walk *in, uint32_t at, uint32_t octets)
{
    uint32_t value = 0;
    for (; octets > 0; octets--, at++) {
        uint8_t octet;
        if (value > 0xFFFFFF || at >= in->source.length ||
            teds_source_read(in->node, &in->source, at, &octet, 1) != 0) {
            return UINT32_MAX;
        }
        value = value << 8 | octet;
    }
    return value;
}

#if TEDS_OPERATION
uint32_t teds_number_at(const teds_walk *in, uint32_t at, uint32_t octets)
{
    return octets >= 1 && octets <= 4 ? number(in, at, octets) : UINT32_MAX;
}
#endif

bool teds_next_tuple(teds_walk *in, uint8_t *type, uint32_t *value, uint32_t *length)
{
    if (in->at + 1 + in->width > in->end) {
        return false;
    }
    *type = (uint8_t)number(in, in->at, 1);
    *length = number(in, in->at + 1, in->width);
    *value = in->at + 1 + in->width;
    if (*length > in->end - *value) {
        return false;
    }
    in->at = *value + *length;
    return true;
}

/* -- staging: id 2, length 2, image; one after another --------------------------------------------------------------- */

const uint8_t *teds_staged(const teds_node *node, uint16_t id, size_t *length)
{
    for (size_t at = 0; at + 4 <= node->staging_end; at += 4u + teds_get16(node->staging + at + 2)) {
        if (teds_get16(node->staging + at) == id) {
            *length = teds_get16(node->staging + at + 2);
            return node->staging + at + 4;
        }
    }
    *length = 0;
    return NULL;
}

void teds_staging_drop(teds_node *node)
{
    node->staging_end = 0;
    node->staging_of = NULL;
}

/* Put `length` octets at `offset` of an image; what lay behind them is dropped. */
static int stage(teds_node *node, uint16_t id, uint32_t offset, const uint8_t *octets, size_t length)
{
    size_t before = 0;
    const uint8_t *image = teds_staged(node, id, &before);
    size_t at = image != NULL ? (size_t)(image - node->staging) : node->staging_end + 4u;
    size_t end = image != NULL ? node->staging_end : node->staging_end + 4u;
    size_t behind = at + before;
    if (end - before + offset + length > TEDS_STAGING) {
        return -TEDS_TOO_LARGE;
    }
    memmove(node->staging + at + offset + length, node->staging + behind, end - behind);
    memcpy(node->staging + at + offset, octets, length);
    teds_put16(node->staging + at - 4, id);
    teds_put16(node->staging + at - 2, (uint16_t)(offset + length));
    node->staging_end = (uint16_t)(end - before + offset + length);
    return 0;
}

/* Whether List could name one more, sealed; `own`: what is staged is this session's. */
static bool can_list(const teds_node *node, uint16_t id, bool own)
{
    const unsigned among = own ? TEDS_STORED | TEDS_NOT_STORED | TEDS_STAGED : TEDS_STORED | TEDS_NOT_STORED;
    size_t count = 1;
    for (int32_t each = -1; (each = teds_next_id(node, each, among)) < TEDS_NO_ID;) {
        count += each != id ? 1 : 0;
    }
    return 3 * count <= TEDS_ROOM;
}

/* -- commands -------------------------------------------------------------------------------------------------------- */

/* The TEDS that a command names: its id, or a reason negated. */
static int named(const teds_command *command)
{
    if (!teds_storable(command->channel, command->payload[0])) {
        return -TEDS_NO_SUCH_TEDS;
    }
    return (int)((uint32_t)command->channel << 8 | command->payload[0]);
}

/* What Query and Update say of a stored TEDS, or of the staged image in its place. */
static int status_of(const teds_node *node, uint16_t id, bool staged, uint8_t *out)
{
    static const uint32_t text = 1u << 2 | 1u << 4 | 1u << 6 | 1u << 10 | 1u << 11 | 1u << 14 | 1u << 15;
    const uint8_t code = (uint8_t)id;
    teds_source source;
    const bool there = staged ? teds_find_new(node, id, &source) : teds_find(node, id, &source);
    if (!there) {
        source.length = 0;
        source.read_only = false;
    }
    out[0] = code >= 128 ? 0x40 : (text >> (code & 31u) & 1u) != 0 ? 0x10 : 0;
    out[0] |= (uint8_t)((source.read_only ? 1u : 0u) | (there ? 0u : 2u));
    out[1] = 0;
    teds_put32(out + 2, source.length);
    teds_put16(out + 6, 0);
    if (source.length >= 2 && teds_source_read(node, &source, source.length - 2, out + 6, 2) != 0) {
        return -TEDS_FAILURE;
    }
    teds_put32(out + 8, TEDS_STAGING - 4);
    return 12;
}

int teds_query(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const int id = named(command);
    (void)origin;
    return id < 0 ? id : status_of(node, (uint16_t)id, false, out);
}

int teds_read(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const int id = named(command);
    teds_source source;
    uint32_t offset, octets;
    (void)origin;
    if (id < 0) {
        return id;
    }
    if (!teds_find(node, (uint16_t)id, &source)) {
        return -TEDS_NO_SUCH_TEDS;
    }
    offset = teds_get32(command->payload + 1);
    offset = offset < source.length ? offset : source.length;
    octets = source.length - offset;
    octets = octets < TEDS_ROOM - 4 ? octets : TEDS_ROOM - 4;
    teds_put32(out, offset);
    if (teds_source_read(node, &source, offset, out + 4, octets) != 0) {
        return -TEDS_FAILURE;
    }
    return (int)(4 + octets);
}

int teds_write(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const int id = command->length >= 5 ? named(command) : -TEDS_BAD_FORM;
    const bool elsewhere = node->staging_of != NULL && node->staging_of != origin->session;
    const uint64_t now = teds_now(node);
    teds_source source;
    uint32_t offset;
    size_t staged = 0, octets;
    int failed;
    (void)out;
    if (id < 0) {
        return id;
    }
    if (find_fixed(node, (uint16_t)id, &source)) {
        return -TEDS_NOT_PERMITTED;
    }
    offset = teds_get32(command->payload + 1);
    octets = command->length - 5;
    if (!elsewhere) {
        (void)teds_staged(node, (uint16_t)id, &staged);
    }
    if (offset > staged) {
        return -TEDS_BAD_FORM;
    }
    if (elsewhere && now < node->staged_until) {
        return -TEDS_BUSY;
    }
    if (!can_list(node, (uint16_t)id, !elsewhere) || (elsewhere && 4 + octets > TEDS_STAGING)) {
        return -TEDS_TOO_LARGE; /* which changes no staging */
    }
    if (teds_make_blank(node) != 0) {
        return -TEDS_FAILURE;
    }
    if (elsewhere) {
        teds_staging_drop(node);
    }
    failed = stage(node, (uint16_t)id, offset, command->payload + 5, octets);
    if (failed) {
        return failed;
    }
    node->staging_of = origin->session;
    node->staged_until = now + STAGED_NS;
#if TEDS_OPERATION
    if (origin->arrival->kind == TEDS_AT_NFC) {
        teds_yield_sensors(node, origin->session);
    }
#endif
    return 0;
}

int teds_update(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const int id = named(command);
    const uint8_t *image;
    size_t octets = 0;
    int length, failed;
    if (id < 0) {
        return id;
    }
    if (node->staging_of != NULL && node->staging_of != origin->session) {
        return -TEDS_BUSY;
    }
    image = teds_staged(node, (uint16_t)id, &octets);
    if (image == NULL && id == (int)TEDS_SECURITY_ID && node->staging_end > 0) {
        return -TEDS_WRONG_STATE;
    }
    length = status_of(node, (uint16_t)id, true, out); /* a commit that succeeds stores what was staged */
    if (image == NULL) {
        return length;
    }
    node->staged_until = teds_now(node) + STAGED_NS;
    if (id == (int)TEDS_SECURITY_ID) {
        failed = teds_commit(node);
    } else {
        failed = teds_own_check((uint8_t)id, image, octets) ? 0 : -TEDS_BAD_FORM;
    }
    return failed ? failed : length;
}
