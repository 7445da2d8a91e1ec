/* SPDX-License-Identifier: Apache-2.0 */
/* The SMP server of the host port: the packets that Manage lets through, answered as mcumgr's img_mgmt and os_mgmt do (maps
 * and arrays without a length included). It trusts the filter of src/manage.c: one map, known keys once. */
#include "images.h"

#include <string.h>

#define GROUP_IMAGE 1u
/* rc of group 1 (img_mgmt_err_code_t), and of SMP itself. */
enum {
    IMAGE_HASH_NOT_FOUND = 8,
    IMAGE_WRITE_FAILED = 12,
    IMAGE_ERASE_FAILED = 13,
    IMAGE_BAD_HEADER = 22,
    IMAGE_BAD_MAGIC = 23,
    IMAGE_TOO_LARGE = 30,
    IMAGE_OVERRUN = 31,
    IMAGE_ACTIVE = 33
};
enum { SMP_NO_MEMORY = 2, SMP_INVALID = 3, SMP_NOT_SUPPORTED = 8 };

/* -- writing CBOR ------------------------------------------------------------------------------------------------------- */

typedef struct writing {
    uint8_t *octets;
    size_t length, room;
} writing;

static void octet(writing *out, unsigned value)
{
    if (out->length < out->room) {
        out->octets[out->length] = (uint8_t)value;
    }
    out->length++;
}

static void head(writing *out, unsigned major, uint32_t value)
{
    if (value < 24) {
        octet(out, major << 5 | (unsigned)value);
    } else if (value < 0x100) {
        octet(out, major << 5 | 24u);
        octet(out, (unsigned)value);
    } else {
        octet(out, major << 5 | 26u);
        for (int shift = 24; shift >= 0; shift -= 8) {
            octet(out, (unsigned)(value >> shift & 255u));
        }
    }
}

static void string(writing *out, unsigned major, const void *octets_of_it, size_t length)
{
    const uint8_t *at = octets_of_it;
    head(out, major, (uint32_t)length);
    for (size_t i = 0; i < length; i++) {
        octet(out, at[i]);
    }
}

static void text(writing *out, const char *value)
{
    string(out, 3, value, strlen(value));
}

static void number(writing *out, const char *key, uint32_t value)
{
    text(out, key);
    head(out, 0, value);
}

static void truth(writing *out, const char *key, bool value)
{
    text(out, key);
    octet(out, value ? 0xF5 : 0xF4);
}

#define BEGIN_MAP 0xBFu
#define BEGIN_LIST 0x9Fu
#define END 0xFFu

static void rc(writing *out, uint32_t value)
{
    octet(out, BEGIN_MAP);
    number(out, "rc", value);
    octet(out, END);
}

static void error(writing *out, uint32_t value)
{
    octet(out, BEGIN_MAP);
    text(out, "err");
    octet(out, BEGIN_MAP);
    number(out, "group", GROUP_IMAGE);
    number(out, "rc", value);
    octet(out, END);
    octet(out, END);
}

/* -- reading it: one flat map, as the filter has seen it ---------------------------------------------------------------- */

typedef struct upload_request {
    bool has_off, has_length, has_data;
    uint32_t off, length;
    const uint8_t *data, *sha;
    size_t data_length, sha_length;
} upload_request;

static const uint8_t *read_head(const uint8_t *at, const uint8_t *end, unsigned *major, uint64_t *value)
{
    unsigned additional;
    if (at >= end) {
        return NULL;
    }
    *major = *at >> 5;
    additional = *at++ & 31u;
    *value = additional;
    if (additional >= 24 && additional <= 27) {
        size_t octets_of_it = (size_t)1 << (additional - 24);
        *value = 0;
        for (; octets_of_it > 0 && at < end; octets_of_it--) {
            *value = *value << 8 | *at++;
        }
        return octets_of_it == 0 ? at : NULL;
    }
    return additional < 24 ? at : NULL;
}

