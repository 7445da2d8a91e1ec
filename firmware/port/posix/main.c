/* SPDX-License-Identifier: Apache-2.0 */
/* teds-node: a node of the profile as a program, for benches and tests. */
#define _GNU_SOURCE
#include "host.h"
#ifdef TEDS_HOST_PSA
#include "teds_psa.h"
#else
#include "teds_bearssl.h"
#endif

#include <errno.h>
#include <poll.h>
#include <sched.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/random.h>
#include <time.h>

typedef struct board {
#ifndef TEDS_HOST_PSA
    teds_bearssl crypto; /* first: the port of BearSSL looks here */
#endif
    host_flash flash;
    host_channels channels;
    host_bus bus;
    host_nfc nfc;
    host_firmware firmware;
    host_pace pace;
    teds_port plain; /* the cryptography behind the watch of a paced port */
    bool has_bus, restarts;
    uint8_t uuid[10];
    uint64_t started, seed;
} board;

static volatile sig_atomic_t stopping, by_hand, pressed;

static void on_signal(int number)
{
    if (number == SIGUSR1) {
        by_hand = 1;
    } else if (number == SIGUSR2) {
        pressed = 1;
    } else {
        stopping = 1;
    }
}

static int port_erase(void *user, int area)
{
    board *own = user;
    const uint64_t began = host_clock();
    const int failed = host_flash_erase(&own->flash, area);
    own->pace.flash += host_clock() - began;
    return failed;
}

static int port_write(void *user, int area, uint32_t at, const uint8_t *octets, size_t length)
{
    board *own = user;
    const uint64_t began = host_clock();
    const int failed = host_flash_write(&own->flash, area, at, octets, length);
    own->pace.flash += host_clock() - began;
    return failed;
}

static int port_read(void *user, int area, uint32_t at, uint8_t *out, size_t length)
{
    return host_flash_read(&((board *)user)->flash, area, at, out, length);
}

/* With --seed what is drawn is known: for tests alone. */
static int port_random(void *user, uint8_t *out, size_t length)
{
    board *own = user;
    if (own->seed == 0) {
        return getrandom(out, length, 0) == (ssize_t)length ? 0 : -1;
    }
    for (size_t i = 0; i < length; i++) {
        own->seed = own->seed * 6364136223846793005u + 1442695040888963407u;
        out[i] = (uint8_t)(own->seed >> 56);
    }
    return 0;
}

static uint64_t port_now(void *user)
{
    return host_clock() - ((board *)user)->started;
}

static bool port_sample(void *user, uint8_t channel, uint64_t tick, uint8_t *out)
{
    return host_sample(&((board *)user)->channels, channel, tick, out);
}

static int place_of(const board *own, uint8_t channel)
{
    for (size_t i = 0; i < own->channels.count; i++) {
        if (own->channels.table[i].number == channel) {
            return (int)i;
        }
    }
    return -1;
}

static bool port_bears(void *user, uint8_t channel, const uint8_t *octets)
{
    (void)octets;
    return place_of(user, channel) >= 0;
}

static void port_set(void *user, uint8_t channel, const uint8_t *octets)
{
    board *own = user;
    int place = place_of(own, channel);
    memcpy(own->channels.set_points[place], octets, own->channels.table[place].octets);
}

static void port_set_point(void *user, uint8_t channel, uint8_t *out)
{
    board *own = user;
    int place = place_of(own, channel);
    memcpy(out, own->channels.set_points[place], own->channels.table[place].octets);
}

static void port_safe(void *user, uint8_t channel)
{
    board *own = user;
    memset(own->channels.set_points[place_of(own, channel)], 0, 8);
}

static void print_hex(const uint8_t *octets, size_t length)
{
    for (size_t i = 0; i < length; i++) {
        (void)printf("%02x", (unsigned)octets[i]);
    }
}

static void port_about(void *user, teds_firmware *out)
{
    host_firmware_about(&((board *)user)->firmware, out);
}

static void port_locate(void *user, uint8_t seconds)
{
    const board *own = user;
    (void)printf("{\"event\": \"locate\", \"uuid\": \"");
    print_hex(own->uuid, sizeof own->uuid);
    (void)printf("\", \"seconds\": %u}\n", (unsigned)seconds);
    (void)fflush(stdout);
}

static size_t port_manage(void *user, const uint8_t *packet, size_t length, uint8_t *out, size_t room)
{
    board *own = user;
    const uint64_t began = host_clock();
    const size_t answer = images_manage(&own->firmware.images, packet, length, out, room);
    own->pace.flash += host_clock() - began;
    return answer;
}

