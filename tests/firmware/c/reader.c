/* SPDX-License-Identifier: Apache-2.0 */
/* The Zephyr port of NFC over the stand-in kernel: what a reader does while the node's thread is busy with a command. */
#include "check.h"
#include "inside.h"
#include "memory.h"
#include "teds_zephyr.h"

#include <nfc_t4t_lib.h>
#include <string.h>

static nfc_t4t_callback_t say;
static unsigned answered;

int nfc_t4t_setup(nfc_t4t_callback_t callback, void *context)
{
    (void)context;
    say = callback;
    return 0;
}

int nfc_t4t_emulation_start(void)
{
    return 0;
}

int nfc_t4t_response_pdu_send(const uint8_t *pdu, size_t length)
{
    (void)pdu;
    answered += length >= 2;
    return 0;
}

uint64_t teds_zephyr_now(void)
{
    return 0;
}

void teds_zephyr_wake(void)
{
}

static int draw(char kind, uint8_t *out, size_t length)
{
    memset(out, kind == 'n' ? 0 : 1, length);
    return 0;
}

static void select_application(void)
{
    say(NULL, NFC_T4T_EVENT_DATA_IND, (const uint8_t *)"\x00\xa4\x04\x00\x07\xd2\x76\x00\x00\x85\x01\x01\x00", 13, 0);
}

int main(void)
{
    static const uint8_t uuid[10] = {1};
    memory_board *board = memory_new(uuid, 8, 0xFF, draw);
    memory_nfc(board, 4, 15, 200);
    CHECK(memory_start(board) == 0 && teds_zephyr_nfc_start() == 0, "starts");
    say(NULL, NFC_T4T_EVENT_FIELD_ON, NULL, 0, 0);
    select_application();
    CHECK(teds_zephyr_nfc_work(&board->node) && answered == 1, "an APDU is answered");
    board->node.sessions[0].used = true;
    board->node.sessions[0].link = TEDS_LINK_NFC;
    for (int i = 0; i < 5; i++) { /* all while the thread is in a command */
        select_application();
    }
    say(NULL, NFC_T4T_EVENT_FIELD_OFF, NULL, 0, 0);
    say(NULL, NFC_T4T_EVENT_FIELD_ON, NULL, 0, 0);
    CHECK(teds_zephyr_nfc_work(&board->node), "there is something to do");
    CHECK(!board->node.sessions[0].used, "the field was gone: its session ends");
    CHECK(answered == 1, "what was said in an earlier field is not answered into this one: %u", answered);
    select_application();
    CHECK(teds_zephyr_nfc_work(&board->node) && answered == 2, "this one is served");
    say(NULL, NFC_T4T_EVENT_FIELD_OFF, NULL, 0, 0);
    CHECK(teds_zephyr_nfc_work(&board->node) && !teds_zephyr_nfc_work(&board->node), "told once");
    memory_free(board);
    return ENDED("reader");
}