static bool read_upload(const uint8_t *at, const uint8_t *end, upload_request *out)
{
    uint64_t pairs, value;
    unsigned major;
    memset(out, 0, sizeof *out);
    at = read_head(at, end, &major, &pairs);
    for (; at != NULL && pairs > 0; pairs--) {
        const uint8_t *key;
        size_t length;
        at = read_head(at, end, &major, &value);
        if (at == NULL || major != 3 || value > (uint64_t)(end - at)) {
            return false;
        }
        key = at;
        length = (size_t)value;
        at = read_head(at + length, end, &major, &value);
        if (at == NULL || (major == 2 || major == 3 ? value > (uint64_t)(end - at) : false)) {
            return false;
        }
        if (major == 0 && length == 3 && memcmp(key, "off", 3) == 0) {
            out->has_off = true;
            out->off = value > UINT32_MAX ? UINT32_MAX : (uint32_t)value;
        } else if (major == 0 && length == 3 && memcmp(key, "len", 3) == 0) {
            out->has_length = true;
            out->length = value > UINT32_MAX ? UINT32_MAX : (uint32_t)value;
        } else if (major == 2 && length == 3 && memcmp(key, "sha", 3) == 0) {
            out->sha = at;
            out->sha_length = (size_t)value;
        } else if (major == 2 && length == 4 && memcmp(key, "data", 4) == 0) {
            out->has_data = true;
            out->data = at;
            out->data_length = (size_t)value;
        }
        at += major == 2 || major == 3 ? (size_t)value : 0;
    }
    return at == end && out->has_off;
}

/* -- 1/0: the state of the images ------------------------------------------------------------------------------------------ */

static uint8_t slot_of(const images *own, unsigned number_of_it)
{
    return (uint8_t)(number_of_it == 0 ? own->active : 1 - own->active);
}

static void version(writing *out, const image_facts *facts)
{
    char words[32];
    size_t at = sizeof words - 1;
    const uint32_t parts[] = {facts->build, facts->patch, facts->minor, facts->major};
    words[at] = '\0';
    for (size_t i = facts->build == 0 ? 1 : 0; i < 4; i++) {
        uint32_t value = parts[i];
        do {
            words[--at] = (char)('0' + value % 10);
            value /= 10;
        } while (value > 0);
        if (i < 3) {
            words[--at] = '.';
        }
    }
    text(out, words + at);
}

static void state(const images *own, writing *out)
{
    octet(out, BEGIN_MAP);
    text(out, "images");
    octet(out, BEGIN_LIST);
    for (unsigned i = 0; i < 2; i++) {
        image_facts facts;
        if (!image_read(own, slot_of(own, i), &facts)) {
            continue;
        }
        octet(out, BEGIN_MAP);
        number(out, "slot", i);
        text(out, "version");
        version(out, &facts);
        text(out, "hash");
        string(out, 2, facts.hash, sizeof facts.hash);
        truth(out, "bootable", (facts.flags & 0x10u) == 0);
        truth(out, "pending", i == 1 && images_pending(own));
        truth(out, "confirmed", (i == 0) != images_on_trial(own));
        truth(out, "active", i == 0);
        truth(out, "permanent", false);
        octet(out, END);
    }
    octet(out, END);
    number(out, "splitStatus", 0);
    octet(out, END);
}

static void set_state(images *own, const uint8_t *body, size_t length, writing *out)
{
    image_facts facts;
    if (length == 10) { /* confirm */
        if (images_confirm(own) != 0) {
            error(out, IMAGE_WRITE_FAILED);
        } else {
            state(own, out);
        }
        return;
    }
    if (memcmp(own->running.hash, body + 8, 32) == 0) {
        error(out, IMAGE_ACTIVE);
    } else if (!image_read(own, slot_of(own, 1), &facts) || memcmp(facts.hash, body + 8, 32) != 0) {
        error(out, IMAGE_HASH_NOT_FOUND);
    } else if (images_try(own) != 0) {
        error(out, IMAGE_WRITE_FAILED);
    } else {
        state(own, out);
    }
}

