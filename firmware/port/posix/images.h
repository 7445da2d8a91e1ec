/* SPDX-License-Identifier: Apache-2.0 */
/* A boot loader and an SMP server for programs: two slots of one image, as MCUboot and mcumgr have them. Their flash is
 * whatever the functions below reach, so that power can fail at each of their steps.
 *
 * Slots do not change places here: a record names the one that runs, and the next record is another decision. What a
 * station sees is the same: slot 0 runs, slot 1 is the other one.
 */
#ifndef TEDS_HOST_IMAGES_H
#define TEDS_HOST_IMAGES_H

#include "teds/port.h"

#define IMAGES_PAGE 4096u
#define IMAGES_UNIT 8u
#define IMAGES_PACKET 2048u
/* Areas: the two slots, and two pages of records. */
enum { IMAGES_FIRST = 0, IMAGES_SECOND = 1, IMAGES_RECORDS = 2 };
#define IMAGES_RECORD_OCTETS (2 * IMAGES_PAGE)

typedef struct images_flash {
    void *user;
    int (*erase)(void *user, int area, uint32_t at); /* one page */
    int (*write)(void *user, int area, uint32_t at, const uint8_t *octets, size_t length); /* whole units */
    int (*read)(void *user, int area, uint32_t at, uint8_t *out, size_t length);
    uint32_t slot_octets; /* whole pages */
} images_flash;

/* Facts from header and TLVs of an image. */
typedef struct image_facts {
    uint32_t header, octets, signed_octets, flags; /* signed: header, payload and protected TLVs */
    uint8_t major, minor;
    uint16_t patch;
    uint32_t build, counter;
    bool has_hash, has_key, has_counter;
    uint8_t hash[32], key_hash[32], signature[80], signature_length;
    char text[49]; /* protected TLV 54A0: board and application */
    char behaviour[16]; /* for tests: a payload that begins with "#!mute" and a line feed, say */
} image_facts;

typedef struct images {
    images_flash flash;
    const teds_port *port; /* its SHA-256 and P-256 */
    uint8_t owner[65];     /* public key: an image of another signer does not start */
    uint8_t owner_hash[32];
    bool keeps_counter;
    /* the newest record */
    uint8_t active, mode;
    uint32_t counter, sequence, next_record; /* next_record: where the next one may be written */
    image_facts running;
    /* the upload, which a restart forgets */
    struct {
        uint32_t off, length, erased; /* octets taken, of how many; pages are erased up to here */
        uint8_t held, rest[IMAGES_UNIT], sha_length, sha[32];
        bool begun;
    } upload;
} images;

/* Take the owner's public key: SubjectPublicKeyInfo of P-256, 91 octets, as `imgtool getpub -e raw` writes it. -1: it is none. */
int images_owner(images *own, const uint8_t *der, size_t length);
/* The boot step: revert a trial that was not confirmed, or try what is pending, and verify what is about to run. 0; 1 if there
 * is no image at all; -1 if the one in its slot is not the owner's, or flash fails. */
int images_boot(images *own);
bool images_on_trial(const images *own);
/* The port's functions about, manage. */
void images_about(const images *own, teds_firmware *out);
size_t images_manage(images *own, const uint8_t *packet, size_t length, uint8_t *out, size_t room);
/* Make the running image permanent; have the other one start next, on trial. */
int images_confirm(images *own);
int images_try(images *own);
bool images_pending(const images *own);
/* Read the facts of a slot's image; false if there is none. */
bool image_read(const images *own, int slot, image_facts *out);

#endif
