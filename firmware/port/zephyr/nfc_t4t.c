/* SPDX-License-Identifier: Apache-2.0 */
/* A Type 4 tag by Nordic's nfc_t4t_lib (nRF Connect SDK; its licence is for Nordic's chips), in raw mode: it does ISO-DEP
 * and hands over APDUs.
 */
#include "teds_zephyr.h"

#include <nfc_t4t_lib.h>
#include <string.h>
#include <zephyr/kernel.h>

/* An APDU, and in which activation it came: what was said to another is nobody's. */
typedef struct said {
    uint16_t length;
    atomic_val_t activation;
    uint8_t octets[264];
} said;

/* The field's coming and going is never queued: while a command runs a reader may try more often than a queue has room. */
K_MSGQ_DEFINE(teds_said, sizeof(said), 4, sizeof(atomic_val_t));
static atomic_t activations = ATOMIC_INIT(0), gone = ATOMIC_INIT(0);
static atomic_val_t known; /* the activation that the node has been told of */
static uint8_t response[TEDS_T4T_OCTETS]; /* the library reads it until the reader has it */

static void on_nfc(void *context, nfc_t4t_event_t event, const uint8_t *data, size_t length, uint32_t flags)
{
    static said whole;    /* an APDU may come in parts: flags says that more follows */
    static bool too_long; /* longer than any that this tag's files allow: all of its parts are passed over */
    const bool more = (flags & NFC_T4T_DI_FLAG_MORE) != 0;
    (void)context;
    if (event == NFC_T4T_EVENT_FIELD_ON || event == NFC_T4T_EVENT_FIELD_OFF) {
        if (event == NFC_T4T_EVENT_FIELD_ON) {
            (void)atomic_inc(&activations);
        } else {
            atomic_set(&gone, 1);
        }
        whole.length = 0;
        too_long = false;
    } else if (event == NFC_T4T_EVENT_DATA_IND) {
        too_long = too_long || length > sizeof whole.octets - whole.length;
        if (!too_long) {
            memcpy(whole.octets + whole.length, data, length);
            whole.length = (uint16_t)(whole.length + length);
        }
        if (more) {
            return;
        }
        if (!too_long) {
            whole.activation = atomic_get(&activations);
            (void)k_msgq_put(&teds_said, &whole, K_NO_WAIT);
        }
        whole.length = 0;
        too_long = false;
    }
    teds_zephyr_wake();
}

int teds_zephyr_nfc_start(void)
{
    const int failed = nfc_t4t_setup(on_nfc, NULL);
    return failed != 0 ? failed : nfc_t4t_emulation_start();
}

bool teds_zephyr_nfc_work(teds_node *node)
{
    said one;
    bool moved = atomic_cas(&gone, 1, 0);
    if (moved) {
        teds_nfc_field(node, false);
    }
    if (atomic_get(&activations) != known) {
        known = atomic_get(&activations);
        teds_nfc_field(node, true);
        moved = true;
    }
    while (k_msgq_get(&teds_said, &one, K_NO_WAIT) == 0) {
        moved = true;
        if (one.activation != known) {
            continue;
        }
        (void)nfc_t4t_response_pdu_send(response, teds_t4t_apdu(node, one.octets, one.length, response));
        (void)teds_node_poll(node, teds_zephyr_now()); /* a command that it wrote is run before the reader looks again */
    }
    return moved;
}
