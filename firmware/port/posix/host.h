/* The host port: a node as a program. One file of flash, one CAN bus over UDP multicast or socketcand, a
 * simulated NFC reader. */
#ifndef TEDS_HOST_H
#define TEDS_HOST_H

#include <netinet/in.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "teds/node.h"

#define HOST_IDENTITY 256u
#define HOST_SLOT 16384u
#define HOST_UNIT 8u

/* -- flash_file.c: flash in a file, as NOR flash behaves ------------------------------------------------------------ */

typedef struct host_flash {
    int file;
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

/* -- bus.c, multicast.c, socketcand.c: where frames go --------------------------------------------------------------- */

typedef struct host_bus {
    bool fd, is_socketcand;
    int in, out; /* the same for socketcand */
    uint32_t own_address;
    uint16_t own_port;
    size_t held; /* socketcand: octets of a line that has begun */
    char line[2048];
} host_bus;

/* Open the bus that `spec` names as --can does; 0, or -1 after words on stderr. */
int host_bus_open(host_bus *bus, const char *spec, bool fd);
/* The next frame, if one has come: 1, 0 none, -1 the bus is gone. */
int host_bus_receive(host_bus *bus, teds_can_frame *frame);
int host_bus_send(host_bus *bus, const teds_can_frame *frame);

int multicast_open(host_bus *bus, const char *group, uint16_t port, int hop_limit);
int multicast_receive(host_bus *bus, teds_can_frame *frame);
int multicast_send(host_bus *bus, const teds_can_frame *frame);
/* The datagram of a frame as python-can packs it; gives its length. */
size_t multicast_pack(const teds_can_frame *frame, uint8_t out[320]);
bool multicast_unpack(const uint8_t *datagram, size_t length, bool fd, teds_can_frame *frame);

int socketcand_open(host_bus *bus, const char *channel, const char *host, const char *port);
int socketcand_receive(host_bus *bus, teds_can_frame *frame);
int socketcand_send(host_bus *bus, const teds_can_frame *frame);

/* -- nfc_udp.c: a simulated NFC reader ---------------------------------------------------------------------------------- */

typedef struct host_nfc {
    int in; /* -1: none */
    bool chosen, active;
    uint8_t uid[5]; /* and its check octet */
    struct sockaddr_in reader;
    teds_isodep card;
} host_nfc;

/* Lie down on `path` (udp:localhost:PORT); 0, or -1 after words on stderr. */
int host_nfc_open(host_nfc *nfc, const char *path, const uint8_t uid[3]);
/* Answer one frame of the reader; false where none has come. */
bool host_nfc_serve(host_nfc *nfc, teds_node *node);

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
