/* SPDX-License-Identifier: Apache-2.0 */
/* Query, Read, Write and Update of TEDS (security-teds.md, 4 and 5). Write stages; an Update of the Security TEDS is the
 * commit. */
#include "teds_commands.h"
#include "clock.h"
#include "commit.h"
#include "datasheet.h"
#include "operation.h"
#include "security_teds.h"
#include "slots.h"
#include "staging.h"
#include "teds_source.h"
#include "inside.h"

#define STAGED_NS (60u * TEDS_SECOND)

/* True if a sealed List has room for one more TEDS; `own`: staging belongs to this session. */
static bool can_list(const teds_node *node, uint16_t id, bool own)
{
    const unsigned among = own ? TEDS_STORED | TEDS_NOT_STORED | TEDS_STAGED : TEDS_STORED | TEDS_NOT_STORED;
    size_t count = 1;
    for (int32_t each = -1; (each = teds_next_id(node, each, among)) < TEDS_NO_ID;) {
        count += each != id ? 1 : 0;
    }
    return 3 * count <= TEDS_ROOM;
}

/* Return the id of the TEDS that a command names, or a reason negated. */
static int find_named(const teds_command *command)
{
    if (!teds_storable(command->channel, command->payload[0])) {
        return -TEDS_NO_SUCH_TEDS;
    }
    return (int)((uint32_t)command->channel << 8 | command->payload[0]);
}

/* The reply of Query and Update: attributes of a stored TEDS, or of the staged image instead. */
static int put_status_of(const teds_node *node, uint16_t id, bool staged, uint8_t *out)
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
    const int id = find_named(command);
    (void)origin;
    return id < 0 ? id : put_status_of(node, (uint16_t)id, false, out);
}

int teds_read(teds_node *node, const teds_command *command, teds_origin *origin, uint8_t *out)
{
    const int id = find_named(command);
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
    const int id = command->length >= 5 ? find_named(command) : -TEDS_BAD_FORM;
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
    if (teds_find_fixed(node, (uint16_t)id, &source)) {
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
        return -TEDS_TOO_LARGE; /* staging is not changed */
    }
    if (teds_slots_blank(node) != 0) {
        return -TEDS_FAILURE;
    }
    if (elsewhere) {
        teds_staging_drop(node);
    }
    failed = teds_stage(node, (uint16_t)id, offset, command->payload + 5, octets);
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
    const int id = find_named(command);
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
    length = put_status_of(node, (uint16_t)id, true, out); /* a successful commit stores what was staged */
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