/* -- 1/1: an upload ---------------------------------------------------------------------------------------------------------- */

static void answer_off(const images *own, writing *out)
{
    octet(out, BEGIN_MAP);
    number(out, "off", own->upload.off);
    octet(out, END);
}

/* Write what makes whole units, each page erased before; the rest waits for the next packet. */
static uint32_t put(images *own, const uint8_t *data, size_t length, bool last)
{
    const images_flash *flash = &own->flash;
    const uint8_t slot = slot_of(own, 1);
    uint8_t piece[IMAGES_PACKET + IMAGES_UNIT];
    uint32_t at = own->upload.off - own->upload.held;
    size_t octets_of_it = own->upload.held + length, whole;
    memcpy(piece, own->upload.rest, own->upload.held);
    memcpy(piece + own->upload.held, data, length);
    if (last) {
        memset(piece + octets_of_it, 0xFF, IMAGES_UNIT - 1);
        octets_of_it += IMAGES_UNIT - 1;
    }
    whole = octets_of_it / IMAGES_UNIT * IMAGES_UNIT;
    while (own->upload.erased < at + whole) {
        if (flash->erase(flash->user, slot, own->upload.erased) != 0) {
            return IMAGE_ERASE_FAILED;
        }
        own->upload.erased += IMAGES_PAGE;
    }
    if (whole > 0 && flash->write(flash->user, slot, at, piece, whole) != 0) {
        return IMAGE_WRITE_FAILED;
    }
    own->upload.held = last ? 0 : (uint8_t)(octets_of_it - whole);
    memcpy(own->upload.rest, piece + whole, own->upload.held);
    own->upload.off += (uint32_t)length;
    return 0;
}

/* SHA-256 of what was uploaded is what the first packet announced. */
static bool arrived(const images *own)
{
    uint8_t piece[256], hash[32];
    teds_sha256 running;
    own->port->sha256_start(own->port->user, &running);
    for (uint32_t at = 0; at < own->upload.length; at += sizeof piece) {
        const size_t length = own->upload.length - at < sizeof piece ? own->upload.length - at : sizeof piece;
        if (own->flash.read(own->flash.user, slot_of(own, 1), at, piece, length) != 0) {
            return false;
        }
        own->port->sha256_update(own->port->user, &running, piece, length);
    }
    own->port->sha256_finish(own->port->user, &running, hash);
    return own->upload.sha_length == 32 && memcmp(hash, own->upload.sha, 32) == 0;
}

/* The first packet: 0 to go on with its data, -1 if the same image is under way, else what is wrong with it. */
static int begin(images *own, const upload_request *asked)
{
    static const uint8_t magic[4] = {0x3D, 0xB8, 0xF3, 0x96};
    if (!asked->has_length || asked->data_length < 32) {
        return IMAGE_BAD_HEADER;
    }
    if (memcmp(asked->data, magic, sizeof magic) != 0) {
        return IMAGE_BAD_MAGIC;
    }
    if (asked->length > own->flash.slot_octets) {
        return IMAGE_TOO_LARGE;
    }
    if (own->upload.begun && asked->sha_length > 0 && asked->sha_length == own->upload.sha_length &&
        memcmp(asked->sha, own->upload.sha, asked->sha_length) == 0 && asked->length == own->upload.length) {
        return -1;
    }
    memset(&own->upload, 0, sizeof own->upload);
    own->upload.begun = true;
    own->upload.length = asked->length;
    own->upload.sha_length = (uint8_t)(asked->sha_length <= 32 ? asked->sha_length : 0);
    if (own->upload.sha_length > 0) {
        memcpy(own->upload.sha, asked->sha, own->upload.sha_length);
    }
    return 0;
}

