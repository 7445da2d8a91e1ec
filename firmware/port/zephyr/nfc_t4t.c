/* A Type 4 tag by Nordic's nfc_t4t_lib (nRF Connect SDK; its licence is for Nordic's chips), in raw mode: it does ISO-DEP
 * and hands over APDUs.
 */
#include "teds_zephyr.h"

#include <nfc_t4t_lib.h>
#include <string.h>
#include <zephyr/kernel.h>

typedef struct said {
    uint8_t event; /* 0 field gone, 1 activated, 2 an APDU */
    uint16_t length;
    uint8_t octets[264];
} said;

K_MSGQ_DEFINE(teds_said, sizeof(said), 4, 4);
static uint8_t response[TEDS_T4T_OCTETS]; /* the library reads it until the reader has it */

static void on_nfc(void *context, nfc_t4t_event_t event, const uint8_t *data, size_t length, uint32_t flags)
{
    static said whole;    /* an APDU may come in parts: flags says that more follows */
    static bool too_long; /* longer than any that this tag's files allow: all of its parts are passed over */
    const bool more = (flags & NFC_T4T_DI_FLAG_MORE) != 0;
    (void)context;
    if (event == NFC_T4T_EVENT_FIELD_ON || event == NFC_T4T_EVENT_FIELD_OFF) {
        whole.event = event == NFC_T4T_EVENT_FIELD_ON;
        whole.length = 0;
        too_long = false;
        (void)k_msgq_put(&teds_said, &whole, K_NO_WAIT);
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
            whole.event = 2;
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
    bool moved = false;
    while (k_msgq_get(&teds_said, &one, K_NO_WAIT) == 0) {
        moved = true;
        if (one.event < 2) {
            teds_nfc_field(node, one.event == 1);
            continue;
        }
        (void)nfc_t4t_response_pdu_send(response, teds_t4t_apdu(node, one.octets, one.length, response));
        (void)teds_node_poll(node, teds_zephyr_now()); /* a command that it wrote is run before the reader looks again */
    }
    return moved;
}
