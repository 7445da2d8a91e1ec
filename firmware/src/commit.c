/* SPDX-License-Identifier: Apache-2.0 */
/* The commit of a datasheet (security-teds.md, 5): all checks in order, then one transaction; and the return to factory
 * state. */
#include "commit.h"
#include "crypto.h"
#include "datasheet.h"
#include "security_teds.h"
#include "slots.h"
#include "staging.h"
#include "teds_source.h"
#include "inside.h"

#define SEQUENCE_WINDOW 65536u

int teds_to_factory(teds_node *node)
{
    teds_state state = {0};
    state.address = node->state.address;
    state.epoch = node->state.epoch;
    state.sequence = node->state.sequence;
    return teds_slots_write(node, &state, NULL);
}

/* 5: 101 and 102 are the node's own, 103 a point, 104 verifies under the kept CA, 100 under 103. */
static bool signatures_good(const teds_node *node, const teds_signed *teds, const uint8_t *block, size_t length)
{
    const uint8_t *station = teds->decoded[TEDS_STATION];
    const size_t behind = teds->signature_at + 90;
    const teds_part tbs[] = {{(const uint8_t *)"TEDS1 datasheet", 16},
                             {node->identity.uuid, 10},
                             {block, teds->signature_at},
                             {block + behind, length - behind}};
    return !teds->others && station[0] == 4 && node->port->p256_good(node->port->user, station) &&
           teds_station_certified(node, station, node->state.agreed.ca, teds->decoded[TEDS_STATION_SIGNATURE]) &&
           teds_verify(node, station, tbs, 4, teds->decoded[TEDS_SIGNATURE]);
}

/* 6: every listed block is staged or stored with its digest, and every staged image is listed. */
static bool blocks_good(const teds_node *node, const teds_signed *teds)
{
    teds_source source;
    uint8_t hash[32];
    for (size_t i = 0; i < teds->block_count; i++) {
        const uint8_t *block = teds_listed_block(teds, i);
        if (block[0] != 0 || !teds_find_new(node, teds_get16(block + 1), &source) ||
            teds_source_hash(node, &source, hash) != 0 || memcmp(hash, block + 3, 32) != 0) {
            return false;
        }
    }
    for (int32_t id = -1; (id = teds_next_id(node, id, TEDS_STAGED)) < TEDS_NO_ID;) {
        if (id != (int32_t)TEDS_SECURITY_ID && !teds_is_listed(teds, (uint16_t)id)) {
            return false;
        }
    }
    return true;
}

/* 9: field 4 of a Meta-TEDS of the 2007 form is there and is the node's UUID; other forms are not compared. */
static bool meta_names_node(const teds_node *node, uint16_t id)
{
    teds_walk in = {.node = node};
    uint8_t type, value[10];
    uint32_t at, length;
    if (!teds_find_new(node, id, &in.source) || in.source.length < 12 ||
        teds_source_read(node, &in.source, 0, value, 10) != 0) {
        return false;
    }
    if (value[4] != 3 || value[5] != 4) {
        return true;
    }
    in.at = 10;
    in.end = in.source.length - 2;
    in.width = value[9] != 0 ? value[9] : 1;
    while (teds_next_tuple(&in, &type, &at, &length)) {
        if (type == 4 && length == 10 && teds_source_read(node, &in.source, at, value, 10) == 0 &&
            memcmp(value, node->identity.uuid, 10) == 0) {
            return true;
        }
    }
    return false;
}

static bool metas_good(const teds_node *node, const teds_signed *teds)
{
    for (size_t i = 0; i < teds->block_count; i++) {
        const uint8_t *block = teds_listed_block(teds, i);
        if (block[2] == 1 && !meta_names_node(node, teds_get16(block + 1))) {
            return false;
        }
    }
    return true;
}

static int check_datasheet(const teds_node *node, teds_signed *teds, const uint8_t *image, size_t length)
{
    const uint32_t sequence = teds->numbers[0];
    if (!signatures_good(node, teds, image + 4, length - 6)) {
        return -TEDS_BAD_SIGNATURE;
    }
    if (!blocks_good(node, teds)) {
        return -TEDS_DIGEST_MISMATCH;
    }
    if (!metas_good(node, teds)) {
        return -TEDS_WRONG_UUID;
    }
    if (sequence <= node->state.sequence || sequence - node->state.sequence > SEQUENCE_WINDOW) {
        return -TEDS_STALE_SEQUENCE;
    }
    return teds->numbers[1] == node->state.epoch ? 0 : -TEDS_WRONG_EPOCH;
}

int teds_commit_state(teds_node *node, const teds_signed *teds)
{
    teds_state state = node->state;
    int failed;
    state.sequence = teds->numbers[0];
    state.flags |= TEDS_PROVISIONED;
    failed = teds_slots_write(node, &state, teds);
    teds_wipe(&state, sizeof state);
    return failed;
}

int teds_commit(teds_node *node)
{
    size_t length = 0;
    const uint8_t *image;
    teds_signed teds;
    int failed;
    for (int32_t id = -1; (id = teds_next_id(node, id, TEDS_STAGED)) < TEDS_NO_ID;) {
        image = teds_staged(node, (uint16_t)id, &length);
        if (!teds_own_check((uint8_t)id, image, length)) {
            return -TEDS_BAD_FORM;
        }
    }
    image = teds_staged(node, TEDS_SECURITY_ID, &length);
    if (image == NULL || !teds_security_parse(node, image + 4, length - 6, &teds)) {
        return -TEDS_BAD_FORM;
    }
    failed = check_datasheet(node, &teds, image, length);
    if (failed) {
        return failed;
    }
    failed = teds_commit_state(node, &teds);
    if (!failed) {
        teds_staging_drop(node);
    }
    return failed;
}
