/* Where a node's state and TEDS lie: two slots of flash that take turns, a staging arena in RAM; Query, Read, Write and
 * Update over them (security-teds.md, 4 and 5).
 *
 * The rule: erase the free slot, write head, records and CRC in ascending units, read it back; only then it counts and
 * RAM follows. The old slot is erased when the reply has left. At a start the good slot with the higher counter counts,
 * and the other one is erased if it is not blank: whatever was cut, there is the old state or the new one, whole.
 */
#include "inside.h"

/* identity area: magic 4, version 1, 0 0 0, UUID 10, key 32, point 65, field 102 64, zeros, CRC-32 in the last 4 */
#define IDENTITY_OCTETS 192u
/* head of a slot: magic 4, version 1, flags 1, address 1, 0, counter 4, octets of all but the CRC 4, octets of records 4,
 * epoch 4, sequence 4, key 16, station 65, CA 65, zeros; then records: id 2, 0 0, length 4, TEDS; CRC-32 ends the slot */
#define HEAD_OCTETS 192u
#define RECORD_OCTETS 8u
#define UNIT_MOST 32u
#define STAGED_NS (60u * TEDS_SECOND)
static const uint8_t IDENTITY_MAGIC[5] = {'T', 'I', 'D', 'N', 1};
static const uint8_t SLOT_MAGIC[5] = {'T', 'S', 'L', 'T', 1};

/* -- writing one area, unit by unit --------------------------------------------------------------------------------- */

typedef struct writing {
    const teds_port *port;
    int area, failed;
    uint32_t at, crc;
    uint8_t fill, buffer[UNIT_MOST];
} writing;

static void put(writing *into, const uint8_t *octets, size_t length)
{
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
    return (octets + port->unit - 1) / port->unit * port->unit;
}

/* Whether an area is blank; the rest of a torn slot may lie anywhere in it. */
static int is_blank(const teds_port *port, int area, uint32_t octets, bool *blank)
{
    uint8_t piece[64];
    *blank = true;
    for (uint32_t at = 0; at < octets && *blank; at += sizeof piece) {
        size_t length = octets - at < sizeof piece ? octets - at : sizeof piece;
        if (port->read(port->user, area, at, piece, length) != 0) {
            return TEDS_E_FLASH;
        }
        for (size_t i = 0; i < length; i++) {
            *blank = *blank && piece[i] == port->erased;
        }
    }
    return 0;
}

/* CRC-32 of the first `total` - 4 octets against the 4 that follow. */
static int crc_good(const teds_port *port, int area, uint32_t total, bool *good)
{
    uint8_t piece[64];
    uint32_t crc = 0;
    for (uint32_t at = 0; at < total - 4; at += sizeof piece) {
        size_t length = total - 4 - at < sizeof piece ? total - 4 - at : sizeof piece;
        if (port->read(port->user, area, at, piece, length) != 0) {
            return TEDS_E_FLASH;
        }
        crc = teds_crc32(crc, piece, length);
    }
    if (port->read(port->user, area, total - 4, piece, 4) != 0) {
        return TEDS_E_FLASH;
    }
    *good = teds_get32(piece) == crc;
    return 0;
}

/* -- identity ------------------------------------------------------------------------------------------------------- */

static int make_identity(teds_node *node)
{
    static const uint8_t zeros[3] = {0};
    const teds_port *port = node->port;
    const teds_part parts[] = {{(const uint8_t *)"TEDS1 node key", 15}, {node->uuid, 10}, {node->point, 65}};
    writing into = {.port = port, .area = TEDS_IDENTITY};
    uint8_t hash[32];
    bool good = false;
    memcpy(node->uuid, node->config->uuid, 10);
    if (port->p256_make(port->user, TEDS_KEY_SIGNS, &node->key, node->point) != 0) {
        return TEDS_E_RANDOM;
    }
    teds_sha256_parts(node, parts, 3, hash);
    if (teds_sign(node, hash, node->signature) != 0) {
        return TEDS_E_CRYPTO;
    }
    put(&into, IDENTITY_MAGIC, sizeof IDENTITY_MAGIC);
    put(&into, zeros, 3);
    put(&into, node->uuid, 10);
    put(&into, node->key.octets, 32);
    put(&into, node->point, 65);
    put(&into, node->signature, 64);
    if (close_area(&into, IDENTITY_OCTETS) != 0 || crc_good(port, TEDS_IDENTITY, IDENTITY_OCTETS, &good) != 0) {
        return TEDS_E_FLASH;
    }
    return good ? 0 : TEDS_E_FLASH;
}

