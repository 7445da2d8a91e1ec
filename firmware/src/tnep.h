/* SPDX-License-Identifier: Apache-2.0 */
/* TNEP with an NFC reader, over NDEF messages. */
#ifndef TEDS_SRC_TNEP_H
#define TEDS_SRC_TNEP_H

#include "inside.h"

#if TEDS_NFC
enum { TEDS_NFC_QUIET, TEDS_NFC_WRITTEN };

/* True if the application's services have names and room in the initial message. */
bool teds_nfc_services_good(const teds_config *config);

/* Put the initial message into the file, at a start. */
void teds_nfc_start(teds_node *node);

/* Handle a message of this length that a reader has written into the file. */
void teds_nfc_came(teds_node *node, size_t length);

/* Answer the message that was written; update the initial message if the facts in it have changed. */
void teds_nfc_poll(teds_node *node);
#endif

#endif