static void port_restart(void *user)
{
    ((board *)user)->restarts = true;
}

static void fill_port(teds_port *port, board *own)
{
    memset(port, 0, sizeof *port);
    port->user = own;
    port->slot_octets = HOST_SLOT;
    port->identity_octets = HOST_IDENTITY;
    port->unit = HOST_UNIT;
    port->erased = 0xFF;
    port->erase = port_erase;
    port->write = port_write;
    port->read = port_read;
    port->random = port_random;
    port->now = port_now;
    port->step = 1;
    port->drift = 50;
#ifndef TEDS_HOST_PSA
    own->crypto.random = port_random;
    (void)teds_bearssl_fill(port, &own->crypto); /* where it fails, teds_node_init refuses the port */
#endif
    port->channels = own->channels.table;
    port->channel_count = own->channels.count;
    port->sample = port_sample;
    port->bears = port_bears;
    port->set = port_set;
    port->set_point = port_set_point;
    port->safe = port_safe;
}

static void fill_firmware(teds_port *port, const board *own)
{
    if (!own->firmware.silent) {
        port->about = port_about;
        port->locate = port_locate;
    }
    if (own->firmware.has_images) {
        port->manage = port_manage;
        port->manage_octets = IMAGES_PACKET;
        port->restart = port_restart;
    }
}

/* -- a paced port tells what P-256 took beside the rest of its own part --------------------------------------------- */

static bool watched_good(void *user, const uint8_t point[65])
{
    board *own = user;
    const uint64_t began = host_clock();
    const bool good = own->plain.p256_good(user, point);
    own->pace.chip += host_clock() - began;
    return good;
}

static int watched_ecdh(void *user, const teds_key_ref *key, const uint8_t peer[65], uint8_t out[32])
{
    board *own = user;
    const uint64_t began = host_clock();
    const int failed = own->plain.p256_ecdh(user, key, peer, out);
    own->pace.chip += host_clock() - began;
    return failed;
}

static int watched_sign(void *user, const teds_key_ref *key, const uint8_t hash[32], uint8_t out[64])
{
    board *own = user;
    const uint64_t began = host_clock();
    const int failed = own->plain.p256_sign(user, key, hash, out);
    own->pace.chip += host_clock() - began;
    return failed;
}

static bool watched_verify(void *user, const uint8_t point[65], const uint8_t hash[32], const uint8_t signature[64])
{
    board *own = user;
    const uint64_t began = host_clock();
    const bool good = own->plain.p256_verify(user, point, hash, signature);
    own->pace.chip += host_clock() - began;
    return good;
}

static void watch(teds_port *port, board *own)
{
    own->plain = *port;
    port->p256_good = watched_good;
    port->p256_ecdh = watched_ecdh;
    port->p256_sign = watched_sign;
    port->p256_verify = watched_verify;
}

/* -- options --------------------------------------------------------------------------------------------------------------- */

typedef struct options {
    const char *flash, *can, *nfc, *uuid, *channels, *source, *cut, *seed;
    host_firmware_options firmware;
    bool fd, pace, tell;
} options;

static int usage(void)
{
    (void)fprintf(stderr, "teds-node --flash FILE [--can SPEC [--fd]] [--nfc udp:localhost:PORT] [--uuid HEX]\n"
                          "          [--channels FILE] [--source noise|sine:S|ramp:S] [--cut N[:torn]] [--seed N] [--pace] [--tell]\n"
                          "          [--about none|VERSION[+BUILD][,TEXT]] [--images FOLDER --owner PUBLIC_KEY [--image FILE]\n"
                          "          [--security-counter]]\n");
    return 2;
}

static int read_options(int count, char **words, options *out)
{
    const struct {
        const char *name;
        const char **value;
    } known[] = {{"--flash", &out->flash}, {"--can", &out->can},       {"--nfc", &out->nfc},
                 {"--uuid", &out->uuid},
                 {"--channels", &out->channels}, {"--source", &out->source}, {"--cut", &out->cut},
                 {"--seed", &out->seed},
                 {"--about", &out->firmware.about},
                 {"--images", &out->firmware.images},
                 {"--image", &out->firmware.image},
                 {"--owner", &out->firmware.owner}};
    for (int i = 1; i < count; i++) {
        const bool fd = strcmp(words[i], "--fd") == 0, pace = strcmp(words[i], "--pace") == 0;
        const bool counter = strcmp(words[i], "--security-counter") == 0, tells = strcmp(words[i], "--tell") == 0;
        bool found = fd || pace || tells || counter;
        out->fd = out->fd || fd;
        out->pace = out->pace || pace;
        out->tell = out->tell || tells || pace;
        out->firmware.keeps_counter = out->firmware.keeps_counter || counter;
        for (size_t k = 0; k < sizeof known / sizeof known[0] && !found; k++) {
            if (strcmp(words[i], known[k].name) == 0 && i + 1 < count) {
                *known[k].value = words[++i];
                found = true;
            }
        }
        if (!found) {
            return usage();
        }
    }
    return out->flash != NULL && (out->can != NULL || out->nfc != NULL) ? 0 : usage();
}

