/* SPDX-License-Identifier: Apache-2.0 */
/* The TEDS that the node has now: fixed by the firmware, stored in the current slot, or the initial Security TEDS; and
 * those that it would have after a commit. */
#include "datasheet.h"
#include "slots.h"
#include "staging.h"
#include "teds_source.h"
#include "inside.h"

bool teds_storable(uint16_t channel, uint8_t code)
{
    return channel <= 255 && ((code >= 1 && code <= 17) || (code >= 128 && code <= 135));
}

static uint16_t fixed_id(const teds_fixed *each)
{
    return (uint16_t)((uint32_t)each->channel << 8 | each->code);
}

bool teds_find_fixed(const teds_node *node, uint16_t id, teds_source *out)
{
    for (size_t i = 0; i < node->config->fixed_count; i++) {
        const teds_fixed *each = &node->config->fixed[i];
        if (fixed_id(each) == id) {
            *out = (teds_source){.octets = each->octets, .length = each->length, .read_only = true};
            return true;
        }
    }
    return false;
}

bool teds_find(const teds_node *node, uint16_t id, teds_source *out)
{
    if (id == TEDS_SECURITY_ID && (node->state.flags & TEDS_PROVISIONED) == 0) {
        *out = (teds_source){.initial = true, .length = TEDS_INITIAL_OCTETS};
        return true;
    }
    return teds_find_fixed(node, id, out) || teds_find_stored(node, id, out);
}

bool teds_find_new(const teds_node *node, uint16_t id, teds_source *out)
{
    return teds_find_staged(node, id, out) || teds_find(node, id, out);
}

int32_t teds_next_id(const teds_node *node, int32_t after, unsigned among)
{
    int32_t found = TEDS_NO_ID;
    if ((among & TEDS_STORED) != 0 && !teds_next_stored(node, after, &found)) {
        return TEDS_UNREADABLE;
    }
    if ((among & TEDS_NOT_STORED) != 0) {
        for (size_t i = 0; i < node->config->fixed_count; i++) {
            teds_keep_nearer(fixed_id(&node->config->fixed[i]), after, &found);
        }
        teds_keep_nearer(TEDS_SECURITY_ID, after, &found);
    }
    if ((among & TEDS_STAGED) != 0) {
        teds_next_staged(node, after, &found);
    }
    return found;
}
