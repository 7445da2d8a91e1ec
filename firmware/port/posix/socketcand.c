/* SPDX-License-Identifier: Apache-2.0 */
/* socketcand (linux-can): lines of text over TCP, raw mode. Classic frames alone: it knows no FD. */
#define _POSIX_C_SOURCE 200809L
#include "host.h"

#include <errno.h>
#include <fcntl.h>
#include <netdb.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

static int say(const host_bus *bus, const char *words)
{
    size_t length = strlen(words), sent = 0;
    while (sent < length) {
        ssize_t now = send(bus->out, words + sent, length - sent, MSG_NOSIGNAL);
        if (now <= 0) {
            return -1;
        }
        sent += (size_t)now;
    }
    return 0;
}

/* The next "< … >" into `out`: 1, 0 none is whole yet, -1 gone. */
static int next_words(host_bus *bus, char *out, size_t room)
{
    for (;;) {
        char *end = memchr(bus->line, '>', bus->held);
        ssize_t came;
        if (end != NULL) {
            size_t length = (size_t)(end - bus->line) + 1;
            char *begin = memchr(bus->line, '<', length);
            size_t words = begin != NULL ? (size_t)(end - begin) - 1 : 0;
            if (begin != NULL && words < room) {
                memcpy(out, begin + 1, words);
                out[words] = '\0';
            }
            bus->held -= length;
            memmove(bus->line, end + 1, bus->held);
            if (begin != NULL && words < room) {
                return 1;
            }
            continue;
        }
        if (bus->held == sizeof bus->line) {
            return -1; /* no such line is that long */
        }
        came = recv(bus->in, bus->line + bus->held, sizeof bus->line - bus->held, 0);
        if (came <= 0) {
            return came < 0 && (errno == EAGAIN || errno == EWOULDBLOCK || errno == EINTR) ? 0 : -1;
        }
        bus->held += (size_t)came;
    }
}

static int expect(host_bus *bus, const char *word)
{
    char words[256];
    return next_words(bus, words, sizeof words) == 1 && strstr(words, word) != NULL ? 0 : -1;
}

int socketcand_open(host_bus *bus, const char *channel, const char *host, const char *port)
{
    struct addrinfo want = {0}, *found = NULL;
    char words[128];
    const int yes = 1;
    int failed;
    want.ai_socktype = SOCK_STREAM;
    if (getaddrinfo(host, port, &want, &found) != 0) {
        errno = EHOSTUNREACH;
        return -1;
    }
    bus->in = socket(found->ai_family, SOCK_STREAM, 0);
    bus->out = bus->in;
    failed = bus->in < 0 || connect(bus->in, found->ai_addr, found->ai_addrlen) != 0;
    freeaddrinfo(found);
    if (failed) {
        return -1;
    }
    (void)setsockopt(bus->in, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
    (void)snprintf(words, sizeof words, "< open %.64s >", channel);
    errno = EPROTO;
    if (expect(bus, "hi") != 0 || say(bus, words) != 0 || expect(bus, "ok") != 0 || say(bus, "< rawmode >") != 0 ||
        expect(bus, "ok") != 0) {
        return -1;
    }
    return fcntl(bus->in, F_SETFL, O_NONBLOCK) == 0 ? 0 : -1;
}

static int hex(char letter)
{
    return letter >= '0' && letter <= '9'   ? letter - '0'
           : letter >= 'a' && letter <= 'f' ? letter - 'a' + 10
           : letter >= 'A' && letter <= 'F' ? letter - 'A' + 10
                                            : -1;
}

/* "frame 18DA21F1 1700000000.123456 0102…", in some versions with blanks between the octets. */
static bool read_frame(const char *words, teds_can_frame *frame)
{
    char identifier[16], stamp[48];
    int used = 0, half = -1;
    memset(frame, 0, sizeof *frame);
    if (sscanf(words, " frame %15s %47s%n", identifier, stamp, &used) != 2 || strlen(identifier) <= 3) {
        return false; /* of another kind, or an 11-bit identifier */
    }
    frame->identifier = (uint32_t)strtoul(identifier, NULL, 16) & 0x1FFFFFFFu;
    for (const char *at = words + used; *at != '\0'; at++) {
        int digit = hex(*at);
        if (digit < 0) {
            continue;
        }
        if (half < 0) {
            half = digit;
        } else if (frame->length == 8) {
            return false;
        } else {
            frame->data[frame->length++] = (uint8_t)(half << 4 | digit);
            half = -1;
        }
    }
    return half < 0;
}

int socketcand_receive(host_bus *bus, teds_can_frame *frame)
{
    char words[256];
    int there;
    while ((there = next_words(bus, words, sizeof words)) == 1) {
        if (read_frame(words, frame)) {
            return 1;
        }
    }
    return there;
}

int socketcand_send(host_bus *bus, const teds_can_frame *frame)
{
    char words[80];
    int length = snprintf(words, sizeof words, "< send %08X %u", (unsigned)frame->identifier, (unsigned)frame->length);
    for (size_t i = 0; i < frame->length && i < 8; i++) {
        length += snprintf(words + length, sizeof words - (size_t)length, " %02X", (unsigned)frame->data[i]);
    }
    (void)snprintf(words + length, sizeof words - (size_t)length, " >");
    return say(bus, words);
}
