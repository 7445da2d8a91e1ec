/* The commit of a datasheet (security-teds.md, 5): every check in its order, then one transaction; and the other changes
 * of the durable state. */
#include "inside.h"

#define SEQUENCE_WINDOW 65536u

static bool keep_all(const void *what, uint16_t id)
{
    (void)what;
    (void)id;
    return true;
}

static bool keep_but_security(const void *what, uint16_t id)
{
    (void)what;
    return id != TEDS_SECURITY_ID;
}

/* A stored TEDS stays where the new Security TEDS lists it. */
static bool keep_listed(const void *what, uint16_t id)
{
    const teds_signed *signed_teds = what;
    for (size_t i = 0; i < signed_teds->block_count; i++) {
        const uint8_t *block = signed_teds->blocks + 37 * i + 2;
        if (teds_get16(block) == id >> 8 && block[2] == (id & 0xFF)) {
            return true;
        }
    }
    return false;
}

int teds_store_state(teds_node *node, const teds_state *state)
{
    return teds_store_write(node, state, keep_all, NULL, false);
}

int teds_to_factory(teds_node *node)
{
    teds_state state = {0};
    state.address = node->state.address;
    state.epoch = node->state.epoch;
    state.sequence = node->state.sequence;
    return teds_store_write(node, &state, keep_but_security, NULL, false);
}

/* 5: 101 and 102 are the node's own, 103 a point, 104 verifies under the kept CA, 100 under 103. */
static bool signatures_good(const teds_node *node, const teds_signed *teds, const uint8_t *block, size_t length)
{
    uint8_t own[88], hash[32];
    const teds_part station[] = {{(const uint8_t *)"TEDS1 station key", 18}, {teds->station, 65}};
    const size_t behind = teds->signature_at + 90;
    const teds_part tbs[] = {{(const uint8_t *)"TEDS1 datasheet", 16},
                             {node->uuid, 10},
                             {block, teds->signature_at},
                             {block + behind, length - behind}};
    teds_base64(node->point, 65, own);
    if (memcmp(own, teds->node_key, 88) != 0) {
        return false;
    }
    teds_base64(node->signature, 64, own);
    if (memcmp(own, teds->node_signature, 88) != 0) {
        return false;
    }
    if (teds->station[0] != 4 || !node->port->p256_good(node->port->user, teds->station)) {
        return false;
    }
    teds_sha256_parts(node, station, 2, hash);
    if (!teds_verify(node, node->state.ca, hash, teds->station_signature)) {
        return false;
    }
    teds_sha256_parts(node, tbs, 4, hash);
    return teds_verify(node, teds->station, hash, teds->signature);
}

static int digest_of(const teds_node *node, uint16_t id, uint8_t out[32])
{
    teds_source source;
    size_t length = 0;
    const uint8_t *image = teds_staged(node, id, &length);
    if (image != NULL) {
        const teds_part part = {image, length};
        teds_sha256_parts(node, &part, 1, out);
        return 0;
    }
    return teds_find(node, id, &source) && teds_source_hash(node, &source, out) == 0 ? 0 : -1;
}

/* 6: every listed block is staged or stored with its digest, and every staged image is listed. */
static bool blocks_good(const teds_node *node, const teds_signed *teds)
{
    int32_t after = -1;
    uint16_t id;
    uint8_t hash[32];
    for (size_t i = 0; i < teds->block_count; i++) {
        const uint8_t *block = teds->blocks + 37 * i + 2;
        uint16_t channel = teds_get16(block);
        if (channel > 255 || digest_of(node, (uint16_t)((uint32_t)channel << 8 | block[2]), hash) != 0 ||
            memcmp(hash, block + 3, 32) != 0) {
            return false;
        }
    }
    for (; teds_next_staged(node, after, &id); after = id) {
        if (id != TEDS_SECURITY_ID && !keep_listed(teds, id)) {
            return false;
        }
    }
    return true;
}

