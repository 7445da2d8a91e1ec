/* SPDX-License-Identifier: Apache-2.0 */
/* NFC (wire.md): the node's side of TNEP 1.0 over an NDEF message, and the pieces of requests and replies. One buffer
 * is the NDEF file: the reader's message is read from it, and the answer is put there. While a command runs it is
 * empty, which means "need more time". */
#include "tnep.h"
#include "ble.h"
#include "clock.h"
#include "identity.h"
#include "links.h"
#include "ndef.h"
#include "replies.h"
#include "inside.h"

#if TEDS_NFC

#define SERVICE "urn:nfc:xsn:teds-provision:tim"
#define ID_TYPE "teds-provision:id"
#define PIECE_HEAD 12u
#define ANSWER 1u
#define MORE 2u
#define STATUS_OCTETS 6u
#define BUSY_NS TEDS_SECOND /* a tag cannot notice that its answer was read, so flash is not erased for so long */
enum { SUCCESS = 0x00, PROTOCOL_ERROR = 0x01, GARBLED = 0x80 };

typedef struct piece {
    uint8_t flags;
    uint16_t transaction, total, offset;
    const uint8_t *body;
    size_t length;
} piece;

static size_t most_ndef(const teds_node *node)
{
    const uint16_t configured = node->config->nfc.max_ndef;
    return configured != 0 && configured < TEDS_MAX_NDEF ? configured : TEDS_MAX_NDEF;
}

static void show_message(teds_node *node, size_t length)
{
    node->nfc.length = (uint16_t)length;
    teds_put16(node->nfc.file, (uint16_t)length);
}

/* -- the initial message ------------------------------------------------------------------------------------------- */

/* WLCCAP and WLCSTAI of a board with a battery (NFC Forum WLC 2.0 as open sources read it); 0 without one. */
static size_t put_charge(const teds_node *node, uint8_t *out)
{
    static const uint8_t waits[4] = {0x09, 0x1E, 0x03, 0x0A};
    teds_power power = {0, 0xFF, 0, 0, 0};
    size_t at;
    if (node->port->power == NULL) {
        return 0;
    }
    node->port->power(node->port->user, &power);
    if ((power.flags & TEDS_POWER_BATTERY) == 0 || power.level == 0xFF) {
        return 0;
    }
    at = teds_ndef_head(out, TEDS_NDEF_BEGINS, TEDS_NDEF_WELL_KNOWN, "WLCCAP", 6, 6);
    out[at] = 0x20;
    out[at + 1] = (uint8_t)(((power.flags & TEDS_POWER_FULL) != 0 ? 0x80 : 0) | 0x01);
    memcpy(out + at + 2, waits, sizeof waits);
    at += 6;
    at += teds_ndef_head(out + at, 0, TEDS_NDEF_WELL_KNOWN, "WLCSTAI", 7, 2);
    out[at] = 0x01;
    out[at + 1] = power.level;
    return at + 2;
}

/* Bluetooth LE out-of-band record (Core Specification Supplement, MIME type of Bluetooth SIG): the address of this
 * node. */
static size_t put_out_of_band(const teds_node *node, uint8_t *out)
{
    static const char type[] = "application/vnd.bluetooth.le.oob";
    const uint8_t *address = node->config->ble_address;
    size_t at = teds_ndef_head(out, TEDS_NDEF_ENDS, TEDS_NDEF_MIME, type, sizeof type - 1, 12);
    out[at] = 0x08;
    out[at + 1] = 0x1B;
    for (size_t i = 0; i < 6; i++) {
        out[at + 2 + i] = address[5 - i];
    }
    out[at + 8] = 1; /* random */
    out[at + 9] = 0x02;
    out[at + 10] = 0x1C;
    out[at + 11] = 0x00; /* only as peripheral */
    return at + 12;
}

/* Service parameters: a Tp record of TNEP 1.0. All services of the tag have the same waiting times. */
static size_t put_service(const teds_node *node, uint8_t *out, uint8_t marks, const char *name)
{
    const size_t uri = strlen(name);
    size_t at = teds_ndef_head(out, marks, TEDS_NDEF_WELL_KNOWN, "Tp", 2, 7 + uri);
    out[at] = 0x10;
    out[at + 1] = (uint8_t)uri;
    memcpy(out + at + 2, name, uri);
    at += 2 + uri;
    out[at] = 0; /* single response */
    out[at + 1] = node->config->nfc.wt_int;
    out[at + 2] = node->config->nfc.n_wait;
    teds_put16(out + at + 3, (uint16_t)most_ndef(node));
    return at + 5;
}

