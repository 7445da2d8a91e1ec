/* SPDX-License-Identifier: Apache-2.0 */
/* Two slots of flash take turns to hold a node's state and its TEDS. To write: erase the free slot; write head, records
 * and CRC in ascending units; read it back; only then it counts, and RAM is updated. The old slot is erased after the
 * reply was sent. At a start, the good slot with the higher counter counts, and the other one is erased unless blank:
 * after any interruption, either the old or the new state is complete. */
#include "slots.h"
#include "area.h"
#include "clock.h"
#include "identity.h"
#include "security_teds.h"
#include "staging.h"
#include "teds_source.h"
#include "inside.h"

/* Head of a slot: magic 4, version 1, flags 1, address 1, 0, counter 4, octets of all but the CRC 4, octets of records
 * 4, epoch 4, sequence 4, key 16, station 65, CA 65, zeros. Then records: id 2, 0 0, length 4, TEDS. The slot ends with
 * a CRC-32. */
#define HEAD_OCTETS 192u
#define NUMBERS_OCTETS 28u /* of the head, up to the key */
#define RECORD_OCTETS 8u
#define PIECE 64u
#define OLD_SLOT_NS (15u * TEDS_SECOND) /* stations repeat no command after that */
static const uint8_t SLOT_MAGIC[5] = {'T', 'S', 'L', 'T', 1};

/* -- records ------------------------------------------------------------------------------------------------------- */

/* Read the record at `at`, or return false at the end. Moves `at` to the next record; if flash cannot be read, `at`
 * remains before the end. */
static bool next_record(const teds_node *node, uint32_t *at, uint16_t *id, teds_source *source)
{
    uint8_t head[RECORD_OCTETS];
    if (*at + RECORD_OCTETS > node->records_end || teds_area_read(node->port, node->slot, *at, head, sizeof head) != 0) {
        return false;
    }
    *id = teds_get16(head);
    *source = (teds_source){.length = teds_get32(head + 4), .at = *at + RECORD_OCTETS};
    *at = source->at + source->length;
    return *at <= node->records_end;
}

bool teds_find_stored(const teds_node *node, uint16_t id, teds_source *out)
{
    uint32_t at = HEAD_OCTETS;
    uint16_t each;
    while (next_record(node, &at, &each, out)) {
        if (each == id) {
            return true;
        }
    }
    /* If flash cannot be read, the TEDS may exist: reading it fails, so that the reply is not 18. */
    *out = (teds_source){.unreadable = at != node->records_end, .length = 12};
    return out->unreadable;
}

bool teds_next_stored(const teds_node *node, int32_t after, int32_t *found)
{
    uint32_t at = HEAD_OCTETS;
    uint16_t id;
    teds_source source;
    while (next_record(node, &at, &id, &source)) {
        teds_keep_nearer(id, after, found);
    }
    return at == node->records_end;
}

/* -- at a start ---------------------------------------------------------------------------------------------------- */

/* Read the numbers of a slot's head; `good` if the slot is. A complete slot of other firmware's form is never treated
 * as torn: the start fails, and an image on trial reverts. */
static int read_head(const teds_port *port, int area, uint8_t head[NUMBERS_OCTETS], bool *good)
{
    uint32_t total;
    int failed;
    *good = false;
    if (teds_area_read(port, area, 0, head, NUMBERS_OCTETS) != 0) {
        return TEDS_E_FLASH;
    }
    total = teds_get32(head + 12);
    if (memcmp(head, SLOT_MAGIC, TEDS_FORM_AT) != 0 || total < NUMBERS_OCTETS + 4 || total > port->slot_octets) {
        return 0;
    }
    failed = teds_area_crc_good(port, area, total, good);
    if (!failed && *good && head[TEDS_FORM_AT] != SLOT_MAGIC[TEDS_FORM_AT]) {
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
    return teds_area_read(node->port, area, NUMBERS_OCTETS, &state->agreed, sizeof state->agreed) != 0 ? TEDS_E_FLASH : 0;
}

int teds_slots_load(teds_node *node)
{
    const teds_port *port = node->port;
    uint8_t head[2][NUMBERS_OCTETS];
    bool good[2], blank;
    uint32_t crc;
    int failed = teds_identity_load(node);
    node->records_end = HEAD_OCTETS;
    if (failed) {
        return failed;
    }
    for (int i = 0; i < 2; i++) {
        failed = read_head(port, TEDS_SLOT_A + i, head[i], &good[i]);
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
            node->free_slot_dirty = true; /* it is erased when the image is confirmed */
            continue;
        }
        if (teds_area_scan(port, TEDS_SLOT_A + i, port->slot_octets, &blank, &crc) != 0 ||
            (!blank && port->erase(port->user, TEDS_SLOT_A + i) != 0)) {
            if (!good[0] && !good[1]) {
                return TEDS_E_FLASH;
            }
            /* the other slot is whole, which is enough to measure */
            node->free_slot_dirty = node->spare_slot_fails = true;
        }
    }
    if (good[0] || good[1]) {
        return take_slot(node, good[0] ? TEDS_SLOT_A : TEDS_SLOT_B, head[good[0] ? 0 : 1]);
    }
    node->slot = TEDS_SLOT_B; /* nothing is stored: write A now, which makes the identity permanent */
    node->state.address = teds_default_address(node);
    if (teds_slots_write(node, &node->state, NULL) != 0) {
        return TEDS_E_FLASH;
    }
    node->free_slot_dirty = node->old_slot_due = false; /* B is blank */
    return 0;
}

