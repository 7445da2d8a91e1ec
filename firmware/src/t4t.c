/* SPDX-License-Identifier: Apache-2.0 */
/* A Type 4 tag (NFC Forum T4T 2.0): one NDEF file that any reader can read and write, its APDUs, and ISO-DEP below them
 * (ISO/IEC 14443-4, 7). For chips without support for these in hardware or library. */
#include "tnep.h"
#include "inside.h"

#if TEDS_NFC

#define MLE 251u /* so that each APDU is one frame of 256 octets */
#define MLC 248u
#define CAPABILITY 1u
#define NDEF 2u

static const uint8_t OK[2] = {0x90, 0x00}, WRONG_LENGTH[2] = {0x67, 0x00}, NO_FILE[2] = {0x6A, 0x82},
                     NOT_ALLOWED[2] = {0x69, 0x86}, WRONG_OFFSET[2] = {0x6B, 0x00}, NO_SPACE[2] = {0x6A, 0x84},
                     NO_COMMAND[2] = {0x6D, 0x00};

static size_t file_octets(const teds_node *node)
{
    const uint16_t configured = node->config->nfc.max_ndef;
    return 2u + (configured != 0 && configured < TEDS_MAX_NDEF ? configured : TEDS_MAX_NDEF);
}

static size_t put_status_word(uint8_t *out, size_t at, const uint8_t status[2])
{
    memcpy(out + at, status, 2);
    return at + 2;
}

static size_t select_application(teds_node *node, const uint8_t *name, size_t length, uint8_t *out)
{
    static const uint8_t application[7] = {0xD2, 0x76, 0x00, 0x00, 0x85, 0x01, 0x01};
    if (length != sizeof application || memcmp(name, application, sizeof application) != 0) {
        return put_status_word(out, 0, NO_FILE);
    }
    node->nfc.opened = 1;
    node->nfc.file_open = 0;
    return put_status_word(out, 0, OK);
}

static size_t select_file(teds_node *node, const uint8_t *name, size_t length, uint8_t *out)
{
    node->nfc.file_open = 0;
    if (length == 2 && name[0] == 0xE1) {
        node->nfc.file_open = name[1] == 3 ? CAPABILITY : name[1] == 4 ? NDEF : 0;
    }
    return put_status_word(out, 0, node->nfc.file_open != 0 ? OK : NO_FILE);
}

static size_t read_binary(const teds_node *node, const uint8_t *apdu, size_t length, uint8_t *out)
{
    uint8_t capability[15] = {0, 15, 0x20, 0, MLE, 0, MLC, 4, 6, 0xE1, 4, 0, 0, 0, 0};
    const uint8_t *file = node->nfc.file_open == CAPABILITY ? capability : node->nfc.file;
    const size_t whole = node->nfc.file_open == CAPABILITY ? sizeof capability : file_octets(node);
    size_t offset = teds_get16(apdu + 2), octets = length == 5 && apdu[4] != 0 ? apdu[4] : 256;
    teds_put16(capability + 11, (uint16_t)file_octets(node));
    if (offset > whole) {
        return put_status_word(out, 0, WRONG_OFFSET);
    }
    octets = octets < whole - offset ? octets : whole - offset;
    memcpy(out, file + offset, octets);
    return put_status_word(out, octets, OK);
}

/* Writing a length other than 0 at the beginning of the file completes a message. */
static size_t update_binary(teds_node *node, size_t offset, const uint8_t *data, size_t length, uint8_t *out)
{
    size_t size;
    if (offset + length > file_octets(node)) {
        return put_status_word(out, 0, NO_SPACE);
    }
    node->nfc.stage = TEDS_NFC_QUIET; /* a reader that writes is not waiting for an answer */
    node->nfc.shows_initial = false;
    memcpy(node->nfc.file + offset, data, length);
    size = teds_get16(node->nfc.file);
    node->nfc.length = (uint16_t)(size < file_octets(node) - 2 ? size : file_octets(node) - 2);
    if (offset == 0 && length > 1 && node->nfc.length > 0) {
        teds_nfc_came(node, node->nfc.length);
    }
    return put_status_word(out, 0, OK);
}

size_t teds_t4t_apdu(teds_node *node, const uint8_t *apdu, size_t length, uint8_t out[TEDS_T4T_OCTETS])
{
    const uint8_t *data = apdu + 5;
    size_t octets = 0;
    if (length < 4) {
        return put_status_word(out, 0, WRONG_LENGTH);
    }
    if (length > 5) {
        octets = apdu[4] < length - 5 ? apdu[4] : length - 5;
    }
    if (apdu[1] == 0xA4 && apdu[2] == 4) {
        return select_application(node, data, octets, out);
    }
    if (node->nfc.opened == 0) {
        return put_status_word(out, 0, NOT_ALLOWED);
    }
    if (apdu[1] == 0xA4) {
        return select_file(node, data, octets, out);
    }
    if (apdu[1] == 0xB0 && node->nfc.file_open != 0) {
        return read_binary(node, apdu, length, out);
    }
    if (apdu[1] == 0xD6 && node->nfc.file_open == NDEF) {
        return update_binary(node, teds_get16(apdu + 2), data, octets, out);
    }
    return put_status_word(out, 0, NO_COMMAND);
}