static void show_initial(teds_node *node)
{
    const bool airs = TEDS_BLE && node->config->ble_address != NULL;
    uint8_t *out = node->nfc.file + 2;
    size_t at = put_charge(node, out);
    at += put_service(node, out + at, at == 0 ? TEDS_NDEF_BEGINS : 0, SERVICE);
    for (size_t i = 0; i < node->config->nfc.service_count; i++) {
        at += put_service(node, out + at, 0, node->config->nfc.services[i].name);
    }
    at += teds_ndef_head(out + at, airs ? 0 : TEDS_NDEF_ENDS, TEDS_NDEF_EXTERNAL, ID_TYPE, sizeof ID_TYPE - 1, 23);
    teds_node_identify(node, out + at);
    memcpy(node->nfc.shown, out + at, 23);
    node->nfc.shows_initial = true;
    at += 23;
    at += airs ? put_out_of_band(node, out + at) : 0;
    show_message(node, at);
}

/* -- pieces -------------------------------------------------------------------------------------------------------- */

static bool read_piece(const uint8_t *payload, size_t length, piece *out)
{
    uint32_t crc;
    if (payload == NULL || length < PIECE_HEAD || payload[0] != 1) {
        return false;
    }
    out->flags = payload[1];
    out->transaction = teds_get16(payload + 2);
    out->total = teds_get16(payload + 4);
    out->offset = teds_get16(payload + 6);
    out->body = payload + PIECE_HEAD;
    out->length = length - PIECE_HEAD;
    crc = teds_crc32(teds_crc32(0, payload, 8), out->body, out->length);
    return crc == teds_get32(payload + 8) && (out->length == 0 || out->offset + out->length <= out->total);
}

static size_t put_status(uint8_t *out, uint8_t marks, uint8_t status)
{
    size_t at = teds_ndef_head(out, marks, TEDS_NDEF_WELL_KNOWN, "Te", 2, 1);
    out[at] = status;
    return at + 1;
}

static void show_status(teds_node *node, uint8_t status)
{
    show_message(node, put_status(node->nfc.file + 2, TEDS_NDEF_BEGINS | TEDS_NDEF_ENDS, status));
}

/* Put Te 00 and a piece into the message; its body is copied. */
static void show_piece(teds_node *node, const piece *own)
{
    uint8_t *out = node->nfc.file + 2, *payload;
    size_t at = put_status(out, TEDS_NDEF_BEGINS, SUCCESS);
    at += teds_ndef_head(out + at, TEDS_NDEF_ENDS, TEDS_NDEF_EXTERNAL, TEDS_TIM_TYPE, sizeof TEDS_TIM_TYPE - 1,
                         PIECE_HEAD + own->length);
    payload = out + at;
    payload[0] = 1;
    payload[1] = own->flags;
    teds_put16(payload + 2, own->transaction);
    teds_put16(payload + 4, own->total);
    teds_put16(payload + 6, own->offset);
    if (own->length > 0) {
        memcpy(payload + PIECE_HEAD, own->body, own->length);
    }
    teds_put32(payload + 8, teds_crc32(teds_crc32(0, payload, 8), payload + PIECE_HEAD, own->length));
    show_message(node, at + PIECE_HEAD + own->length);
}

static size_t piece_room(const teds_node *node)
{
    size_t left = most_ndef(node) - STATUS_OCTETS - 3 - (sizeof TEDS_TIM_TYPE - 1);
    if (left > 255) {
        left = left - 3 > 255 ? left - 3 : 255; /* a payload length of 4 octets */
    }
    return left - PIECE_HEAD;
}

