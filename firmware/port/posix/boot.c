/* SPDX-License-Identifier: Apache-2.0 */
/* The boot step of the host port: what MCUboot does with two slots, a trial and a security counter (its image format:
 * header, payload, protected TLVs, TLVs, all little-endian). */
#include "images.h"

#include <string.h>

#define MAGIC 0x96F3B83Du
#define HEADER_OCTETS 32u
#define PROTECTED_MAGIC 0x6908u
#define TLV_MAGIC 0x6907u
#define ENCRYPTED 0x0Cu
#define NOT_BOOTABLE 0x10u
enum { TLV_KEY_HASH = 0x01, TLV_SHA256 = 0x10, TLV_ECDSA = 0x22, TLV_COUNTER = 0x50, TLV_TEXT = 0x54A0 };
enum { SETTLED = 0, PENDING = 1, TRIAL = 2 };

static uint16_t get16(const uint8_t *at)
{
    return (uint16_t)(at[0] | at[1] << 8);
}

static uint32_t get32(const uint8_t *at)
{
    return (uint32_t)get16(at + 2) << 16 | get16(at);
}

static void put32(uint8_t *at, uint32_t value)
{
    for (size_t i = 0; i < 4; i++, value >>= 8) {
        at[i] = (uint8_t)value;
    }
}

/* -- an image ----------------------------------------------------------------------------------------------------------- */

static int fetch(const images *own, int slot, uint32_t at, uint8_t *out, size_t length)
{
    const images_flash *flash = &own->flash;
    return at > flash->slot_octets || length > flash->slot_octets - at ? -1 : flash->read(flash->user, slot, at, out, length);
}

/* One TLV's value, as far as it matters. */
static int take(const images *own, int slot, uint32_t at, uint16_t type, uint16_t length, bool is_protected, image_facts *out)
{
    uint8_t counter[4];
    switch (type) {
    case TLV_SHA256:
        out->has_hash = length == sizeof out->hash;
        return out->has_hash ? fetch(own, slot, at, out->hash, sizeof out->hash) : -1;
    case TLV_KEY_HASH:
        out->has_key = length == sizeof out->key_hash;
        return out->has_key ? fetch(own, slot, at, out->key_hash, sizeof out->key_hash) : 0;
    case TLV_ECDSA:
        out->signature_length = (uint8_t)(length <= sizeof out->signature ? length : 0);
        return fetch(own, slot, at, out->signature, out->signature_length);
    case TLV_COUNTER:
        if (!is_protected || length != 4 || fetch(own, slot, at, counter, 4) != 0) {
            return -1;
        }
        out->has_counter = true;
        out->counter = get32(counter);
        return 0;
    case TLV_TEXT:
        if (is_protected && length < sizeof out->text && fetch(own, slot, at, (uint8_t *)out->text, length) == 0) {
            out->text[length] = '\0';
        }
        return 0;
    default: return 0;
    }
}

/* TLVs from `at` on under this magic; where they end, or 0. */
static uint32_t take_all(const images *own, int slot, uint32_t at, uint16_t magic, image_facts *out)
{
    uint8_t head[4];
    uint32_t end;
    if (fetch(own, slot, at, head, 4) != 0 || get16(head) != magic) {
        return 0;
    }
    end = at + get16(head + 2);
    for (at += 4; at + 4 <= end;) {
        uint16_t length;
        if (fetch(own, slot, at, head, 4) != 0) {
            return 0;
        }
        length = get16(head + 2);
        at += 4;
        if (length > end - at || take(own, slot, at, get16(head), length, magic == PROTECTED_MAGIC, out) != 0) {
            return 0;
        }
        at += length;
    }
    return at == end ? end : 0;
}

/* Read the header of an image; false if there is none in the slot. */
bool image_read(const images *own, int slot, image_facts *out)
{
    uint8_t head[HEADER_OCTETS];
    uint32_t at, protected_octets;
    memset(out, 0, sizeof *out);
    if (fetch(own, slot, 0, head, sizeof head) != 0 || get32(head) != MAGIC) {
        return false;
    }
    out->header = get16(head + 8);
    protected_octets = get16(head + 10);
    out->octets = get32(head + 12);
    out->flags = get32(head + 16);
    out->major = head[20];
    out->minor = head[21];
    out->patch = get16(head + 22);
    out->build = get32(head + 24);
    if (out->header < HEADER_OCTETS || out->octets > own->flash.slot_octets) {
        return false;
    }
    if (fetch(own, slot, out->header, (uint8_t *)out->behaviour, sizeof out->behaviour - 1) != 0) {
        return false;
    }
    at = out->header + out->octets;
    out->signed_octets = at + protected_octets;
    if (protected_octets != 0 && take_all(own, slot, at, PROTECTED_MAGIC, out) != out->signed_octets) {
        return false;
    }
    return take_all(own, slot, out->signed_octets, TLV_MAGIC, out) != 0 && out->has_hash;
}