/* -- writing ------------------------------------------------------------------------------------------------------- */

static int free_slot(const teds_node *node)
{
    return node->slot == TEDS_SLOT_A ? TEDS_SLOT_B : TEDS_SLOT_A;
}

int teds_slots_blank(teds_node *node)
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

void teds_slots_poll(teds_node *node, uint64_t now, bool waits)
{
    if (node->old_slot_due && (!waits || now >= node->old_slot_by)) {
        node->old_slot_due = false; /* if it fails, the next Write or start erases the slot */
        (void)teds_slots_blank(node);
    }
}

static uint32_t whole_units(const teds_port *port, uint32_t octets)
{
    return (octets + port->unit - 1) & ~(uint32_t)(port->unit - 1); /* the unit is a power of two */
}

static void put_record(const teds_node *node, teds_writing *into, uint16_t id, const teds_source *source)
{
    uint8_t head[RECORD_OCTETS] = {0}, piece[PIECE];
    teds_put16(head, id);
    teds_put32(head + 4, source->length);
    teds_area_put(into, head, sizeof head);
    for (uint32_t at = 0; at < source->length && !into->failed; at += sizeof piece) {
        size_t octets = source->length - at < sizeof piece ? source->length - at : sizeof piece;
        into->failed = teds_source_read(node, source, at, piece, octets);
        teds_area_put(into, piece, octets);
    }
}

/* The next record that may be copied to the new slot. */
static int32_t next_record_id(const teds_node *node, int32_t after, const teds_signed *commit)
{
    int32_t found = TEDS_NO_ID;
    if (!teds_next_stored(node, after, &found)) {
        return TEDS_UNREADABLE;
    }
    if (commit != NULL) {
        teds_next_staged(node, after, &found);
    }
    return found;
}

/* Write the records of the new slot in ascending order to `into`, or (NULL) only count their octets. -1: the old slot
 * cannot be read. */
static int32_t put_records(const teds_node *node, teds_writing *into, const teds_state *state, const teds_signed *commit)
{
    int32_t id = -1, octets = 0;
    while ((id = next_record_id(node, id, commit)) < TEDS_NO_ID) {
        teds_source source;
        if (commit == NULL || !teds_find_staged(node, (uint16_t)id, &source)) {
            if (commit != NULL ? !teds_is_listed(commit, (uint16_t)id)
                               : id == (int32_t)TEDS_SECURITY_ID && (state->flags & TEDS_PROVISIONED) == 0) {
                continue;
            }
            if (!teds_find_stored(node, (uint16_t)id, &source)) {
                return -1;
            }
        }
        octets += (int32_t)(RECORD_OCTETS + source.length);
        if (into != NULL) {
            put_record(node, into, (uint16_t)id, &source);
        }
    }
    return id == TEDS_NO_ID ? octets : -1;
}

int teds_slots_write(teds_node *node, const teds_state *state, const teds_signed *commit)
{
    const teds_port *port = node->port;
    const int32_t octets = put_records(node, NULL, state, commit);
    uint32_t total;
    uint8_t head[NUMBERS_OCTETS] = {0};
    teds_writing into = {.port = port, .area = free_slot(node)};
    bool good = false;
    if (octets < 0) {
        return -TEDS_FAILURE;
    }
    total = whole_units(port, HEAD_OCTETS + (uint32_t)octets + 4);
    if (total > port->slot_octets) {
        return -TEDS_TOO_LARGE;
    }
    if (teds_slots_blank(node) != 0) {
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
    node->free_slot_dirty = true; /* until the write succeeds; then the old slot is the dirty one */
    teds_area_put(&into, head, sizeof head);
    teds_area_put(&into, &state->agreed, sizeof state->agreed);
    teds_area_pad(&into, HEAD_OCTETS);
    good = put_records(node, &into, state, commit) == octets && teds_area_close(&into, total) == 0 &&
           teds_area_crc_good(port, into.area, total, &good) == 0 && good;
    teds_wipe(into.buffer, sizeof into.buffer);
    if (!good) {
        /* A slot that cannot be read back now might count at the next start, so erase it. */
        (void)teds_slots_blank(node);
        return -TEDS_FAILURE;
    }
    node->state = *state;
    node->slot = (uint8_t)into.area;
    node->slot_counter++;
    node->records_end = HEAD_OCTETS + (uint32_t)octets;
    node->old_slot_due = true;
    node->old_slot_by = teds_now(node) + OLD_SLOT_NS;
    node->identity_changed = true;
    return 0;
}