static void show_part(teds_node *node, uint16_t offset)
{
    const teds_stored_reply *reply = node->nfc.reply;
    const uint16_t total = (uint16_t)(reply->length - 1);
    piece own = {ANSWER, node->nfc.answered_transaction, total, offset < total ? offset : total, NULL, piece_room(node)};
    own.body = reply->octets + 1 + own.offset;
    if (own.length > (size_t)(total - own.offset)) {
        own.length = (size_t)(total - own.offset);
    }
    own.flags |= (uint8_t)(own.offset + own.length < total ? MORE : 0);
    show_piece(node, &own);
}

static void show_held(teds_node *node, const piece *asked)
{
    const teds_nfc *nfc = &node->nfc;
    const bool same = nfc->collects && nfc->transaction == asked->transaction && nfc->total == asked->total;
    const piece own = {ANSWER, asked->transaction, asked->total, same ? nfc->held : 0, NULL, 0};
    show_piece(node, &own);
}

static void collect_piece(teds_node *node, const piece *came)
{
    teds_nfc *nfc = &node->nfc;
    const teds_arrival arrival = {TEDS_AT_NFC, true, false, nfc->tick};
    uint8_t transaction[2];
    if (!nfc->collects || nfc->transaction != came->transaction || nfc->total != came->total) {
        nfc->collects = true;
        nfc->transaction = came->transaction;
        nfc->total = came->total;
        nfc->held = 0;
    }
    if (came->offset <= nfc->held) {
        for (size_t i = 0; i < came->length && came->offset + i < sizeof nfc->request; i++) {
            nfc->request[came->offset + i] = came->body[i]; /* a request longer than maxMessage is refused anyway */
        }
        nfc->held = (uint16_t)(came->offset + came->length);
        nfc->answered = false;
    }
    if (nfc->held < nfc->total) {
        show_held(node, came);
        return;
    }
    if (!nfc->answered) {
        teds_stored_reply *reply;
        teds_put16(transaction, nfc->transaction);
        reply = teds_answer(node, TEDS_LINK_NFC, &arrival, transaction, 2, nfc->request, nfc->total);
        nfc->reply = reply;
        nfc->answered = true;
        nfc->answered_transaction = nfc->transaction;
        teds_node_reply_left(node, TEDS_LINK_NFC);
    }
    show_part(node, 0);
}

/* -- services of the application ----------------------------------------------------------------------------------- */

bool teds_nfc_services_good(const teds_config *config)
{
    /* Besides WLC 26, our Tp 41, id 45 and out-of-band 47: the initial message must fit the tag. */
    const uint16_t configured = config->nfc.max_ndef;
    size_t octets = 160;
    for (size_t i = 0; i < config->nfc.service_count; i++) {
        const teds_nfc_service *each = &config->nfc.services[i];
        const size_t length = each->name == NULL || each->answer == NULL ? 0 : strlen(each->name);
        if (length == 0 || length > 128 || strcmp(each->name, SERVICE) == 0) {
            return false;
        }
        octets += 12 + length;
    }
    return octets <= (configured != 0 && configured < TEDS_MAX_NDEF ? configured : TEDS_MAX_NDEF);
}

/* Find the service with this name, from 1 on; 0: none. */
static uint8_t find_service(const teds_node *node, const teds_ndef *came)
{
    for (size_t i = 0; i < node->config->nfc.service_count; i++) {
        const char *name = node->config->nfc.services[i].name;
        if (came->selection_length == strlen(name) && memcmp(came->selection, name, came->selection_length) == 0) {
            return (uint8_t)(i + 1);
        }
    }
    return 0;
}

/* Answer a message for a service of the application. The answer uses the buffer of our own requests, since a reader
 * uses one service at a time. */
static void answer_other(teds_node *node, size_t length)
{
    const teds_nfc_service *service = &node->config->nfc.services[node->nfc.other - 1];
    const size_t left = most_ndef(node) - STATUS_OCTETS;
    const size_t space = left < sizeof node->nfc.request ? left : sizeof node->nfc.request;
    const int octets = service->answer(service->user, node->nfc.file + 2, length, node->nfc.request, space);
    uint8_t *out = node->nfc.file + 2;
    if (octets < 0 || (size_t)octets > space) {
        show_status(node, GARBLED);
    } else {
        const size_t at = put_status(out, octets == 0 ? TEDS_NDEF_BEGINS | TEDS_NDEF_ENDS : TEDS_NDEF_BEGINS, SUCCESS);
        memcpy(out + at, node->nfc.request, (size_t)octets);
        show_message(node, at + (size_t)octets);
    }
    teds_wipe(node->nfc.request, sizeof node->nfc.request);
}