static int load_identity(teds_node *node)
{
    const teds_port *port = node->port;
    uint8_t block[IDENTITY_OCTETS];
    bool blank, good = false;
    if (is_blank(port, TEDS_IDENTITY, port->identity_octets, &blank) != 0) {
        return TEDS_E_FLASH;
    }
    if (blank) {
        return make_identity(node);
    }
    if (port->read(port->user, TEDS_IDENTITY, 0, block, sizeof block) != 0 ||
        crc_good(port, TEDS_IDENTITY, IDENTITY_OCTETS, &good) != 0) {
        return TEDS_E_FLASH;
    }
    if (!good || memcmp(block, IDENTITY_MAGIC, sizeof IDENTITY_MAGIC) != 0) {
        return TEDS_E_IDENTITY;
    }
    memcpy(node->uuid, block + 8, 10);
    memcpy(node->key.octets, block + 18, 32);
    memcpy(node->point, block + 50, 65);
    memcpy(node->signature, block + 115, 64);
    teds_wipe(block, sizeof block);
    return 0;
}

/* -- slots ---------------------------------------------------------------------------------------------------------- */

/* Whether a slot is good; its counter. */
static int look(const teds_port *port, int area, bool *good, uint32_t *counter)
{
    uint8_t head[20];
    uint32_t total;
    *good = false;
    if (port->read(port->user, area, 0, head, sizeof head) != 0) {
        return TEDS_E_FLASH;
    }
    *counter = teds_get32(head + 8);
    total = teds_get32(head + 12);
    if (memcmp(head, SLOT_MAGIC, sizeof SLOT_MAGIC) != 0 || total < HEAD_OCTETS + 4 || total > port->slot_octets ||
        teds_get32(head + 16) > total - HEAD_OCTETS - 4) {
        return 0;
    }
    return crc_good(port, area, total, good);
}

static int take_slot(teds_node *node, int area)
{
    const teds_port *port = node->port;
    teds_state *state = &node->state;
    uint8_t head[HEAD_OCTETS];
    if (port->read(port->user, area, 0, head, sizeof head) != 0) {
        return TEDS_E_FLASH;
    }
    state->flags = head[5];
    state->address = head[6];
    node->slot = (uint8_t)area;
    node->slot_counter = teds_get32(head + 8);
    node->records_at = HEAD_OCTETS;
    node->records_end = HEAD_OCTETS + teds_get32(head + 16);
    state->epoch = teds_get32(head + 20);
    state->sequence = teds_get32(head + 24);
    memcpy(state->key, head + 28, 16);
    memcpy(state->station, head + 44, 65);
    memcpy(state->ca, head + 109, 65);
    teds_wipe(head, sizeof head);
    return 0;
}

int teds_store_load(teds_node *node)
{
    const teds_port *port = node->port;
    bool good[2], blank;
    uint32_t counter[2];
    int taken, failed = load_identity(node);
    if (failed) {
        return failed;
    }
    for (int i = 0; i < 2; i++) {
        if (look(port, TEDS_SLOT_A + i, &good[i], &counter[i]) != 0) {
            return TEDS_E_FLASH;
        }
    }
    if (good[0] && good[1]) {
        good[counter[0] > counter[1] ? 1 : 0] = false;
    }
    taken = good[0] ? TEDS_SLOT_A : good[1] ? TEDS_SLOT_B : 0;
    for (int area = TEDS_SLOT_A; area <= TEDS_SLOT_B; area++) {
        if (area == taken) {
            continue;
        }
        if (is_blank(port, area, port->slot_octets, &blank) != 0 || (!blank && port->erase(port->user, area) != 0)) {
            return TEDS_E_FLASH;
        }
    }
    if (taken) {
        return take_slot(node, taken);
    }
    node->slot = TEDS_SLOT_B; /* nothing is stored: A is written first */
    node->state.address = teds_default_address(node->uuid);
    return 0;
}

