/* SPDX-License-Identifier: Apache-2.0 */
/* NDEF framing (NFC Forum NDEF 1.0, 3.2): reading messages of a reader, and writing records. */
#include "ndef.h"
#include "inside.h"

#if TEDS_NFC

#define BEGINS 0x80u
#define ENDS 0x40u
#define CHUNKED 0x20u
#define SHORT 0x10u
#define HAS_ID 0x08u
#define UNCHANGED 6u

typedef struct record {
    uint8_t flags;
    uint8_t *type, *payload;
    size_t type_length, payload_length, end;
} record;

static bool cut_record(uint8_t *message, size_t length, size_t at, record *out)
{
    size_t wide, start, id = 0;
    uint32_t size;
    if (length - at < 2) {
        return false;
    }
    out->flags = message[at];
    wide = (out->flags & SHORT) != 0 ? 1 : 4;
    start = at + 2 + wide + ((out->flags & HAS_ID) != 0 ? 1 : 0);
    if (start > length) {
        return false;
    }
    out->type_length = message[at + 1];
    size = wide == 1 ? message[at + 2] : teds_get32(message + at + 2);
    id = (out->flags & HAS_ID) != 0 ? message[start - 1] : 0;
    if (out->type_length + id > length - start || size > length - start - out->type_length - id) {
        return false;
    }
    out->type = message + start;
    out->payload = message + start + out->type_length + id;
    out->payload_length = size;
    out->end = start + out->type_length + id + size;
    return true;
}

static bool is_type(const record *each, uint8_t tnf, const char *name, size_t length)
{
    if ((each->flags & 7u) != tnf || each->type_length != length) {
        return false;
    }
    for (size_t i = 0; i < length; i++) {
        uint8_t octet = each->type[i];
        if (tnf == TEDS_NDEF_EXTERNAL && octet >= 'A' && octet <= 'Z') {
            octet = (uint8_t)(octet + ('a' - 'A')); /* external types are compared without case */
        }
        if (octet != (uint8_t)name[i]) {
            return false;
        }
    }
    return true;
}

/* Note the parts of a whole record, with its chunks joined, that the profile uses. False: an inconsistent service
 * selection. */
static bool note_record(const record *each, teds_ndef *out)
{
    if (!out->any) {
        out->any = true;
        out->charges = is_type(each, TEDS_NDEF_WELL_KNOWN, "WLCINF", 6);
    }
    if (out->selection == NULL && is_type(each, TEDS_NDEF_WELL_KNOWN, "Ts", 2)) {
        if (each->payload_length == 0 || each->payload_length != 1u + each->payload[0]) {
            return false;
        }
        out->selection = each->payload + 1;
        out->selection_length = each->payload_length - 1;
    }
    if (out->payload == NULL && is_type(each, TEDS_NDEF_EXTERNAL, TEDS_TIM_TYPE, sizeof TEDS_TIM_TYPE - 1)) {
        out->payload = each->payload;
        out->payload_length = each->payload_length;
    }
    return true;
}

/* Chunks are joined in place, so `message` is modified. */
bool teds_ndef_read(uint8_t *message, size_t length, teds_ndef *out)
{
    record whole = {0}, each = {0};
    bool open = false, first = true, adds_up = true;
    size_t at = 0;
    memset(out, 0, sizeof *out);
    do {
        if (!cut_record(message, length, at, &each) || ((each.flags & BEGINS) != 0) != first ||
            open != ((each.flags & 7u) == UNCHANGED) || (open && each.type_length != 0)) {
            return false;
        }
        first = false;
        at = each.end;
        if (open) {
            out->chunked = true;
            memmove(whole.payload + whole.payload_length, each.payload, each.payload_length);
            whole.payload_length += each.payload_length;
        } else {
            whole = each;
        }
        open = (each.flags & CHUNKED) != 0;
        if (!open) {
            adds_up = note_record(&whole, out) && adds_up;
        }
    } while ((each.flags & ENDS) == 0);
    return !open && at == length && adds_up;
}

size_t teds_ndef_head(uint8_t *at, uint8_t marks, uint8_t tnf, const char *type, size_t type_length, size_t payload)
{
    const size_t wide = payload < 256 ? 1 : 4;
    at[0] = (uint8_t)(marks | tnf | (wide == 1 ? SHORT : 0));
    at[1] = (uint8_t)type_length;
    if (wide == 1) {
        at[2] = (uint8_t)payload;
    } else {
        teds_put32(at + 2, (uint32_t)payload);
    }
    memcpy(at + 2 + wide, type, type_length);
    return 2 + wide + type_length;
}

#endif