/* -- messages of a reader ------------------------------------------------------------------------------------------ */

static void answer_message(teds_node *node, size_t length)
{
    teds_nfc *nfc = &node->nfc;
    teds_ndef came;
    piece own;
    if (!teds_ndef_read(nfc->file + 2, length, &came)) {
        show_status(node, GARBLED);
        return;
    }
    if (came.selection != NULL) {
        nfc->selected =
            came.selection_length == sizeof SERVICE - 1 && memcmp(came.selection, SERVICE, sizeof SERVICE - 1) == 0;
        nfc->other = find_service(node, &came);
        if (nfc->selected) {
            show_status(node, SUCCESS);
            return;
        }
        nfc->collects = nfc->collects && nfc->other == 0;
        if (nfc->other == 0) {
            show_initial(node);
            return;
        }
    }
    if (nfc->other != 0) {
        if (came.chunked) {
            show_status(node, GARBLED);
        } else {
            answer_other(node, length);
        }
        return;
    }
    if (!nfc->selected && came.charges) {
        show_initial(node);
        return;
    }
    if (came.payload == NULL || !nfc->selected) {
        show_status(node, PROTOCOL_ERROR);
        return;
    }
    if (!read_piece(came.payload, came.payload_length, &own) || (own.flags & ANSWER) != 0) {
        show_status(node, GARBLED);
    } else if (own.length > 0) {
        collect_piece(node, &own);
    } else if (nfc->answered && nfc->answered_transaction == own.transaction) {
        show_part(node, own.offset);
    } else {
        show_held(node, &own);
    }
}

static void forget_conversation(teds_node *node)
{
    node->nfc.collects = false;
    node->nfc.answered = false;
    node->nfc.selected = false;
    node->nfc.other = 0;
    node->nfc.stage = TEDS_NFC_QUIET;
    node->nfc.busy_until = 0;
    teds_wipe(node->nfc.request, sizeof node->nfc.request);
}

void teds_nfc_field(teds_node *node, bool present)
{
    if (present) {
        node->nfc.selected = false;
        node->nfc.other = 0;
        node->nfc.stage = TEDS_NFC_QUIET;
        node->nfc.opened = 0;
#if TEDS_BLE
        teds_ble_tapped(node);
#endif
        show_initial(node);
    } else {
        forget_conversation(node);
        teds_node_link_lost(node, TEDS_LINK_NFC);
    }
}

/* Take the message in the file; the file is empty from here on, until the answer is there. */
void teds_nfc_came(teds_node *node, size_t length)
{
    node->nfc.stage = TEDS_NFC_WRITTEN;
    node->nfc.tick = teds_now(node);
    node->nfc.busy_until = node->nfc.tick + BUSY_NS;
    node->nfc.came = (uint16_t)length;
    node->nfc.shows_initial = false;
    show_message(node, 0);
}

bool teds_nfc_written(teds_node *node, const uint8_t *message, size_t length)
{
    if (length == 0 || length > most_ndef(node)) {
        return false;
    }
    memcpy(node->nfc.file + 2, message, length);
    teds_nfc_came(node, length);
    return true;
}

const uint8_t *teds_nfc_message(const teds_node *node, size_t *length)
{
    *length = node->nfc.length;
    return node->nfc.file + 2;
}

void teds_nfc_poll(teds_node *node)
{
    if (!node->config->nfc.present) {
        return;
    }
    if (node->nfc.stage == TEDS_NFC_WRITTEN) {
        node->nfc.stage = TEDS_NFC_QUIET;
        answer_message(node, node->nfc.came);
        node->nfc.busy_until = teds_now(node) + BUSY_NS;
    } else if (node->nfc.shows_initial) {
        uint8_t identity[23];
        teds_node_identify(node, identity);
        if (memcmp(identity, node->nfc.shown, sizeof identity) != 0) {
            show_initial(node);
        }
    }
}

void teds_nfc_start(teds_node *node)
{
    if (node->config->nfc.present) {
        show_initial(node);
    }
}

#endif