static void upload(images *own, const uint8_t *body, size_t length, writing *out)
{
    upload_request asked;
    uint32_t wrong;
    bool last;
    if (!read_upload(body, body + length, &asked) || !asked.has_data) {
        rc(out, SMP_INVALID);
        return;
    }
    if (asked.off == 0) {
        const int begun = begin(own, &asked);
        if (begun > 0) {
            error(out, (uint32_t)begun);
            return;
        }
        if (begun < 0) {
            answer_off(own, out);
            return;
        }
    }
    if (!own->upload.begun || asked.off != own->upload.off) {
        answer_off(own, out);
        return;
    }
    if (asked.data_length > own->upload.length - own->upload.off) {
        error(out, IMAGE_OVERRUN);
        return;
    }
    last = own->upload.off + asked.data_length == own->upload.length;
    wrong = put(own, asked.data, asked.data_length, last);
    if (wrong != 0) {
        own->upload.begun = false;
        error(out, wrong);
        return;
    }
    octet(out, BEGIN_MAP);
    number(out, "off", own->upload.off);
    if (last) {
        if (own->upload.sha_length > 0) {
            truth(out, "match", arrived(own));
        }
        memset(&own->upload, 0, sizeof own->upload);
    }
    octet(out, END);
}

/* -- a packet ------------------------------------------------------------------------------------------------------------------ */

static void parameters(writing *out)
{
    octet(out, BEGIN_MAP);
    number(out, "buf_size", TEDS_MAX_MESSAGE - 53u < IMAGES_PACKET ? TEDS_MAX_MESSAGE - 53u : IMAGES_PACKET);
    number(out, "buf_count", 1);
    octet(out, END);
}

static void slots(const images *own, writing *out)
{
    octet(out, BEGIN_MAP);
    text(out, "images");
    octet(out, BEGIN_LIST);
    octet(out, BEGIN_MAP);
    number(out, "image", 0);
    text(out, "slots");
    octet(out, BEGIN_LIST);
    for (unsigned i = 0; i < 2; i++) {
        octet(out, BEGIN_MAP);
        number(out, "slot", i);
        number(out, "size", own->flash.slot_octets);
        if (i == 1) {
            number(out, "upload_image_id", 0);
        }
        octet(out, END);
    }
    octet(out, END);
    number(out, "max_image_size", own->flash.slot_octets);
    octet(out, END);
    octet(out, END);
    octet(out, END);
}

/* {"d": text} becomes {"r": text}: the body is the same but for one letter. */
static void echo(const uint8_t *body, size_t length, writing *out)
{
    if (length < 3 || body[0] != 0xA1 || body[1] != 0x61 || body[2] != 'd') {
        rc(out, SMP_INVALID);
        return;
    }
    for (size_t i = 0; i < length; i++) {
        octet(out, i == 2 ? 'r' : body[i]);
    }
}

size_t images_manage(images *own, const uint8_t *packet, size_t length, uint8_t *out, size_t room)
{
    uint8_t asked[IMAGES_PACKET]; /* the answer takes the packet's place */
    const uint8_t *body = asked + 8;
    writing answer = {out, 8, room};
    if (length > sizeof asked || length < 9 || room < 9) {
        return 0;
    }
    memcpy(asked, packet, length);
    length -= 8;
    switch ((asked[0] & 2u) << 15 | (unsigned)asked[5] << 8 | asked[7]) {
    case 0x00006: parameters(&answer); break;
    case 0x10000: echo(body, length, &answer); break;
    case 0x00100: state(own, &answer); break;
    case 0x00106: slots(own, &answer); break;
    case 0x10100: set_state(own, body, length, &answer); break;
    case 0x10101: upload(own, body, length, &answer); break;
    default: rc(&answer, SMP_NOT_SUPPORTED); break; /* 0/8: listed, not built */
    }
    if (answer.length > room) {
        answer.length = 8;
        rc(&answer, SMP_NO_MEMORY);
    }
    memcpy(out, asked, 8);
    out[0] = (uint8_t)(asked[0] | 1u);
    out[2] = (uint8_t)((answer.length - 8) >> 8);
    out[3] = (uint8_t)(answer.length - 8);
    return answer.length;
}