static int free_slot(const teds_node *node)
{
    return node->slot == TEDS_SLOT_A ? TEDS_SLOT_B : TEDS_SLOT_A;
}

int teds_make_blank(teds_node *node)
{
    if (node->free_slot_dirty) {
        if (node->port->erase(node->port->user, free_slot(node)) != 0) {
            return -TEDS_FAILURE;
        }
        node->free_slot_dirty = false;
        node->old_slot_due = false;
    }
    return 0;
}

uint64_t teds_store_poll(teds_node *node, uint64_t now)
{
    bool sends = teds_can_sending(node);
    uint64_t due = TEDS_NEVER;
#if TEDS_NFC
    if (now < node->nfc.busy_until) {
        sends = true;
        due = node->nfc.busy_until;
    }
#else
    (void)now;
#endif
#if TEDS_BLE
    for (int8_t i = 0; i < TEDS_REPLIES; i++) {
        sends = sends || teds_ble_sends(node, i);
    }
#endif
    if (!node->old_slot_due || sends) {
        return node->old_slot_due ? due : TEDS_NEVER;
    }
    node->old_slot_due = false; /* where it fails, the next Write or start erases it */
    (void)teds_make_blank(node);
    return TEDS_NEVER;
}

/* The record at `at`: 1, and `at` is behind it; 0 at the end; -1 where flash cannot be read, which is not the end. */
static int next_record(const teds_node *node, uint32_t *at, uint16_t *id, teds_source *source)
{
    uint8_t head[RECORD_OCTETS];
    if (*at + RECORD_OCTETS > node->records_end) {
        return 0;
    }
    if (node->port->read(node->port->user, node->slot, *at, head, sizeof head) != 0) {
        return -1;
    }
    *id = teds_get16(head);
    memset(source, 0, sizeof *source);
    source->length = teds_get32(head + 4);
    source->at = *at + RECORD_OCTETS;
    *at = source->at + source->length;
    return *at <= node->records_end ? 1 : -1;
}

static bool find_stored(const teds_node *node, uint16_t id, teds_source *out)
{
    uint32_t at = node->records_at;
    uint16_t each;
    int more;
    while ((more = next_record(node, &at, &each, out)) > 0) {
        if (each == id) {
            return true;
        }
    }
    memset(out, 0, sizeof *out);
    out->unreadable = more < 0; /* nobody knows whether it is there: reading it fails, so that it is no 18 */
    out->length = out->unreadable ? 12 : 0;
    return out->unreadable;
}

static int copy_record(const teds_node *node, writing *into, uint16_t id, const teds_source *source,
                       const uint8_t *staged, size_t staged_length)
{
    uint8_t head[RECORD_OCTETS] = {0}, piece[64];
    uint32_t length = staged != NULL ? (uint32_t)staged_length : source->length;
    teds_put16(head, id);
    teds_put32(head + 4, length);
    put(into, head, sizeof head);
    if (staged != NULL) {
        put(into, staged, staged_length);
        return into->failed;
    }
    for (uint32_t at = 0; at < length && !into->failed; at += sizeof piece) {
        size_t octets = length - at < sizeof piece ? length - at : sizeof piece;
        into->failed = teds_source_read(node, source, at, piece, octets);
        put(into, piece, octets);
    }
    return into->failed;
}