/* An octet of a listed block, wherever that lies. */
static int octet_of(const teds_node *node, uint16_t id, uint32_t at, uint32_t length, uint8_t *out, size_t octets)
{
    teds_source source;
    size_t staged_length = 0;
    const uint8_t *image = teds_staged(node, id, &staged_length);
    if (at + octets > length) {
        return -1;
    }
    if (image != NULL) {
        memcpy(out, image + at, octets);
        return 0;
    }
    return teds_find(node, id, &source) ? teds_source_read(node, &source, at, out, octets) : -1;
}

/* 9: field 4 of a Meta-TEDS of the 2007 form is there and is the node's UUID; other forms are not compared. */
static bool meta_names_node(const teds_node *node, uint16_t id)
{
    teds_source source;
    size_t staged = 0;
    const bool is_staged = teds_staged(node, id, &staged) != NULL;
    uint32_t length = is_staged ? (uint32_t)staged : teds_find(node, id, &source) ? source.length : 0;
    uint8_t head[10], value[10];
    uint32_t at = 10, width;
    if (length < 12 || octet_of(node, id, 0, length, head, 10) != 0) {
        return false;
    }
    if (head[4] != 3 || head[5] != 4) {
        return true;
    }
    width = head[9] != 0 ? head[9] : 1;
    while (at + 1 + width <= length - 2) {
        uint32_t octets = 0;
        if (octet_of(node, id, at, length, value, 1) != 0) {
            return false;
        }
        for (uint32_t i = 0; i < width; i++) {
            if (octets > 0xFFFF || octet_of(node, id, at + 1 + i, length, value + 1, 1) != 0) {
                return false;
            }
            octets = octets << 8 | value[1];
        }
        if (octets > length - 2 - at - 1 - width) {
            return false;
        }
        if (value[0] == 4 && octets == 10 && octet_of(node, id, at + 1 + width, length, value, 10) == 0 &&
            memcmp(value, node->uuid, 10) == 0) {
            return true;
        }
        at += 1 + width + octets;
    }
    return false;
}

static bool metas_good(const teds_node *node, const teds_signed *teds)
{
    for (size_t i = 0; i < teds->block_count; i++) {
        const uint8_t *block = teds->blocks + 37 * i + 2;
        if (block[2] == 1 && !meta_names_node(node, (uint16_t)(block[1] << 8 | block[2]))) {
            return false;
        }
    }
    return true;
}

static int check(const teds_node *node, teds_signed *teds, const uint8_t *image, size_t length)
{
    uint32_t ahead;
    if (!signatures_good(node, teds, image + 4, length - 6)) {
        return -TEDS_BAD_SIGNATURE;
    }
    if (!blocks_good(node, teds)) {
        return -TEDS_DIGEST_MISMATCH;
    }
    if (!metas_good(node, teds)) {
        return -TEDS_WRONG_UUID;
    }
    ahead = teds->sequence - node->state.sequence;
    if (teds->sequence <= node->state.sequence || ahead > SEQUENCE_WINDOW) {
        return -TEDS_STALE_SEQUENCE;
    }
    return teds->epoch == node->state.epoch ? 0 : -TEDS_WRONG_EPOCH;
}

int teds_commit(teds_node *node)
{
    int32_t after = -1;
    uint16_t id;
    size_t length = 0;
    const uint8_t *image;
    teds_signed teds;
    teds_state state;
    int failed;
    for (; teds_next_staged(node, after, &id); after = id) {
        image = teds_staged(node, id, &length);
        if (!teds_own_check((uint8_t)id, image, length)) {
            return -TEDS_BAD_FORM;
        }
    }
    image = teds_staged(node, TEDS_SECURITY_ID, &length);
    if (image == NULL || !teds_security_parse(image + 4, length - 6, &teds)) {
        return -TEDS_BAD_FORM;
    }
    failed = check(node, &teds, image, length);
    if (failed) {
        return failed;
    }
    state = node->state;
    state.sequence = teds.sequence;
    state.flags |= TEDS_PROVISIONED;
    failed = teds_store_write(node, &state, keep_listed, &teds, true);
    teds_wipe(&state, sizeof state);
    if (!failed) {
        teds_staging_drop(node);
    }
    return failed;
}