/* An INTEGER of at most 32 octets in DER, to the right in `out`; what follows it, or NULL. */
static const uint8_t *integer(const uint8_t *at, const uint8_t *end, uint8_t out[32])
{
    size_t length;
    if (end - at < 2 || at[0] != 2 || at[1] > end - at - 2) {
        return NULL;
    }
    length = at[1];
    at += 2;
    for (; length > 32 && *at == 0; length--) {
        at++;
    }
    if (length > 32) {
        return NULL;
    }
    memset(out, 0, 32);
    memcpy(out + 32 - length, at, length);
    return at + length;
}

static bool signature_good(const images *own, const image_facts *facts)
{
    const uint8_t *at = facts->signature;
    uint8_t raw[64];
    if (facts->signature_length < 8 || at[0] != 0x30 || at[1] > facts->signature_length - 2) {
        return false; /* behind it there may be padding: imgtool sign --pad-sig */
    }
    at = integer(at + 2, facts->signature + 2 + facts->signature[1], raw);
    return at != NULL && integer(at, facts->signature + 2 + facts->signature[1], raw + 32) != NULL &&
           own->port->p256_verify(own->port->user, own->owner, facts->hash, raw);
}

/* True if the owner signed the image in this slot and no octet of it has changed. */
static bool image_good(const images *own, int slot, image_facts *out)
{
    uint8_t piece[256], hash[32];
    teds_sha256 state;
    if (!image_read(own, slot, out) || (out->flags & (ENCRYPTED | NOT_BOOTABLE)) != 0 || !out->has_key ||
        memcmp(out->key_hash, own->owner_hash, 32) != 0 || (own->keeps_counter && !out->has_counter)) {
        return false;
    }
    own->port->sha256_start(own->port->user, &state);
    for (uint32_t at = 0; at < out->signed_octets; at += sizeof piece) {
        const size_t length = out->signed_octets - at < sizeof piece ? out->signed_octets - at : sizeof piece;
        if (fetch(own, slot, at, piece, length) != 0) {
            return false;
        }
        own->port->sha256_update(own->port->user, &state, piece, length);
    }
    own->port->sha256_finish(own->port->user, &state, hash);
    return memcmp(hash, out->hash, 32) == 0 && signature_good(own, out);
}

int images_owner(images *own, const uint8_t *der, size_t length)
{
    static const uint8_t head[26] = {0x30, 0x59, 0x30, 0x13, 0x06, 0x07, 0x2A, 0x86, 0x48, 0xCE, 0x3D, 0x02, 0x01,
                                     0x06, 0x08, 0x2A, 0x86, 0x48, 0xCE, 0x3D, 0x03, 0x01, 0x07, 0x03, 0x42, 0x00};
    teds_sha256 state;
    if (length != sizeof head + 65 || memcmp(der, head, sizeof head) != 0 ||
        !own->port->p256_good(own->port->user, der + sizeof head)) {
        return -1;
    }
    memcpy(own->owner, der + sizeof head, 65);
    own->port->sha256_start(own->port->user, &state);
    own->port->sha256_update(own->port->user, &state, der, length);
    own->port->sha256_finish(own->port->user, &state, own->owner_hash);
    return 0;
}

/* -- records: which slot runs, and how -------------------------------------------------------------------------------------- */

/* 'B', form, slot, mode, counter 4, sequence 4, CRC-32 4; one after another, in two pages that take turns. */
#define RECORD_OCTETS 16u

static uint32_t crc_of(const uint8_t *octets, size_t length)
{
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t i = 0; i < length; i++) {
        crc ^= octets[i];
        for (int bit = 0; bit < 8; bit++) {
            crc = (crc & 1u) != 0 ? crc >> 1 ^ 0xEDB88320u : crc >> 1;
        }
    }
    return ~crc;
}

static int records_read(images *own)
{
    uint8_t record[RECORD_OCTETS];
    bool any = false;
    own->active = IMAGES_FIRST;
    own->mode = SETTLED;
    own->counter = own->sequence = own->next_record = 0;
    for (uint32_t at = 0; at < IMAGES_RECORD_OCTETS; at += RECORD_OCTETS) {
        if (own->flash.read(own->flash.user, IMAGES_RECORDS, at, record, sizeof record) != 0) {
            return -1;
        }
        if (record[0] == 'B' && record[1] == 1 && record[2] <= 1 && record[3] <= TRIAL &&
            get32(record + 12) == crc_of(record, 12) && (!any || get32(record + 8) > own->sequence)) {
            any = true;
            own->active = record[2];
            own->mode = record[3];
            own->counter = get32(record + 4);
            own->sequence = get32(record + 8);
            own->next_record = at + RECORD_OCTETS;
        }
    }
    return 0;
}

