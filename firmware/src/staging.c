/* SPDX-License-Identifier: Apache-2.0 */
/* Staging: a memory area in RAM for images that are written before a commit, as consecutive entries of id 2, length 2,
 * image. */
#include "staging.h"
#include "inside.h"

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

/* Put `length` octets at `offset` of an image; octets after them are dropped. */
int teds_stage(teds_node *node, uint16_t id, uint32_t offset, const uint8_t *octets, size_t length)
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

bool teds_find_staged(const teds_node *node, uint16_t id, teds_source *out)
{
    size_t length;
    *out = (teds_source){.octets = teds_staged(node, id, &length)};
    out->length = (uint32_t)length;
    return out->octets != NULL;
}

void teds_next_staged(const teds_node *node, int32_t after, int32_t *found)
{
    for (size_t at = 0; at < node->staging_end; at += 4u + teds_get16(node->staging + at + 2)) {
        teds_keep_nearer(teds_get16(node->staging + at), after, found);
    }
}
