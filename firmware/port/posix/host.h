/* SPDX-License-Identifier: Apache-2.0 */
/* The host port: a node as a program. One file of flash, one CAN bus over UDP multicast or socketcand, a
 * simulated NFC reader. */
#ifndef TEDS_HOST_H
#define TEDS_HOST_H

#include <netinet/in.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <sys/socket.h>

#include "images.h"
#include "teds/node.h"

#define HOST_IDENTITY 256u
#define HOST_SLOT 16384u
#define HOST_UNIT 8u

/* -- flash_file.c: flash in files, as NOR flash behaves ------------------------------------------------------------- */

#define HOST_IMAGE 0x80000u /* octets of an image's slot */

typedef struct host_flash {
    int file;
    int images[3]; /* of the two slots and the boot loader's records (images.h) */
    long cut; /* the process ends at this step (an erase, or a unit written), counted from 1; 0: never */
    bool torn; /* half of that step is done */
    long steps;
    uint8_t image[HOST_IDENTITY + 2 * HOST_SLOT];
} host_flash;

/* Open or make the file; 0, or -1 with errno. */
int host_flash_open(host_flash *flash, const char *path);
int host_flash_erase(host_flash *flash, int area);
int host_flash_write(host_flash *flash, int area, uint32_t at, const uint8_t *octets, size_t length);
int host_flash_read(const host_flash *flash, int area, uint32_t at, uint8_t *out, size_t length);
/* Count a step; true if it is the one at which the power fails. And that end of the process. */
bool host_flash_fails(host_flash *flash);
void host_flash_end(void);

/* -- image_file.c: the same for images ------------------------------------------------------------------------------ */

/* Open or make the files of the images in `folder`, and put `image` into the first slot if both are blank, as a programmer
 * would (NULL: not); 0, or -1 with errno. Each step of theirs counts as one of flash, too. */
int host_flash_images(host_flash *flash, const char *folder, const char *image, images_flash *out);

/* -- firmware.c: what runs, and its images -------------------------------------------------------------------------------- */

typedef struct host_firmware_options {
    const char *about, *images, *image, *owner;
    bool keeps_counter;
} host_firmware_options;

typedef struct host_firmware {
    host_flash *flash;
    bool silent, has_images; /* silent: it has neither About nor Locate */
    teds_firmware report;
    images images;
} host_firmware;

/* Read the options, and run the boot step if there are images; -1 after words on stderr. `port` has its cryptography. */
int host_firmware_start(host_firmware *own, const host_firmware_options *given, host_flash *flash, const teds_port *port);
void host_firmware_about(const host_firmware *own, teds_firmware *out);
/* True if the running image is one of tests that does this ("mute", "crash", "confirm"). */
bool host_firmware_behaves(const host_firmware *own, const char *how);
/* Begin again as after a reset: the same program with the same words. Returns only if that fails. */
void host_restart(host_flash *flash, char **words);

/* -- pacing.c: frames that take as long as on a wire or on air ----------------------------------------------------- */

typedef struct host_pace {
    bool on;
    uint64_t free_at, last; /* CAN: when the last frame was through, and how long it took */
    uint64_t came, before;  /* when what waits for an answer came, 0 for nothing; chip and flash until then */
    uint64_t heard;         /* when a frame came last */
    uint64_t turns, turned; /* changes of direction, and ns of them beside what follows */
    uint64_t chip, flash;   /* ns in P-256, and until what was stored was written */
} host_pace;

void host_pace_start(host_pace *pace);
/* ns of CLOCK_MONOTONIC. */
uint64_t host_clock(void);
/* When the kernel had this datagram, by SO_TIMESTAMPNS; now if it gives none. */
uint64_t host_arrival(struct msghdr *message);
void host_pace_came(host_pace *pace, uint64_t at);
/* Wait until this frame would be through. */
void host_pace_frame(host_pace *pace, const teds_can_frame *frame, uint32_t bitrate, uint32_t data_bitrate);
/* Wait until `due`, when an answer would be through. */
void host_pace_answer(host_pace *pace, uint64_t due);
void host_hold(uint64_t until);
uint64_t host_wire_ns(const teds_can_frame *frame, uint32_t bitrate, uint32_t data_bitrate);
/* From the first bit of a command to the last of its answer of so many octets, frame delays included. */
uint64_t host_air_ns(const uint8_t *command, size_t length, size_t answer);

