/* SPDX-License-Identifier: Apache-2.0 */
/* Start, time, and reset by hand of a node. commands.c answers commands; can.c, tnep.c and ble.c receive them. */
#include "about.h"
#include "can.h"
#include "clock.h"
#include "commit.h"
#include "crypto.h"
#include "manage.h"
#include "operation.h"
#include "replies.h"
#include "session_life.h"
#include "slots.h"
#include "tnep.h"
#include "transducers.h"
#include "inside.h"

int teds_node_init_as_built(teds_node *node, uint32_t built, const teds_config *config, const teds_port *port)
{
    uint8_t counter[8];
    teds_firmware firmware;
    int failed;
    if (built != teds_built()) {
        return TEDS_E_BUILD; /* the library's teds_node may be larger than the board's */
    }
    memset(node, 0, sizeof *node);
    node->config = config;
    node->port = port;
    if (port->p256_make == NULL || port->unit == 0 || port->unit > 32 || (port->unit & (port->unit - 1)) != 0 ||
        port->slot_octets < TEDS_STAGING + 256u || port->identity_octets < 192 ||
        (TEDS_NFC && config->nfc.present && config->nfc.max_ndef != 0 && config->nfc.max_ndef < 160)) {
        return TEDS_E_USAGE;
    }
#if TEDS_NFC
    if (config->nfc.present && !teds_nfc_services_good(config)) {
        return TEDS_E_USAGE;
    }
#endif
#if TEDS_OPERATION
    if (!teds_channels_good(port)) {
        return TEDS_E_USAGE;
    }
#endif
    (void)teds_firmware_read(node, &firmware); /* read first: during a trial no flash is changed */
    failed = teds_slots_load(node);
    if (failed) {
        return failed;
    }
    /* c of Open is random at each start, so that no earlier mac is accepted. */
    if (port->random(port->user, counter, sizeof counter) != 0) {
        return TEDS_E_RANDOM;
    }
    node->opens = teds_get64(counter);
    node->can.address = node->state.address;
#if TEDS_OPERATION
    teds_operation_start(node);
#endif
#if TEDS_NFC
    teds_nfc_start(node);
#endif
    return 0;
}

int teds_node_reset_by_hand(teds_node *node)
{
    int failed;
#if TEDS_OPERATION
    teds_make_all_safe(node);
#endif
    if (teds_on_trial(node) && node->port->restart != NULL) {
        node->port->restart(node->port->user);
        return 0;
    }
    failed = teds_in_factory(node) ? 0 : teds_to_factory(node); /* nothing is written if nothing changes */
    if (failed) {
        return TEDS_E_FLASH;
    }
    teds_sessions_end(node);
    return 0;
}

uint64_t teds_node_poll(teds_node *node, uint64_t now)
{
    uint64_t next = TEDS_NEVER;
#if TEDS_OPERATION
    next = teds_operation_poll(node, now);
#endif
#if TEDS_NFC
    teds_nfc_poll(node);
#endif
    teds_sooner(&next, teds_can_poll(node, now));
    teds_sooner(&next, teds_locate_poll(node, now));
#if TEDS_MANAGED
    teds_sooner(&next, teds_trial_poll(node, now));
#endif
    teds_slots_poll(node, now, teds_replies_wait(node, now));
#if TEDS_NFC
    if (node->old_slot_due && now < node->nfc.busy_until) {
        teds_sooner(&next, node->nfc.busy_until);
    }
#endif
    if (node->old_slot_due) {
        teds_sooner(&next, node->old_slot_by);
    }
    teds_sooner(&next, teds_sessions_poll(node, now)); /* last, since the calls above may have opened a session */
    return next;
}

bool teds_idle_work(teds_node *node)
{
    return !node->one_time.ready && teds_one_time_make(node) == 0;
}

uint64_t teds_node_missed(const teds_node *node)
{
#if TEDS_OPERATION
    uint64_t missed = node->missed;
    for (const teds_stream *each = node->streams; each < node->streams + TEDS_STREAMS; each++) {
        missed += each->missed; /* 0 if no stream runs in this place */
    }
    return missed;
#else
    (void)node;
    return 0;
#endif
}