/* -- ISO-DEP ------------------------------------------------------------------------------------------------------- */

size_t teds_isodep_start(teds_node *node, teds_isodep *card, const uint8_t *rats, size_t length, uint8_t out[5])
{
    static const uint16_t sizes[9] = {16, 24, 32, 40, 48, 64, 96, 128, 256};
    static const uint8_t ats[5] = {0x05, 0x78, 0x80, 0xB0, 0x00}; /* 256 octets, 106 kbit/s, FWI 11 (0.62 s), no CID */
    size_t size = length > 1 ? rats[1] >> 4 : 0;
    memset(card, 0, sizeof *card);
    card->information = (uint16_t)(sizes[size < 8 ? size : 8] - 3);
    card->number = 1;
    teds_nfc_field(node, true);
    memcpy(out, ats, sizeof ats);
    return sizeof ats;
}

/* Send the kept block: its PCB, then `last_length` octets of the APDU from `last_at` on. */
static size_t put_kept_block(const teds_isodep *card, uint8_t *out)
{
    out[0] = card->last;
    memcpy(out + 1, card->apdu + card->last_at, card->last_length);
    return 1u + card->last_length;
}

static size_t keep_block(teds_isodep *card, uint8_t pcb, size_t at, size_t length, uint8_t *out)
{
    card->last = pcb;
    card->last_at = (uint16_t)at;
    card->last_length = (uint16_t)length;
    return put_kept_block(card, out);
}

static size_t put_next_part(teds_isodep *card, uint8_t *out)
{
    size_t at = card->at, left = (size_t)(card->length - card->at);
    size_t length = left < card->information ? left : card->information;
    card->at = (uint16_t)(at + length);
    return keep_block(card, (uint8_t)(0x02u | (card->at < card->length ? 0x10u : 0) | card->number), at, length, out);
}

static size_t take_information(teds_node *node, teds_isodep *card, const uint8_t *block, size_t length, uint8_t *out)
{
    uint8_t answer[TEDS_T4T_OCTETS];
    size_t octets = length - 1;
    card->number ^= 1;
    if (!card->receives) {
        card->length = 0;
    }
    octets = octets < sizeof card->apdu - card->length ? octets : sizeof card->apdu - card->length;
    memcpy(card->apdu + card->length, block + 1, octets); /* a longer chain is cut, and is then refused */
    card->length = (uint16_t)(card->length + octets);
    card->receives = (block[0] & 0x10u) != 0;
    if (card->receives) {
        card->at = card->length;
        return keep_block(card, (uint8_t)(0xA2u | card->number), 0, 0, out);
    }
    octets = teds_t4t_apdu(node, card->apdu, card->length < 261 ? card->length : 261, answer);
    memcpy(card->apdu, answer, octets);
    card->length = (uint16_t)octets;
    card->at = 0;
    return put_next_part(card, out);
}

size_t teds_isodep_block(teds_node *node, teds_isodep *card, const uint8_t *block, size_t length, uint8_t out[256])
{
    uint8_t pcb;
    if (length == 0 || length > 256) {
        return 0;
    }
    /* blocks with CID or NAD, which our ATS does not offer, are for another card (ISO/IEC 14443-4, 7.1) */
    pcb = block[0];
    if ((pcb & 0xEEu) == 0x02u) {
        return take_information(node, card, block, length, out);
    }
    if ((pcb & 0xFEu) == 0xB2u) { /* R(NAK): the last block again, or none was received */
        if ((pcb & 1u) == card->number && card->last != 0) {
            return put_kept_block(card, out);
        }
        out[0] = (uint8_t)(0xA2u | card->number);
        return 1;
    }
    if ((pcb & 0xFEu) == 0xA2u) { /* R(ACK): the next part of a chain */
        if ((pcb & 1u) == card->number) {
            return card->last != 0 ? put_kept_block(card, out) : 0;
        }
        if (card->receives || card->at >= card->length) {
            return 0;
        }
        card->number ^= 1;
        return put_next_part(card, out);
    }
    if (pcb == 0xC2u) { /* S(DESELECT) */
        out[0] = pcb;
        return 1;
    }
    return 0;
}

#endif
