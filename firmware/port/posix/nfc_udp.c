/* SPDX-License-Identifier: Apache-2.0 */
/* A simulated reader: nfcpy's udp driver, the tag's side. A datagram is `106A hex` or `RFOFF`, loopback alone. */
#define _DEFAULT_SOURCE
#include "host.h"

#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#define SAK 0x20u /* ISO-DEP */

int host_nfc_open(host_nfc *nfc, const char *path, const uint8_t uid[3], host_pace *pace)
{
    const int yes = 1;
    struct sockaddr_in own;
    const char *colon = strchr(path, ':'), *port = colon != NULL ? strchr(colon + 1, ':') : NULL;
    unsigned long number = port != NULL ? strtoul(port + 1, NULL, 10) : 54321;
    size_t host = port != NULL ? (size_t)(port - colon) - 1 : colon != NULL ? strlen(colon + 1) : 0;
    memset(nfc, 0, sizeof *nfc);
    nfc->in = -1;
    if (strncmp(path, "udp", 3) != 0 || number == 0 || number > 65535 ||
        (host != 0 && strncmp(colon + 1, "localhost", host) != 0 && strncmp(colon + 1, "127.0.0.1", host) != 0)) {
        (void)fprintf(stderr, "--nfc is udp:localhost:PORT, not %s.\n", path);
        return -1;
    }
    memset(&own, 0, sizeof own);
    own.sin_family = AF_INET;
    own.sin_port = htons((uint16_t)number);
    own.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    nfc->in = socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0);
    if (nfc->in < 0 || bind(nfc->in, (struct sockaddr *)&own, sizeof own) != 0) {
        (void)fprintf(stderr, errno == EADDRINUSE ? "Another node (or program) lies on %s.\n" : "%s does not open.\n", path);
        return -1;
    }
    if (pace != NULL) {
        nfc->pace = pace;
        host_pace_start(pace);
        (void)setsockopt(nfc->in, SOL_SOCKET, SO_TIMESTAMPNS, &yes, sizeof yes);
    }
    nfc->uid[0] = 0x08; /* four octets, random: it tells nobody who this is */
    memcpy(nfc->uid + 1, uid, 3);
    nfc->uid[4] = (uint8_t)(nfc->uid[0] ^ nfc->uid[1] ^ nfc->uid[2] ^ nfc->uid[3]);
    return 0;
}

static void say(host_nfc *nfc, const uint8_t *octets, size_t length)
{
    char text[8 + 2 * 256];
    size_t at = (size_t)sprintf(text, "106A ");
    struct pollfd newer = {nfc->in, POLLIN, 0};
    if (length == 0 || poll(&newer, 1, 0) > 0) {
        return; /* a newer command waits: the reader has given this one up */
    }
    if (nfc->pace != NULL) {
        host_pace_answer(nfc->pace, nfc->came + host_air_ns(nfc->command, nfc->command_length, length));
    }
    for (size_t i = 0; i < length; i++) {
        at += (size_t)sprintf(text + at, "%02x", (unsigned)octets[i]);
    }
    (void)sendto(nfc->in, text, at, 0, (struct sockaddr *)&nfc->reader, sizeof nfc->reader);
}

static void leave(host_nfc *nfc, teds_node *node)
{
    if (nfc->active) {
        teds_nfc_field(node, false);
    }
    nfc->active = nfc->chosen = false;
}

/* Before ISO-DEP: SENS_REQ, SDD_REQ, SEL_REQ, RATS. */
static void select_tag(host_nfc *nfc, teds_node *node, const uint8_t *octets, size_t length)
{
    static const uint8_t sens_res[2] = {0x04, 0x00}, sak = SAK;
    uint8_t ats[5];
    if (length == 1 && (octets[0] == 0x26 || octets[0] == 0x52)) {
        leave(nfc, node); /* the reader of before was killed */
        say(nfc, sens_res, sizeof sens_res);
    } else if (nfc->chosen && octets[0] == 0xE0) {
        nfc->active = true;
        say(nfc, ats, teds_isodep_start(node, &nfc->card, octets, length, ats));
    } else if (length == 2 && octets[0] == 0x93 && octets[1] == 0x20) {
        say(nfc, nfc->uid, 5);
    } else if (length == 7 && octets[0] == 0x93 && octets[1] == 0x70 && memcmp(octets + 2, nfc->uid, 5) == 0) {
        nfc->chosen = true;
        say(nfc, &sak, 1);
    }
}

static size_t octets_of(const char *text, uint8_t *out, size_t room)
{
    size_t length = 0;
    unsigned octet;
    while (length < room && sscanf(text + 2 * length, "%2x", &octet) == 1 && text[2 * length + 1] != '\0') {
        out[length++] = (uint8_t)octet;
    }
    return length;
}

bool host_nfc_serve(host_nfc *nfc, teds_node *node)
{
    char text[1024];
    uint8_t octets[300], out[256];
    struct iovec where = {text, sizeof text - 1};
    char stamp[64];
    struct msghdr message = {&nfc->reader, sizeof nfc->reader, &where, 1, stamp, sizeof stamp, 0};
    ssize_t came = recvmsg(nfc->in, &message, MSG_DONTWAIT);
    size_t length;
    if (came < 0) {
        return false;
    }
    text[came] = '\0';
    if (strncmp(text, "RFOFF", 5) == 0) {
        leave(nfc, node);
        return true;
    }
    if (strncmp(text, "106A ", 5) != 0) {
        return true;
    }
    length = octets_of(text + 5, octets, sizeof octets);
    if (length == 0) {
        return true;
    }
    if (nfc->pace != NULL) {
        nfc->came = host_arrival(&message);
        nfc->command = octets;
        nfc->command_length = length;
        host_pace_came(nfc->pace, nfc->came);
    }
    if (!nfc->active || (length == 1 && (octets[0] == 0x26 || octets[0] == 0x52))) {
        select_tag(nfc, node, octets, length);
    } else {
        say(nfc, out, teds_isodep_block(node, &nfc->card, octets, length, out));
    }
    return true;
}