static int read_uuid(const char *text, uint8_t out[10])
{
    unsigned octet;
    if (strlen(text) != 20) {
        return -1;
    }
    for (size_t i = 0; i < 10; i++) {
        if (sscanf(text + 2 * i, "%2x", &octet) != 1) {
            return -1;
        }
        out[i] = (uint8_t)octet;
    }
    return 0;
}

static void say_ready(const teds_node *node, const teds_port *port, const options *given)
{
    uint8_t identity[23], hash[32];
    teds_sha256 state;
    teds_node_identify(node, identity);
    port->sha256_start(port->user, &state);
    port->sha256_update(port->user, &state, node->identity.point, 65);
    port->sha256_finish(port->user, &state, hash);
    (void)printf("{\"uuid\": \"");
    print_hex(identity + 1, 10);
    (void)printf("\", \"fingerprint\": \"");
    print_hex(hash, 32);
    (void)printf("\", \"links\": [%s%s%s], \"source\": \"%s\", \"ready\": true}\n", given->nfc != NULL ? "\"nfc\"" : "",
                 given->nfc != NULL && given->can != NULL ? ", " : "", given->can != NULL ? "\"can\"" : "",
                 given->source);
    (void)fflush(stdout);
}

/* -- the loop ---------------------------------------------------------------------------------------------------------------- */

#define AWAKE 1000000u /* ns after the last frame, for which a paced port asks without sleeping */

static void wait_for(const board *own, uint64_t until)
{
    struct pollfd ready[2] = {{own->has_bus ? own->bus.in : -1, POLLIN, 0}, {own->nfc.in, POLLIN, 0}};
    uint64_t now = port_now((void *)(uintptr_t)own);
    uint64_t wait = until <= now ? 0 : until - now;
    struct timespec time;
    wait = wait < 500000000u ? wait : 500000000u;
    time.tv_sec = 0;
    time.tv_nsec = (long)wait;
    /* A chip is there in a microsecond; a process that sleeps, in fifty. */
    while (own->pace.on && now < own->pace.heard - own->started + AWAKE && now < until) {
        if (poll(ready, 2, 0) > 0) {
            return;
        }
        (void)sched_yield(); /* several nodes on one machine do the same */
        now = port_now((void *)(uintptr_t)own);
    }
    (void)ppoll(ready, 2, &time, NULL);
}

static int run(board *own, teds_node *node)
{
    teds_can_frame frame;
    int came = 0;
    if (own->has_bus) {
        teds_can_start(node, port_now(own));
    }
    while (!stopping && !own->restarts) {
        uint64_t due;
        bool busy = false;
        if (by_hand) {
            by_hand = 0;
            (void)teds_node_reset_by_hand(node);
        }
        if (pressed) {
            pressed = 0;
            teds_can_pressed(node, port_now(own));
        }
        while (own->nfc.in >= 0 && host_nfc_serve(&own->nfc, node)) {
            (void)teds_node_poll(node, port_now(own));
            busy = true;
        }
        while (own->has_bus && (came = host_bus_receive(&own->bus, &frame)) == 1) {
            teds_can_rx(node, &frame, port_now(own));
            busy = true;
            while (teds_can_tx(node, &frame, port_now(own))) {
                (void)host_bus_send(&own->bus, &frame);
            }
        }
        if (came < 0) {
            (void)fprintf(stderr, "The bus is gone.\n");
            return 5;
        }
        due = teds_node_poll(node, port_now(own));
        while (own->has_bus && teds_can_tx(node, &frame, port_now(own))) {
            (void)host_bus_send(&own->bus, &frame);
            busy = true;
        }
        if (!busy && due > port_now(own) + 1000000u && teds_idle_work(node)) {
            continue;
        }
        if (busy) {
            due = teds_node_poll(node, port_now(own));
        }
        if (own->has_bus) {
            host_bus_accept(&own->bus, node->can.address);
        }
        wait_for(own, due);
    }
    return 0;
}