/* The records of the new slot, ascending: written to `into`, or (NULL) only counted in `octets`. Not 0: flash failed. */
static int records(const teds_node *node, writing *into, teds_keep keep, const void *what, bool staged,
                   uint32_t *octets)
{
    int32_t after = -1;
    *octets = 0;
    for (;;) {
        uint32_t at = node->records_at, found = UINT32_MAX;
        uint16_t id;
        teds_source each = {0}, source = {0};
        const uint8_t *image = NULL;
        size_t length = 0;
        int more;
        while ((more = next_record(node, &at, &id, &each)) > 0) {
            if (id > after && id < found && keep(what, id)) {
                found = id;
                source = each;
            }
        }
        if (more < 0) {
            return more; /* a record that is not seen would be left out */
        }
        if (staged && teds_next_staged(node, after, &id) && id <= found) {
            found = id;
            image = teds_staged(node, id, &length);
        }
        if (found == UINT32_MAX) {
            return 0;
        }
        *octets += RECORD_OCTETS + (image != NULL ? (uint32_t)length : source.length);
        if (into != NULL && copy_record(node, into, (uint16_t)found, &source, image, length) != 0) {
            return into->failed;
        }
        after = (int32_t)found;
    }
}

int teds_store_write(teds_node *node, const teds_state *state, teds_keep keep, const void *what, bool staged)
{
    const teds_port *port = node->port;
    uint32_t octets, total;
    uint8_t head[HEAD_OCTETS] = {0};
    writing into = {.port = port, .area = free_slot(node)};
    bool good = false;
    int failed;
    if (records(node, NULL, keep, what, staged, &octets) != 0) {
        return -TEDS_FAILURE;
    }
    total = whole_units(port, HEAD_OCTETS + octets + 4);
    if (total > port->slot_octets) {
        return -TEDS_TOO_LARGE;
    }
    failed = teds_make_blank(node);
    if (failed) {
        return failed;
    }
    memcpy(head, SLOT_MAGIC, sizeof SLOT_MAGIC);
    head[5] = state->flags;
    head[6] = state->address;
    teds_put32(head + 8, node->slot_counter + 1);
    teds_put32(head + 12, total);
    teds_put32(head + 16, octets);
    teds_put32(head + 20, state->epoch);
    teds_put32(head + 24, state->sequence);
    memcpy(head + 28, state->key, 16);
    memcpy(head + 44, state->station, 65);
    memcpy(head + 109, state->ca, 65);
    node->free_slot_dirty = true;
    put(&into, head, sizeof head);
    teds_wipe(head, sizeof head);
    if (records(node, &into, keep, what, staged, &octets) != 0 || close_area(&into, total) != 0 ||
        crc_good(port, into.area, total, &good) != 0 || !good) {
        teds_wipe(into.buffer, sizeof into.buffer);
        /* A slot that is whole and cannot be read back now would count at the next start: it has to go. */
        (void)teds_make_blank(node);
        return -TEDS_FAILURE;
    }
    teds_wipe(into.buffer, sizeof into.buffer);
    node->state = *state;
    node->slot = (uint8_t)into.area;
    node->slot_counter++;
    node->records_at = HEAD_OCTETS;
    node->records_end = HEAD_OCTETS + octets;
    node->free_slot_dirty = true; /* the old one */
    node->old_slot_due = true;
    return 0;
}

/* -- what is there -------------------------------------------------------------------------------------------------- */

bool teds_storable(uint16_t channel, uint8_t code)
{
    return channel <= 255 && ((code >= 1 && code <= 17) || (code >= 128 && code <= 135));
}

static bool find_fixed(const teds_node *node, uint16_t id, teds_source *out)
{
    for (size_t i = 0; i < node->config->fixed_count; i++) {
        const teds_fixed *each = &node->config->fixed[i];
        if (((uint32_t)each->channel << 8 | each->code) == id) {
            memset(out, 0, sizeof *out);
            out->octets = each->octets;
            out->length = each->length;
            out->read_only = true;
            return true;
        }
    }
    return false;
}