static bool is_blank(const uint8_t *octets, size_t length)
{
    for (size_t i = 0; i < length; i++) {
        if (octets[i] != 0xFF) {
            return false;
        }
    }
    return true;
}

/* Write the next record. A torn one is passed over; in the last place of a page the other page is erased before. */
static int decide(images *own, uint8_t active, uint8_t mode, uint32_t counter)
{
    uint8_t record[RECORD_OCTETS];
    uint32_t at = own->next_record;
    const uint32_t page = at == 0 ? 0 : (at - RECORD_OCTETS) / IMAGES_PAGE * IMAGES_PAGE;
    for (; at < page + IMAGES_PAGE; at += RECORD_OCTETS) {
        if (own->flash.read(own->flash.user, IMAGES_RECORDS, at, record, sizeof record) != 0) {
            return -1;
        }
        if (is_blank(record, sizeof record)) {
            break;
        }
    }
    if (at == page + IMAGES_PAGE) {
        at = page == 0 ? IMAGES_PAGE : 0;
        if (own->flash.erase(own->flash.user, IMAGES_RECORDS, at) != 0) {
            return -1;
        }
    }
    record[0] = 'B';
    record[1] = 1;
    record[2] = active;
    record[3] = mode;
    put32(record + 4, counter);
    put32(record + 8, own->sequence + 1);
    put32(record + 12, crc_of(record, 12));
    if (own->flash.write(own->flash.user, IMAGES_RECORDS, at, record, sizeof record) != 0) {
        return -1;
    }
    own->active = active;
    own->mode = mode;
    own->counter = counter;
    own->sequence++;
    own->next_record = at + RECORD_OCTETS;
    return 0;
}

/* -- starting ------------------------------------------------------------------------------------------------------------------ */

static uint8_t other(const images *own)
{
    return own->active == IMAGES_FIRST ? IMAGES_SECOND : IMAGES_FIRST;
}

static bool may_start(const images *own, int slot, image_facts *facts)
{
    return image_good(own, slot, facts) && (!own->keeps_counter || facts->counter >= own->counter);
}

static int change(images *own)
{
    image_facts facts;
    if (own->mode == TRIAL) { /* not confirmed */
        return decide(own, other(own), SETTLED, own->counter);
    }
    if (own->mode == PENDING && may_start(own, other(own), &facts)) {
        return decide(own, other(own), TRIAL, own->counter);
    }
    if (own->mode == PENDING) { /* it never starts: gone, as MCUboot erases it */
        return own->flash.erase(own->flash.user, other(own), 0) != 0 ? -1 : decide(own, own->active, SETTLED, own->counter);
    }
    return 0;
}

int images_boot(images *own)
{
    uint8_t head[HEADER_OCTETS];
    memset(&own->upload, 0, sizeof own->upload);
    if (records_read(own) != 0 || change(own) != 0 || fetch(own, own->active, 0, head, sizeof head) != 0) {
        return -1;
    }
    if (own->sequence == 0 && is_blank(head, sizeof head)) {
        return 1;
    }
    if (!image_good(own, own->active, &own->running)) {
        return -1;
    }
    if (own->keeps_counter && own->mode == SETTLED && own->running.counter > own->counter) {
        return decide(own, own->active, SETTLED, own->running.counter);
    }
    return 0;
}

bool images_on_trial(const images *own)
{
    return own->mode == TRIAL;
}

bool images_pending(const images *own)
{
    return own->mode == PENDING;
}

int images_confirm(images *own)
{
    return own->mode == SETTLED ? 0 : decide(own, own->active, SETTLED, own->counter);
}

int images_try(images *own)
{
    return decide(own, own->active, PENDING, own->counter);
}

void images_about(const images *own, teds_firmware *out)
{
    out->flags = (uint8_t)(TEDS_FIRMWARE_SIGNED | (own->keeps_counter ? TEDS_FIRMWARE_COUNTER : 0) |
                           (own->mode == TRIAL ? TEDS_FIRMWARE_ON_TRIAL : 0) |
                           (own->mode == PENDING ? TEDS_FIRMWARE_PENDING : 0));
    out->major = own->running.major;
    out->minor = own->running.minor;
    out->patch = own->running.patch;
    out->build = own->running.build;
    memcpy(out->image, own->running.hash, sizeof out->image);
    if (own->running.text[0] != '\0') {
        out->text = own->running.text;
    }
}