/* One line of JSON: turnarounds and seconds of each kind (all 0 but with --pace), data messages that it did not send, and
 * frames that its socket had no room for. */
static void tell(const board *own, const teds_node *node)
{
    const host_pace *pace = &own->pace;
    (void)printf("{\"turns\": %lu, \"turned\": %.6f, \"chip\": %.6f, \"flash\": %.6f, \"missed\": %lu, \"dropped\": %lu}\n",
                 (unsigned long)pace->turns, (double)pace->turned / 1e9, (double)pace->chip / 1e9,
                 (double)pace->flash / 1e9, (unsigned long)teds_node_missed(node),
                 own->has_bus ? (unsigned long)host_bus_dropped(&own->bus) : 0);
    (void)fflush(stdout);
}

int main(int count, char **words)
{
    static board own;
    static teds_node node;
    static teds_config config;
    static teds_port port;
    struct sigaction action;
    options given = {.source = "noise"};
    uint8_t uid[3];
    int failed = read_options(count, words, &given);
    if (failed) {
        return failed;
    }
    own.started = host_clock();
    own.seed = given.seed != NULL ? strtoull(given.seed, NULL, 10) : 0;
    own.flash.cut = given.cut != NULL ? atol(given.cut) : 0;
    own.flash.torn = given.cut != NULL && strstr(given.cut, ":torn") != NULL;
    if (host_flash_open(&own.flash, given.flash) != 0) {
        (void)fprintf(stderr, "%s is no flash file: %s.\n", given.flash, strerror(errno));
        return 2;
    }
    if (host_source(&own.channels, given.source) != 0 ||
        (given.channels != NULL && host_channels_read(&own.channels, given.channels) != 0)) {
        return 2;
    }
    fill_port(&port, &own);
#ifdef TEDS_HOST_PSA
    if (teds_psa_fill(&port, true) != 0) {
        (void)fprintf(stderr, "PSA Crypto does not start.\n");
        return 1;
    }
#endif
    if (host_firmware_start(&own.firmware, &given.firmware, &own.flash, &port) != 0) {
        return 1;
    }
    fill_firmware(&port, &own);
    if (host_firmware_behaves(&own.firmware, "confirm")) {
        (void)images_confirm(&own.firmware.images);
    }
    if (given.pace) {
        watch(&port, &own);
    }
    config.quick_points = true;
    config.no_can = given.can == NULL;
    config.nfc.present = given.nfc != NULL;
    config.nfc.wt_int = 4;
    config.nfc.n_wait = 15;
    if (given.uuid != NULL ? read_uuid(given.uuid, config.uuid) != 0 : port_random(&own, config.uuid, 10) != 0) {
        return usage();
    }
    failed = host_firmware_behaves(&own.firmware, "crash") ? TEDS_E_FLASH : teds_node_init(&node, &config, &port);
    if (failed && own.firmware.has_images && images_on_trial(&own.firmware.images)) {
        host_restart(&own.flash, words); /* which reverts it */
    }
    if (failed) {
        (void)fprintf(stderr, failed == TEDS_E_IDENTITY ? "The identity in %s is torn; erase the board.\n"
                                                        : "The node does not start (%s).\n",
                      given.flash);
        return 1;
    }
    memcpy(own.uuid, node.identity.uuid, sizeof own.uuid);
    own.has_bus = given.can != NULL && !host_firmware_behaves(&own.firmware, "mute");
    own.nfc.in = -1;
    if ((own.has_bus && host_bus_open(&own.bus, given.can, given.fd, &own.pace, given.pace) != 0) ||
        (given.nfc != NULL && (port_random(&own, uid, sizeof uid) != 0 ||
                               host_nfc_open(&own.nfc, given.nfc, uid, given.pace ? &own.pace : NULL) != 0))) {
        return 5;
    }
    memset(&action, 0, sizeof action);
    action.sa_handler = on_signal;
    (void)sigaction(SIGTERM, &action, NULL);
    (void)sigaction(SIGINT, &action, NULL);
    (void)sigaction(SIGUSR1, &action, NULL);
    (void)sigaction(SIGUSR2, &action, NULL);
    say_ready(&node, &port, &given);
    own.pace.chip = own.pace.flash = 0; /* of its start */
    failed = run(&own, &node);
    if (own.restarts) {
        host_restart(&own.flash, words);
        return 1;
    }
    if (given.tell) {
        tell(&own, &node);
    }
    return failed;
}
