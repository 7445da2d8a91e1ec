/* SPDX-License-Identifier: Apache-2.0 */
/* python-can's udp_multicast: each frame is one datagram, a msgpack map of the fields of can.Message. */
#define _DEFAULT_SOURCE
#include "host.h"

#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#ifdef __linux__
#include <linux/filter.h>
#endif
#include <netinet/in.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

/* -- msgpack, as much as this map needs -------------------------------------------------------------------------------- */

static uint8_t *text(uint8_t *at, const char *word)
{
    size_t length = strlen(word);
    *at++ = (uint8_t)(0xA0u | length);
    memcpy(at, word, length);
    return at + length;
}

static uint8_t *flag(uint8_t *at, const char *word, bool value)
{
    at = text(at, word);
    *at++ = value ? 0xC3 : 0xC2;
    return at;
}

size_t multicast_pack(const teds_can_frame *frame, uint8_t out[320])
{
    uint8_t *at = out;
    *at++ = 0x8B; /* 11 members */
    at = text(at, "timestamp");
    *at++ = 0xCB;
    memset(at, 0, 8);
    at = text(at + 8, "arbitration_id");
    *at++ = 0xCE;
    *at++ = (uint8_t)(frame->identifier >> 24);
    *at++ = (uint8_t)(frame->identifier >> 16);
    *at++ = (uint8_t)(frame->identifier >> 8);
    *at++ = (uint8_t)frame->identifier;
    at = flag(at, "is_extended_id", true);
    at = flag(at, "is_remote_frame", false);
    at = flag(at, "is_error_frame", false);
    at = text(at, "channel");
    *at++ = 0xC0;
    at = text(at, "dlc");
    *at++ = frame->length;
    at = text(at, "data");
    *at++ = 0xC4;
    *at++ = frame->length;
    memcpy(at, frame->data, frame->length);
    at = flag(at + frame->length, "is_fd", frame->fd);
    at = flag(at, "bitrate_switch", frame->fd);
    at = flag(at, "error_state_indicator", false);
    return (size_t)(at - out);
}

/* One value: where its octets lie and how many, or a number. */
typedef struct value {
    char kind; /* n number, b octets, s text, f flag, o something else */
    uint64_t number;
    const uint8_t *octets;
    size_t length;
} value;

typedef struct reading {
    const uint8_t *at, *end;
} reading;

static bool take(reading *in, size_t octets, uint64_t *number)
{
    if ((size_t)(in->end - in->at) < octets) {
        return false;
    }
    *number = 0;
    while (octets-- > 0) {
        *number = *number << 8 | *in->at++;
    }
    return true;
}

static bool take_octets(reading *in, value *out, char kind, size_t length)
{
    if ((size_t)(in->end - in->at) < length) {
        return false;
    }
    out->kind = kind;
    out->octets = in->at;
    out->length = length;
    in->at += length;
    return true;
}

/* No arrays and maps within: python-can writes none, and nothing here recurses. */
static bool read_value(reading *in, value *out)
{
    uint64_t first, length;
    memset(out, 0, sizeof *out);
    if (!take(in, 1, &first)) {
        return false;
    }
    out->kind = 'n';
    out->number = first;
    if (first < 0x80) {
        return true;
    }
    if (first >= 0xA0 && first < 0xC0) {
        return take_octets(in, out, 's', first & 31);
    }
    switch (first) {
    case 0xC0:
        out->kind = 'o';
        return true;
    case 0xC2:
    case 0xC3:
        out->kind = 'f';
        out->number = first & 1;
        return true;
    case 0xC4: return take(in, 1, &length) && take_octets(in, out, 'b', (size_t)length);
    case 0xC5: return take(in, 2, &length) && take_octets(in, out, 'b', (size_t)length);
    case 0xCA: return take_octets(in, out, 'o', 4);
    case 0xCB: return take_octets(in, out, 'o', 8);
    case 0xCC: return take(in, 1, &out->number);
    case 0xCD: return take(in, 2, &out->number);
    case 0xCE: return take(in, 4, &out->number);
    case 0xCF: return take(in, 8, &out->number);
    case 0xD9: return take(in, 1, &length) && take_octets(in, out, 's', (size_t)length);
    case 0xDA: return take(in, 2, &length) && take_octets(in, out, 's', (size_t)length);
    default: return false;
    }
}

static bool is(const value *key, const char *word)
{
    return key->kind == 's' && key->length == strlen(word) && memcmp(key->octets, word, key->length) == 0;
}

bool multicast_unpack(const uint8_t *datagram, size_t length, bool fd, teds_can_frame *frame)
{
    reading in = {datagram, datagram + length};
    uint64_t head;
    value key, each, data = {0};
    bool has_id = false, extended = true;
    memset(frame, 0, sizeof *frame);
    if (!take(&in, 1, &head) || head < 0x80 || head > 0x8F) {
        return false;
    }
    for (uint64_t i = 0; i < (head & 15); i++) {
        if (!read_value(&in, &key) || !read_value(&in, &each)) {
            return false;
        }
        if (is(&key, "arbitration_id") && each.kind == 'n' && each.number < (UINT64_C(1) << 29)) {
            frame->identifier = (uint32_t)each.number;
            has_id = true;
        } else if (is(&key, "is_extended_id")) {
            extended = each.number != 0;
        } else if (is(&key, "is_remote_frame") || is(&key, "is_error_frame")) {
            extended = extended && each.number == 0;
        } else if (is(&key, "is_fd")) {
            frame->fd = each.number != 0;
        } else if (is(&key, "data")) {
            data = each;
        }
    }
    if (!has_id || !extended || data.kind != 'b' || data.length > (frame->fd ? 64 : 8) || (frame->fd && !fd)) {
        return false;
    }
    frame->length = (uint8_t)data.length;
    memcpy(frame->data, data.octets, data.length);
    return true;
}