bool teds_find(const teds_node *node, uint16_t id, teds_source *out)
{
    if (id == TEDS_SECURITY_ID && (node->state.flags & TEDS_PROVISIONED) == 0) {
        memset(out, 0, sizeof *out);
        out->initial = true;
        out->length = TEDS_INITIAL_OCTETS;
        return true;
    }
    return find_fixed(node, id, out) || find_stored(node, id, out);
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
    return node->port->read(node->port->user, node->slot, source->at + at, out, length);
}

int teds_source_hash(const teds_node *node, const teds_source *source, uint8_t out[32])
{
    const teds_port *port = node->port;
    uint8_t piece[64];
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

int teds_next_id(const teds_node *node, int32_t after, uint16_t *out)
{
    uint32_t at = node->records_at, found = UINT32_MAX;
    uint16_t id;
    teds_source source;
    int more;
    while ((more = next_record(node, &at, &id, &source)) > 0) {
        found = id > after && id < found ? id : found;
    }
    for (size_t i = 0; i < node->config->fixed_count; i++) {
        uint32_t each = (uint32_t)node->config->fixed[i].channel << 8 | node->config->fixed[i].code;
        found = (int32_t)each > after && each < found ? each : found;
    }
    found = (int32_t)TEDS_SECURITY_ID > after && TEDS_SECURITY_ID < found ? TEDS_SECURITY_ID : found;
    *out = (uint16_t)found;
    return more < 0 ? more : found != UINT32_MAX;
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

bool teds_next_staged(const teds_node *node, int32_t after, uint16_t *out)
{
    uint32_t found = UINT32_MAX;
    for (size_t at = 0; at + 4 <= node->staging_end; at += 4u + teds_get16(node->staging + at + 2)) {
        uint16_t id = teds_get16(node->staging + at);
        found = id > after && id < found ? id : found;
    }
    *out = (uint16_t)found;
    return found != UINT32_MAX;
}

void teds_staging_drop(teds_node *node)
{
    node->staging_end = 0;
    for (size_t i = 0; i < TEDS_SESSIONS; i++) {
        node->sessions[i].staged = false;
    }
}

/* Another session's staging: its place, -1 where there is none. */
static int8_t staged_elsewhere(const teds_node *node, int8_t session)
{
    for (int8_t i = 0; i < TEDS_SESSIONS; i++) {
        if (i != session && node->sessions[i].used && node->sessions[i].staged) {
            return i;
        }
    }
    return -1;
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
    teds_source source;
    int32_t after = -1;
    uint16_t each;
    size_t staged = 0, count = teds_find(node, id, &source) || (own && teds_staged(node, id, &staged) != NULL) ? 0 : 1;
    for (; teds_next_id(node, after, &each) > 0; after = each) {
        count++;
    }
    for (after = -1; own && teds_next_staged(node, after, &each); after = each) {
        count += teds_find(node, each, &source) ? 0u : 1u;
    }
    return 3 * count <= TEDS_ROOM;
}

/* -- commands -------------------------------------------------------------------------------------------------------- */

/* The TEDS that a command names: its id, or a reason negated. */
static int named(const teds_command *command, bool octets_good)
{
    if (!octets_good) {
        return -TEDS_BAD_FORM;
    }
    if (!teds_storable(command->channel, command->payload[0])) {
        return -TEDS_NO_SUCH_TEDS;
    }
    return (int)((uint32_t)command->channel << 8 | command->payload[0]);
}

static int status(uint16_t id, bool read_only, bool there, uint32_t size, uint16_t checksum, uint8_t *out)
{
    static const uint32_t text = 1u << 2 | 1u << 4 | 1u << 6 | 1u << 10 | 1u << 11 | 1u << 14 | 1u << 15;
    uint8_t code = (uint8_t)id;
    uint32_t attributes = code >= 128 ? 0x40u : (text >> (code & 31u) & 1u) != 0 ? 0x10u : 0;
    attributes |= (read_only ? 1u : 0u) | (there ? 0u : 2u);
    out[0] = (uint8_t)attributes;
    out[1] = 0;
    teds_put32(out + 2, size);
    teds_put16(out + 6, checksum);
    teds_put32(out + 8, TEDS_STAGING - 4);
    return 12;
}

static int status_of(const teds_node *node, uint16_t id, uint8_t *out)
{
    teds_source source = {0};
    uint8_t last[2] = {0, 0};
    bool there = teds_find(node, id, &source);
    if (there && source.length >= 2 && teds_source_read(node, &source, source.length - 2, last, 2) != 0) {
        return -TEDS_FAILURE;
    }
    return status(id, source.read_only && there, there, there ? source.length : 0, teds_get16(last), out);
}

int teds_query(const teds_node *node, const teds_command *command, uint8_t *out)
{
    int id = named(command, command->length == 1);
    return id < 0 ? id : status_of(node, (uint16_t)id, out);
}

int teds_read(const teds_node *node, const teds_command *command, uint8_t *out)
{
    int id = named(command, command->length == 5);
    teds_source source;
    uint32_t offset, octets;
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

int teds_write(teds_node *node, const teds_command *command, teds_origin *origin)
{
    int id = named(command, command->length >= 5), failed;
    int8_t other = staged_elsewhere(node, origin->session);
    teds_session *session = &node->sessions[origin->session];
    uint64_t now = teds_now(node);
    teds_source source;
    uint32_t offset;
    size_t staged = 0;
    if (id < 0) {
        return id;
    }
    if (find_fixed(node, (uint16_t)id, &source)) {
        return -TEDS_NOT_PERMITTED;
    }
    offset = teds_get32(command->payload + 1);
    if (other < 0) {
        (void)teds_staged(node, (uint16_t)id, &staged);
    }
    if (offset > staged) {
        return -TEDS_BAD_FORM;
    }
    if (other >= 0 && now < node->sessions[other].staged_at + STAGED_NS) {
        return -TEDS_BUSY;
    }
    if (!can_list(node, (uint16_t)id, other < 0) || (other >= 0 && 4 + command->length - 5 > TEDS_STAGING)) {
        return -TEDS_TOO_LARGE; /* which changes no staging */
    }
    if (teds_make_blank(node) != 0) {
        return -TEDS_FAILURE;
    }
    if (other >= 0) {
        teds_staging_drop(node);
    }
    failed = stage(node, (uint16_t)id, offset, command->payload + 5, command->length - 5);
    if (failed) {
        return failed;
    }
    session->staged = true;
    session->staged_at = now;
#if TEDS_OPERATION
    if (origin->arrival->kind == TEDS_AT_NFC) {
        teds_yield_sensors(node, origin->session);
    }
#endif
    return 0;
}

int teds_update(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    int id = named(command, command->length == 1), length, failed = 0;
    const uint8_t *image;
    size_t octets = 0;
    if (id < 0) {
        return id;
    }
    if (staged_elsewhere(node, origin->session) >= 0) {
        return -TEDS_BUSY;
    }
    image = teds_staged(node, (uint16_t)id, &octets);
    if (image == NULL) {
        return id == (int)TEDS_SECURITY_ID && node->staging_end > 0 ? -TEDS_WRONG_STATE
                                                                    : status_of(node, (uint16_t)id, out);
    }
    node->sessions[origin->session].staged_at = teds_now(node);
    if (id == (int)TEDS_SECURITY_ID) {
        uint16_t checksum = octets >= 2 ? teds_get16(image + octets - 2) : 0;
        failed = teds_commit(node);
        length = status((uint16_t)id, false, true, (uint32_t)octets, checksum, out);
    } else {
        failed = teds_own_check((uint8_t)id, image, octets) ? 0 : -TEDS_BAD_FORM;
        length = failed ? 0
                        : status((uint16_t)id, false, true, (uint32_t)octets, teds_get16(image + octets - 2), out);
    }
    return failed ? failed : length;
}