/* -- bus.c, multicast.c, socketcand.c: where frames go --------------------------------------------------------------- */

typedef struct host_bus {
    bool fd, is_socketcand;
    int in, out; /* the same for socketcand */
    uint32_t own_address;
    uint16_t own_port;
    size_t held; /* socketcand: octets of a line that has begun */
    char line[2048];
    uint32_t bitrate, data_bitrate;
    host_pace *pace; /* NULL: frames leave at once */
    uint8_t accepted; /* of the acceptance filter; 0: there is none */
} host_bus;

/* Open the bus that `spec` names as --can does; 0, or -1 after words on stderr. With `paces`, or pace=1 in `spec`, frames
 * take the time of a wire. */
int host_bus_open(host_bus *bus, const char *spec, bool fd, host_pace *pace, bool paces);
/* The next frame, if one has come: 1, 0 none, -1 the bus is gone. */
int host_bus_receive(host_bus *bus, teds_can_frame *frame);
int host_bus_send(host_bus *bus, const teds_can_frame *frame);
/* Datagrams that found no room in the socket (Linux: SO_MEMINFO). */
uint32_t host_bus_dropped(const host_bus *bus);
/* On a paced bus: take no frames that a station sends to other addresses, as a controller's acceptance filter does. */
void host_bus_accept(host_bus *bus, uint8_t address);

int multicast_open(host_bus *bus, const char *group, uint16_t port, int hop_limit);
int multicast_receive(host_bus *bus, teds_can_frame *frame);
int multicast_send(host_bus *bus, const teds_can_frame *frame);
void multicast_accept(const host_bus *bus, uint8_t address);
/* The datagram of a frame as python-can packs it; gives its length. */
size_t multicast_pack(const teds_can_frame *frame, uint8_t out[320]);
bool multicast_unpack(const uint8_t *datagram, size_t length, bool fd, teds_can_frame *frame);

int socketcand_open(host_bus *bus, const char *channel, const char *host, const char *port);
int socketcand_receive(host_bus *bus, teds_can_frame *frame);
int socketcand_send(host_bus *bus, const teds_can_frame *frame);

/* -- nfc_udp.c: a simulated NFC reader ---------------------------------------------------------------------------------- */

#if TEDS_NFC
typedef struct host_nfc {
    int in; /* -1: none */
    bool chosen, active;
    uint8_t uid[5]; /* and its check octet */
    struct sockaddr_in reader;
    teds_isodep card;
    host_pace *pace; /* NULL: answers leave at once */
    uint64_t came;
    const uint8_t *command;
    size_t command_length;
} host_nfc;

/* Lie down on `path` (udp:localhost:PORT); 0, or -1 after words on stderr. */
int host_nfc_open(host_nfc *nfc, const char *path, const uint8_t uid[3], host_pace *pace);
/* Answer one frame of the reader; false where none has come. */
bool host_nfc_serve(host_nfc *nfc, teds_node *node);
#endif

/* -- channels.c: fake hardware ------------------------------------------------------------------------------------------ */

typedef struct host_channels {
    teds_channel table[TEDS_CHANNELS];
    uint8_t bits[TEDS_CHANNELS]; /* of a sensor's value that are used */
    size_t count;
    char source; /* n noise, s sine, r ramp */
    double seconds;
    uint64_t random;
    uint8_t set_points[TEDS_CHANNELS][8];
} host_channels;

/* Read a file of channels: `number kind model octets shortest-ns [halt [bits]]`, a line each; -1 after words on stderr. */
int host_channels_read(host_channels *channels, const char *path);
int host_source(host_channels *channels, const char *source);
bool host_sample(host_channels *channels, uint8_t channel, uint64_t tick, uint8_t *out);

#endif