/* -- the sockets ----------------------------------------------------------------------------------------------------------- */

int multicast_open(host_bus *bus, const char *group, uint16_t port, int hop_limit)
{
    struct sockaddr_in where = {0}, own = {0};
    socklen_t own_length = sizeof own;
    struct ip_mreq member = {0};
    const int yes = 1;
    int room = 1 << 20;
    where.sin_family = AF_INET;
    where.sin_port = htons(port);
    if (inet_pton(AF_INET, group, &where.sin_addr) != 1) {
        errno = EINVAL;
        return -1;
    }
    bus->in = socket(AF_INET, SOCK_DGRAM, 0);
    bus->out = socket(AF_INET, SOCK_DGRAM, 0);
    member.imr_multiaddr = where.sin_addr;
    member.imr_interface.s_addr = htonl(INADDR_ANY);
    if (bus->in < 0 || bus->out < 0 || setsockopt(bus->in, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes) != 0 ||
        bind(bus->in, (struct sockaddr *)&where, sizeof where) != 0 ||
        setsockopt(bus->in, IPPROTO_IP, IP_ADD_MEMBERSHIP, &member, sizeof member) != 0 ||
        setsockopt(bus->out, IPPROTO_IP, IP_MULTICAST_TTL, &hop_limit, sizeof hop_limit) != 0 ||
        connect(bus->out, (struct sockaddr *)&where, sizeof where) != 0 ||
        getsockname(bus->out, (struct sockaddr *)&own, &own_length) != 0 ||
        fcntl(bus->in, F_SETFL, O_NONBLOCK) != 0) {
        return -1;
    }
    (void)setsockopt(bus->in, SOL_SOCKET, SO_RCVBUF, &room, sizeof room);
    if (bus->pace != NULL) {
        (void)setsockopt(bus->in, SOL_SOCKET, SO_TIMESTAMPNS, &yes, sizeof yes);
    }
    bus->own_address = own.sin_addr.s_addr;
    bus->own_port = own.sin_port;
    return 0;
}

int multicast_receive(host_bus *bus, teds_can_frame *frame)
{
    uint8_t datagram[4096];
    for (;;) {
        struct sockaddr_in from = {0};
        struct iovec where = {datagram, sizeof datagram};
        char stamp[64];
        struct msghdr message = {&from, sizeof from, &where, 1, stamp, sizeof stamp, 0};
        ssize_t length = recvmsg(bus->in, &message, 0);
        if (length < 0) {
            return errno == EAGAIN || errno == EWOULDBLOCK || errno == EINTR ? 0 : -1;
        }
        if (from.sin_addr.s_addr == bus->own_address && from.sin_port == bus->own_port) {
            continue; /* a controller does not give back its own frames */
        }
        if (multicast_unpack(datagram, (size_t)length, bus->fd, frame)) {
            if (bus->pace != NULL) {
                host_pace_came(bus->pace, host_arrival(&message));
            }
            return 1;
        }
    }
}

int multicast_send(host_bus *bus, const teds_can_frame *frame)
{
    uint8_t datagram[320];
    size_t length = multicast_pack(frame, datagram);
    return send(bus->out, datagram, length, 0) == (ssize_t)length ? 0 : -1;
}

/* The kernel drops what a station sends to another node, before it wakes this one: twenty nodes on a bus would each look at
 * every frame. The octets stand where multicast_pack and python-can put them, behind the UDP header. */
void multicast_accept(const host_bus *bus, uint8_t address)
{
#ifdef __linux__
    enum { PAYLOAD = 8, END_OF_KEY = PAYLOAD + 32, IDENTIFIER = PAYLOAD + 36, ALL = 0x1000 };
    struct sock_filter steps[] = {
        BPF_STMT(BPF_LD | BPF_W | BPF_ABS, END_OF_KEY),
        BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, 0x5F6964CE, 0, 8), /* "_id", and a number of 32 bits follows */
        BPF_STMT(BPF_LD | BPF_W | BPF_ABS, IDENTIFIER),
        BPF_STMT(BPF_ALU | BPF_AND | BPF_K, 0x1FFF00F0),
        BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, 0x18DA00F0, 0, 5), /* from a station to one node */
        BPF_STMT(BPF_LD | BPF_W | BPF_ABS, IDENTIFIER),
        BPF_STMT(BPF_ALU | BPF_RSH | BPF_K, 8),
        BPF_STMT(BPF_ALU | BPF_AND | BPF_K, 0xFF),
        BPF_JUMP(BPF_JMP | BPF_JEQ | BPF_K, address, 1, 0),
        BPF_STMT(BPF_RET | BPF_K, 0),
        BPF_STMT(BPF_RET | BPF_K, ALL),
    };
    const struct sock_fprog program = {sizeof steps / sizeof steps[0], steps};
    (void)setsockopt(bus->in, SOL_SOCKET, SO_ATTACH_FILTER, &program, sizeof program);
#else
    (void)bus;
    (void)address;
#endif
}
