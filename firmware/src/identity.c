/* SPDX-License-Identifier: Apache-2.0 */
/* The node's identity: its UUID and identity key, made at the very first start and never changed, and the answers to
 * Identify and Announce. */
#include "identity.h"
#include "area.h"
#include "crypto.h"
#include "inside.h"

/* Identity area: magic 4, version 1, 0 0 0, UUID 10, key 32, point 65, field 102 64, zeros; the last 4 octets are the
 * CRC-32. */
#define IDENTITY_OCTETS 192u
static const uint8_t IDENTITY_MAGIC[8] = {'T', 'I', 'D', 'N', 1, 0, 0, 0};

/* -- the identity area --------------------------------------------------------------------------------------------- */

static int make_identity(teds_node *node)
{
    const teds_port *port = node->port;
    teds_identity *own = &node->identity;
    const teds_part parts[] = {{(const uint8_t *)"TEDS1 node key", 15}, {own->uuid, 10}, {own->point, 65}};
    teds_writing into = {.port = port, .area = TEDS_IDENTITY};
    memcpy(own->uuid, node->config->uuid, 10);
    if (port->p256_make(port->user, TEDS_KEY_SIGNS, &own->key, own->point) != 0) {
        return TEDS_E_RANDOM;
    }
    if (teds_sign(node, parts, 3, own->signature) != 0) {
        return TEDS_E_CRYPTO;
    }
    teds_area_put(&into, IDENTITY_MAGIC, sizeof IDENTITY_MAGIC);
    teds_area_put(&into, own, sizeof *own);
    return teds_area_close(&into, IDENTITY_OCTETS) != 0 ? TEDS_E_FLASH : 0;
}

static int read_identity(teds_node *node, bool *good)
{
    const teds_port *port = node->port;
    uint8_t magic[sizeof IDENTITY_MAGIC];
    if (teds_area_read(port, TEDS_IDENTITY, 0, magic, sizeof magic) != 0 ||
        teds_area_read(port, TEDS_IDENTITY, sizeof magic, &node->identity, sizeof node->identity) != 0 ||
        teds_area_crc_good(port, TEDS_IDENTITY, IDENTITY_OCTETS, good) != 0) {
        return TEDS_E_FLASH;
    }
    if (*good && memcmp(magic, IDENTITY_MAGIC, TEDS_FORM_AT) == 0 && magic[TEDS_FORM_AT] != IDENTITY_MAGIC[TEDS_FORM_AT]) {
        return TEDS_E_FORM;
    }
    *good = *good && memcmp(magic, IDENTITY_MAGIC, sizeof magic) == 0;
    return 0;
}

/* A torn identity may be erased while both slots are blank: the first start writes a slot before the node shows its
 * key. */
static int forget_torn_identity(const teds_port *port)
{
    for (int area = TEDS_SLOT_A; area <= TEDS_SLOT_B; area++) {
        uint32_t crc;
        bool blank;
        if (teds_area_scan(port, area, port->slot_octets, &blank, &crc) != 0) {
            return TEDS_E_FLASH;
        }
        if (!blank) {
            return TEDS_E_IDENTITY;
        }
    }
    return port->erase(port->user, TEDS_IDENTITY) != 0 ? TEDS_E_FLASH : 0;
}

int teds_identity_load(teds_node *node)
{
    const teds_port *port = node->port;
    uint32_t crc;
    bool blank, good;
    int failed;
    if (teds_area_scan(port, TEDS_IDENTITY, port->identity_octets, &blank, &crc) != 0) {
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
    return failed || good ? failed : TEDS_E_FLASH; /* what was just written does not read back */
}

/* -- identity and address as reported ------------------------------------------------------------------------------ */

uint32_t teds_uuid_crc(const teds_node *node)
{
    return teds_crc32(0, node->identity.uuid, sizeof node->identity.uuid);
}

uint8_t teds_default_address(const teds_node *node)
{
    return (uint8_t)(1 + teds_uuid_crc(node) % TEDS_LAST_ADDRESS);
}

uint8_t teds_state_octet(const teds_node *node)
{
    return teds_in_factory(node) ? 0 : (node->state.flags & TEDS_PROVISIONED) != 0 ? 2 : 1;
}

void teds_node_identify(const teds_node *node, uint8_t out[23])
{
    const teds_state *state = &node->state;
    out[0] = 1;
    memcpy(out + 1, node->identity.uuid, 10);
    out[11] = teds_state_octet(node);
    teds_put32(out + 12, state->epoch);
    teds_put32(out + 16, state->sequence);
    teds_put16(out + 20, TEDS_MAX_MESSAGE);
    out[22] = node->config->no_can ? 0 : node->can.address;
}
