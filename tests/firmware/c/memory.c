/* SPDX-License-Identifier: Apache-2.0 */
#include "memory.h"

#include "links.h"
#include "operation.h"
#include "security_teds.h"
#include "session.h"
#include "stream.h"
#include "slots.h"
#include "inside.h"

#include <bearssl.h>

#include <stdlib.h>
#include <string.h>

static uint32_t start_of(int area)
{
    return area == TEDS_IDENTITY ? 0 : area == TEDS_SLOT_A ? MEMORY_IDENTITY : MEMORY_IDENTITY + MEMORY_SLOT;
}

static uint32_t octets_of(int area)
{
    return area == TEDS_IDENTITY ? MEMORY_IDENTITY : MEMORY_SLOT;
}

/* The power is gone: nothing of this board works any more. */
static bool fails_now(memory_board *board)
{
    board->steps++;
    if (board->cut != 0 && board->steps == board->cut) {
        board->dead = true;
    }
    return board->dead;
}

static int erase(void *user, int area)
{
    memory_board *board = user;
    bool was_dead = board->dead, fails = fails_now(board);
    if (was_dead || board->fails) {
        return -1;
    }
    if (!fails || board->torn) {
        memset(board->flash + start_of(area), board->port.erased, fails ? octets_of(area) / 2 : octets_of(area));
    }
    board->next[area] = 0;
    return fails ? -1 : 0;
}

static int write(void *user, int area, uint32_t at, const uint8_t *octets, size_t length)
{
    memory_board *board = user;
    bool was_dead = board->dead, fails = fails_now(board);
    uint8_t *there = board->flash + start_of(area) + at;
    if (was_dead || board->fails) {
        return -1;
    }
    if (at + length > octets_of(area) || at % board->port.unit != 0 || length % board->port.unit != 0 ||
        at < board->next[area]) {
        board->misused = true;
        return -1;
    }
    for (size_t i = 0; i < length; i++) {
        board->misused = board->misused || there[i] != board->port.erased;
    }
    if (!fails || board->torn) {
        memcpy(there, octets, fails ? length / 2 : length);
    }
    if (++board->written == board->garbled) {
        *there ^= 0x10;
    }
    board->next[area] = at + (uint32_t)length;
    return fails ? -1 : 0;
}

static int read(void *user, int area, uint32_t at, uint8_t *out, size_t length)
{
    memory_board *board = user;
    if (board->dead || ++board->reads == board->unreadable || length > octets_of(area) || at + length > octets_of(area)) {
        return -1;
    }
    memcpy(out, board->flash + start_of(area) + at, length);
    return 0;
}

static int octets(void *user, uint8_t *out, size_t length)
{
    const memory_board *board = user;
    return board->random('n', out, length);
}

static int scalar(void *user, int use, teds_key_ref *key, uint8_t point[65])
{
    memory_board *board = user;
    if (board->random(use == TEDS_KEY_SIGNS ? 'i' : 'o', key->octets, 32) != 0) {
        return -1;
    }
    return br_ec_p256_m31.mulgen(point, key->octets, 32, BR_EC_secp256r1) == 65 ? 0 : -1;
}

static uint64_t clock_now(void *user)
{
    return ((memory_board *)user)->now;
}

static size_t place_of(const memory_board *board, uint8_t channel)
{
    size_t place = 0;
    while (board->channels[place].number != channel) {
        place++;
    }
    return place;
}

/* A value that follows from the channel and the time alone. */
static bool sample(void *user, uint8_t channel, uint64_t tick, uint8_t *out)
{
    const memory_board *board = user;
    const teds_channel *own = &board->channels[place_of(board, channel)];
    uint64_t value = tick / 1000000u + channel;
    for (size_t i = own->octets; i-- > 0; value >>= 8) {
        out[i] = (uint8_t)value;
    }
    return true;
}

static bool bears(void *user, uint8_t channel, const uint8_t *value)
{
    (void)user;
    (void)channel;
    return value[0] < 0xF0;
}

static void set(void *user, uint8_t channel, const uint8_t *value)
{
    memory_board *board = user;
    size_t place = place_of(board, channel);
    memcpy(board->values[place], value, board->channels[place].octets);
}

static void set_point(void *user, uint8_t channel, uint8_t *out)
{
    const memory_board *board = user;
    size_t place = place_of(board, channel);
    memcpy(out, board->values[place], board->channels[place].octets);
}

static void safe(void *user, uint8_t channel)
{
    memory_board *board = user;
    memset(board->values[place_of(board, channel)], 0, 8);
}

/* -- a chip whose calls may fail --------------------------------------------------------------------------------------- */

static bool chip_fails(void *user)
{
    memory_board *board = user;
    return ++board->calls == board->failing;
}

static int chip_random(void *user, uint8_t *out, size_t length)
{
    return chip_fails(user) ? -1 : ((memory_board *)user)->chip.random(user, out, length);
}

static int chip_make(void *user, int use, teds_key_ref *key, uint8_t point[65])
{
    return chip_fails(user) ? -1 : ((memory_board *)user)->chip.p256_make(user, use, key, point);
}

static int chip_ecdh(void *user, const teds_key_ref *key, const uint8_t peer[65], uint8_t out[32])
{
    return chip_fails(user) ? -1 : ((memory_board *)user)->chip.p256_ecdh(user, key, peer, out);
}

static int chip_sign(void *user, const teds_key_ref *key, const uint8_t hash[32], uint8_t out[64])
{
    return chip_fails(user) ? -1 : ((memory_board *)user)->chip.p256_sign(user, key, hash, out);
}

static int chip_hmac(void *user, const uint8_t *key, size_t key_length, const teds_part *parts, size_t count,
                     uint8_t out[32])
{
    return chip_fails(user) ? -1 : ((memory_board *)user)->chip.hmac(user, key, key_length, parts, count, out);
}

static int chip_seal(void *user, const uint8_t key[16], const uint8_t nonce[13], const uint8_t *in, size_t length,
                     uint8_t *out, size_t tag_length)
{
    return chip_fails(user) ? -1 : ((memory_board *)user)->chip.ccm_seal(user, key, nonce, in, length, out, tag_length);
}

void memory_chip_fails(memory_board *board, long call)
{
    teds_port *port = &board->port;
    if (board->chip.hmac == NULL) {
        board->chip = *port;
        port->random = chip_random;
        port->p256_make = chip_make;
        port->p256_ecdh = chip_ecdh;
        port->p256_sign = chip_sign;
        port->hmac = chip_hmac;
        port->ccm_seal = chip_seal;
    }
    board->calls = 0;
    board->failing = call;
}

long memory_chip_calls(const memory_board *board)
{
    return board->calls;
}

/* -- channels in a test's hands --------------------------------------------------------------------------------------- */

static int ask(void *user, char what, uint8_t channel, uint64_t argument, uint8_t *octets_of_it, size_t length)
{
    return ((memory_board *)user)->hook(what, channel, argument, octets_of_it, length);
}

static size_t width(const void *user, uint8_t channel)
{
    const memory_board *board = user;
    return board->channels[place_of(board, channel)].octets;
}

static bool ask_sample(void *user, uint8_t channel, uint64_t tick, uint8_t *out)
{
    return ask(user, 's', channel, tick, out, width(user, channel)) != 0;
}

static bool ask_bears(void *user, uint8_t channel, const uint8_t *value)
{
    uint8_t copy[256];
    memcpy(copy, value, width(user, channel));
    return ask(user, 'b', channel, 0, copy, width(user, channel)) != 0;
}

static void ask_set(void *user, uint8_t channel, const uint8_t *value)
{
    uint8_t copy[256];
    memcpy(copy, value, width(user, channel));
    (void)ask(user, 'a', channel, 0, copy, width(user, channel));
}

static void ask_set_point(void *user, uint8_t channel, uint8_t *out)
{
    (void)ask(user, 'g', channel, 0, out, width(user, channel));
}

static void ask_safe(void *user, uint8_t channel)
{
    (void)ask(user, 'f', channel, 0, NULL, 0);
}

static void ask_arm(void *user, uint8_t channel, uint16_t ms)
{
    (void)ask(user, 'm', channel, ms, NULL, 0);
}

static void ask_kick(void *user, uint8_t channel)
{
    (void)ask(user, 'k', channel, 0, NULL, 0);
}

static void ask_self_test(void *user, uint8_t channel)
{
    (void)ask(user, 't', channel, 0, NULL, 0);
}

static bool ask_testing(void *user, uint8_t channel)
{
    return ask(user, 'T', channel, 0, NULL, 0) != 0;
}

static bool ask_fault(void *user, uint8_t channel)
{
    return ask(user, 'F', channel, 0, NULL, 0) != 0;
}

static void ask_power(void *user, teds_power *out)
{
    uint8_t power[7] = {0};
    (void)ask(user, 'p', 0, 0, power, sizeof power);
    out->flags = power[0];
    out->level = power[1];
    out->voltage = teds_get16(power + 2);
    out->current = (int16_t)teds_get16(power + 4);
    out->temperature = (int8_t)power[6];
}

void memory_hook_up(memory_board *board, memory_hook hook)
{
    teds_port *port = &board->port;
    board->hook = hook;
    port->sample = ask_sample;
    port->bears = ask_bears;
    port->set = ask_set;
    port->set_point = ask_set_point;
    port->safe = ask_safe;
    port->arm = ask_arm;
    port->kick = ask_kick;
    port->self_test = ask_self_test;
    port->testing = ask_testing;
    port->fault = ask_fault;
    port->power = ask_power;
}

static void tell_about(void *user, teds_firmware *out)
{
    memory_board *board = user;
    uint8_t report[128] = {0};
    const size_t length = board->firmware('a', 0, report, 0, sizeof report);
    out->flags = report[0];
    out->major = report[1];
    out->minor = report[2];
    out->patch = teds_get16(report + 3);
    out->build = teds_get32(report + 5);
    memcpy(out->image, report + 9, 32);
    memset(board->text, 0, sizeof board->text);
    if (length > 41) {
        memcpy(board->text, report + 41, length - 41 < sizeof board->text ? length - 41 : sizeof board->text - 1);
        out->text = board->text;
    }
}

static void tell_locate(void *user, uint8_t seconds)
{
    (void)((memory_board *)user)->firmware('l', seconds, NULL, 0, 0);
}

/* -- images: their flash fails at the same steps -------------------------------------------------------------------------- */

static uint8_t *image_at(memory_board *board, int area, uint32_t at, size_t length)
{
    const uint32_t octets_of_it = area == IMAGES_RECORDS ? IMAGES_RECORD_OCTETS : MEMORY_IMAGE;
    return at > octets_of_it || length > octets_of_it - at ? NULL : board->image_flash + (size_t)area * MEMORY_IMAGE + at;
}

static int erase_page(void *user, int area, uint32_t at)
{
    memory_board *board = user;
    const bool was_dead = board->dead, fails = fails_now(board);
    uint8_t *there = image_at(board, area, at, IMAGES_PAGE);
    if (was_dead || there == NULL || at % IMAGES_PAGE != 0) {
        board->misused = board->misused || !was_dead;
        return -1;
    }
    if (board->fails) {
        return -1;
    }
    if (!fails || board->torn) {
        memset(there, 0xFF, fails ? IMAGES_PAGE / 2 : IMAGES_PAGE);
    }
    return fails ? -1 : 0;
}

static int write_image(void *user, int area, uint32_t at, const uint8_t *octets_of_it, size_t length)
{
    memory_board *board = user;
    const bool was_dead = board->dead, fails = fails_now(board);
    uint8_t *there = image_at(board, area, at, length);
    if (was_dead || there == NULL || at % IMAGES_UNIT != 0 || length % IMAGES_UNIT != 0) {
        board->misused = board->misused || !was_dead;
        return -1;
    }
    if (board->fails) {
        return -1;
    }
    for (size_t i = 0; i < length; i++) {
        board->misused = board->misused || there[i] != 0xFF;
    }
    if (!fails || board->torn) {
        memcpy(there, octets_of_it, fails ? length / 2 : length);
    }
    return fails ? -1 : 0;
}

static int read_image(void *user, int area, uint32_t at, uint8_t *out, size_t length)
{
    memory_board *board = user;
    const uint8_t *there = image_at(board, area, at, length);
    if (board->dead || there == NULL) {
        return -1;
    }
    memcpy(out, there, length);
    return 0;
}

static void image_about(void *user, teds_firmware *out)
{
    images_about(&((memory_board *)user)->images, out);
}

static size_t image_manage(void *user, const uint8_t *packet, size_t length, uint8_t *out, size_t room)
{
    return images_manage(&((memory_board *)user)->images, packet, length, out, room);
}

static void image_restart(void *user)
{
    ((memory_board *)user)->restarts = true;
}

bool memory_images(memory_board *board, const uint8_t *owner, size_t length, bool counter)
{
    board->images.flash = (images_flash){board, erase_page, write_image, read_image, MEMORY_IMAGE};
    board->images.port = &board->port;
    board->images.keeps_counter = counter;
    memset(board->image_flash, 0xFF, sizeof board->image_flash);
    board->has_images = true;
    board->port.about = image_about;
    board->port.manage = image_manage;
    board->port.manage_octets = IMAGES_PACKET;
    board->port.restart = image_restart;
    return images_owner(&board->images, owner, length) == 0;
}

size_t memory_image_flash(const memory_board *board, uint8_t *out)
{
    if (out != NULL) {
        memcpy(out, board->image_flash, sizeof board->image_flash);
    }
    return sizeof board->image_flash;
}

void memory_put_image_flash(memory_board *board, const uint8_t *octets_of_it)
{
    memcpy(board->image_flash, octets_of_it, sizeof board->image_flash);
}

bool memory_restarts(memory_board *board)
{
    const bool restarts = board->restarts;
    board->restarts = false;
    return restarts;
}

int memory_restart(memory_board *board)
{
    memset(board->next, 0, sizeof board->next);
    if (board->has_images && images_boot(&board->images) != 0) {
        return MEMORY_NO_IMAGE;
    }
    return teds_node_init(&board->node, &board->config, &board->port);
}

/* -- firmware in a test's hands ------------------------------------------------------------------------------------------ */

/* What comes is kept apart, so that the sanitizer sees what is read beyond it; both share memory. */
static size_t tell_manage(void *user, const uint8_t *packet, size_t length, uint8_t *out, size_t room)
{
    memory_board *board = user;
    uint8_t octets_of_it[TEDS_MAX_MESSAGE];
    size_t answered;
    memcpy(octets_of_it, packet, length);
    answered = board->firmware('m', 0, octets_of_it, length, sizeof octets_of_it);
    if (answered <= room) {
        memcpy(out, octets_of_it, answered);
    }
    return answered;
}

static void tell_restart(void *user)
{
    (void)((memory_board *)user)->firmware('r', 0, NULL, 0, 0);
}

void memory_firmware(memory_board *board, memory_firmware_hook hook, uint16_t most)
{
    board->firmware = hook;
    board->port.about = tell_about;
    board->port.locate = tell_locate;
    board->port.manage = tell_manage;
    board->port.manage_octets = most;
    board->port.restart = tell_restart;
}

void memory_pressed(memory_board *board)
{
    teds_can_pressed(&board->node, board->now);
}

void memory_without(memory_board *board, char what)
{
    teds_port *port = &board->port;
    switch (what) {
    case 's': port->sample = NULL; break;
    case 'b': port->bears = NULL; break;
    case 'a': port->set = NULL; break;
    case 'g': port->set_point = NULL; break;
    case 'f': port->safe = NULL; break;
    case 't': port->self_test = NULL; break;
    case 'T': port->testing = NULL; break;
    case 'F': port->fault = NULL; break;
    case 'p': port->power = NULL; break;
    case 'm': port->arm = NULL; break;
    case 'A': port->about = NULL; break;
    case 'L': port->locate = NULL; break;
    case 'M': port->manage = NULL; break;
    case 'R': port->restart = NULL; break;
    default: port->kick = NULL; break;
    }
}

memory_board *memory_new(const uint8_t uuid[10], uint8_t unit, uint8_t erased, memory_random random)
{
    memory_board *board = calloc(1, sizeof *board);
    if (board == NULL) {
        return NULL;
    }
    board->random = random;
    board->crypto.random = octets;
    memcpy(board->config.uuid, uuid, 10);
    board->config.quick_points = true;
    board->port.user = board;
    board->port.slot_octets = MEMORY_SLOT;
    board->port.identity_octets = MEMORY_IDENTITY;
    board->port.unit = unit;
    board->port.erased = erased;
    board->port.erase = erase;
    board->port.write = write;
    board->port.read = read;
    board->port.random = octets;
    board->port.now = clock_now;
    board->port.step = 1;
    board->port.drift = 50;
    (void)teds_bearssl_fill(&board->port, &board->crypto);
    board->port.p256_make = scalar;
    board->port.channels = board->channels;
    board->port.sample = sample;
    board->port.bears = bears;
    board->port.set = set;
    board->port.set_point = set_point;
    board->port.safe = safe;
    memset(board->flash, erased, sizeof board->flash);
    return board;
}

void memory_free(memory_board *board)
{
    free(board);
}

/* Power comes (back). */
int memory_start(memory_board *board)
{
    return memory_start_cut(board, 0, false);
}

/* The same, and it fails at this step. */
int memory_start_cut(memory_board *board, long step, bool torn)
{
    board->dead = false;
    board->cut = step;
    board->torn = torn;
    board->steps = 0;
    return memory_restart(board);
}

void memory_channel(memory_board *board, uint8_t number, uint8_t kind, uint8_t model, uint8_t octets_of_one,
                    uint32_t shortest)
{
    teds_channel *own = &board->channels[board->port.channel_count++];
    own->number = number;
    own->kind = kind;
    own->model = model;
    own->octets = octets_of_one;
    own->shortest = shortest;
}

void memory_garble(memory_board *board, long unit)
{
    board->written = 0;
    board->garbled = unit;
}

long memory_written(const memory_board *board)
{
    return board->written;
}

bool memory_spare_slot_fails(const memory_board *board)
{
    return board->node.spare_slot_fails;
}

void memory_slot_octets(memory_board *board, uint32_t octets)
{
    board->port.slot_octets = octets;
}

uint64_t memory_missed(const memory_board *board)
{
    return teds_node_missed(&board->node);
}

void memory_no_channels(memory_board *board)
{
    board->port.channel_count = 0;
}

void memory_halt(memory_board *board, uint8_t number, uint8_t halt)
{
    board->channels[place_of(board, number)].halt = halt;
}

void memory_slow(memory_board *board, bool slow)
{
    board->config.quick_points = !slow;
}

void memory_clock(memory_board *board, uint32_t step, uint16_t drift)
{
    board->port.step = step;
    board->port.drift = drift;
}

void memory_by_fd(memory_board *board, bool fd)
{
    board->fd = fd;
}

bool memory_acts(const memory_board *board)
{
    return teds_actuator_claimed(&board->node);
}

bool memory_streams(const memory_board *board)
{
    return teds_streams_running(&board->node);
}

void memory_set_run(memory_board *board, uint8_t link, uint16_t run)
{
    teds_session_on(&board->node, link)->run = run;
}

void memory_set_counter(memory_board *board, uint32_t counter, uint64_t start)
{
    board->node.streams[0].counter = counter;
    board->node.streams[0].start = start;
}

void memory_at(memory_board *board, uint64_t now)
{
    board->now = now;
}

void memory_cut(memory_board *board, long step, bool torn)
{
    board->steps = 0;
    board->cut = step;
    board->torn = torn;
}

/* This read of flash from now on fails, it alone; 0: none. How many there were. */
void memory_read_fails(memory_board *board, long read_of_flash)
{
    board->reads = 0;
    board->unreadable = read_of_flash;
}

long memory_reads(const memory_board *board)
{
    return board->reads;
}

/* Flash that refuses to be written or erased, and works again. */
void memory_fails(memory_board *board, bool fails)
{
    board->fails = fails;
}

long memory_steps(const memory_board *board)
{
    return board->steps;
}

bool memory_dead(const memory_board *board)
{
    return board->dead;
}

bool memory_misused(const memory_board *board)
{
    return board->misused;
}

size_t memory_flash(const memory_board *board, uint8_t *out)
{
    if (out != NULL) {
        memcpy(out, board->flash, sizeof board->flash);
    }
    return sizeof board->flash;
}

void memory_put_flash(memory_board *board, const uint8_t *octets_of_it)
{
    memcpy(board->flash, octets_of_it, sizeof board->flash);
}

size_t memory_handle(memory_board *board, uint8_t link, uint8_t kind, bool tapped, const uint8_t *frame,
                     size_t length, uint8_t *reply)
{
    const teds_arrival arrival = {kind, tapped, board->fd, board->now};
    return teds_node_handle(&board->node, link, &arrival, frame, length, reply);
}

uint64_t memory_poll(memory_board *board)
{
    return teds_node_poll(&board->node, board->now);
}

void memory_reply_left(memory_board *board, uint8_t link)
{
    teds_node_reply_left(&board->node, link);
}

int memory_put(memory_board *board, uint8_t flags, uint8_t address, uint32_t epoch, uint32_t sequence,
               const uint8_t key[16], const uint8_t station[65], const uint8_t ca[65], const uint8_t *teds,
               size_t length)
{
    const teds_signed none = {.block_count = 0};
    teds_state state = {0};
    int failed;
    if (length > TEDS_STAGING) {
        return -1;
    }
    state.flags = flags;
    state.address = address;
    state.epoch = epoch;
    state.sequence = sequence;
    memcpy(state.agreed.key, key, 16);
    memcpy(state.agreed.station, station, 65);
    memcpy(state.agreed.ca, ca, 65);
    memcpy(board->node.staging, teds, length);
    board->node.staging_end = (uint16_t)length;
    failed = teds_slots_write(&board->node, &state, &none);
    board->node.staging_end = 0;
    return failed ? failed : memory_start(board);
}

void memory_fixed(memory_board *board, uint8_t channel, uint8_t code, const uint8_t *octets_of_it, uint16_t length)
{
    teds_fixed *own = &board->fixed[board->config.fixed_count++];
    own->channel = channel;
    own->code = code;
    own->length = length;
    own->octets = octets_of_it;
    board->config.fixed = board->fixed;
}

void memory_can_start(memory_board *board)
{
    teds_can_start(&board->node, board->now);
}

void memory_lost(memory_board *board, uint8_t link)
{
    teds_node_link_lost(&board->node, link);
}

void memory_bus_off(memory_board *board)
{
    teds_node_bus_off(&board->node);
    teds_can_start(&board->node, board->now);
}

void memory_move(memory_board *board, uint8_t address)
{
    teds_address_move(&board->node, address);
}

int memory_by_hand(memory_board *board)
{
    return teds_node_reset_by_hand(&board->node);
}

void memory_can_rx(memory_board *board, uint32_t identifier, const uint8_t *data, uint8_t length, bool fd)
{
    memory_can_rx_at(board, identifier, data, length, fd, board->now);
}

/* The same, and its end was at `tick`: frames wait in a controller. */
void memory_can_rx_at(memory_board *board, uint32_t identifier, const uint8_t *data, uint8_t length, bool fd,
                      uint64_t tick)
{
    teds_can_frame frame = {identifier, length, fd, {0}};
    if (length <= sizeof frame.data) {
        memcpy(frame.data, data, length);
        teds_can_rx(&board->node, &frame, tick);
    }
}

int memory_can_tx(memory_board *board, uint32_t *identifier, uint8_t *data, bool *fd)
{
    teds_can_frame frame;
    if (!teds_can_tx(&board->node, &frame, board->now)) {
        return -1;
    }
    *identifier = frame.identifier;
    *fd = frame.fd;
    memcpy(data, frame.data, frame.length);
    return frame.length;
}

void memory_event(memory_board *board, uint8_t channel, uint64_t tick, const uint8_t *octets_of_it, bool valid)
{
    teds_sensor_event(&board->node, channel, tick, octets_of_it, valid);
}

void memory_set_point(const memory_board *board, uint8_t channel, uint8_t *out)
{
    size_t place = place_of(board, channel);
    memcpy(out, board->values[place], board->channels[place].octets);
}

size_t memory_node_octets(void)
{
    return sizeof(teds_node);
}

#if TEDS_NFC
void memory_nfc(memory_board *board, uint8_t wt_int, uint8_t n_wait, uint16_t max_ndef)
{
    board->config.nfc.present = true;
    board->config.nfc.wt_int = wt_int;
    board->config.nfc.n_wait = n_wait;
    board->config.nfc.max_ndef = max_ndef;
}

void memory_nfc_service(memory_board *board, const char *name,
                        int (*answer)(void *, const uint8_t *, size_t, uint8_t *, size_t))
{
    board->services[board->config.nfc.service_count] = (teds_nfc_service){name, board, answer};
    board->config.nfc.services = board->services;
    board->config.nfc.service_count++;
}

static void battery(void *user, teds_power *out)
{
    const memory_board *board = user;
    out->flags = board->power[0];
    out->level = board->power[1];
}

void memory_battery(memory_board *board, uint8_t flags, uint8_t level)
{
    board->power[0] = flags;
    board->power[1] = level;
    board->port.power = battery;
}

void memory_in_the_air(memory_board *board, const uint8_t address[6])
{
    memcpy(board->air, address, sizeof board->air);
    board->config.ble_address = board->air;
}

void memory_nfc_field(memory_board *board, bool present)
{
    teds_nfc_field(&board->node, present);
}

bool memory_nfc_written(memory_board *board, const uint8_t *message, size_t length)
{
    return teds_nfc_written(&board->node, message, length);
}

size_t memory_nfc_message(const memory_board *board, uint8_t *out)
{
    size_t length;
    const uint8_t *message = teds_nfc_message(&board->node, &length);
    memcpy(out, message, length);
    return length;
}

size_t memory_nfc_frame(memory_board *board, const uint8_t *frame, size_t length, uint8_t out[256])
{
    if (length > 0 && frame[0] == 0xE0) {
        return teds_isodep_start(&board->node, &board->card, frame, length, out);
    }
    return teds_isodep_block(&board->node, &board->card, frame, length, out);
}
#endif

#if TEDS_BLE
void memory_ble_connected(memory_board *board, uint8_t connection, uint16_t mtu)
{
    teds_ble_connected(&board->node, connection, mtu);
}

void memory_ble_mtu(memory_board *board, uint8_t connection, uint16_t mtu)
{
    teds_ble_mtu(&board->node, connection, mtu);
}

void memory_ble_disconnected(memory_board *board, uint8_t connection)
{
    teds_ble_disconnected(&board->node, connection);
}

void memory_ble_written(memory_board *board, uint8_t connection, const uint8_t *value, size_t length)
{
    teds_ble_written(&board->node, connection, value, length);
}

size_t memory_ble_notify(memory_board *board, uint8_t connection, uint8_t out[512])
{
    return teds_ble_notify(&board->node, connection, out);
}

void memory_ble_hears(memory_board *board, uint8_t connection, bool hears)
{
    teds_ble_hears(&board->node, connection, hears);
}

size_t memory_ble_data(memory_board *board, uint8_t *connection, uint8_t out[TEDS_BLE_DATA])
{
    return teds_ble_data(&board->node, connection, out);
}

void memory_ble_driven(memory_board *board, uint8_t connection, const uint8_t *value, size_t length)
{
    teds_ble_driven(&board->node, connection, value, length);
}

bool memory_ble_advertises(const memory_board *board)
{
    return teds_ble_advertises(&board->node);
}

bool memory_ble_drops(memory_board *board, uint8_t connection)
{
    return teds_ble_drops(&board->node, connection);
}

bool memory_in_session(memory_board *board, uint8_t link)
{
    return teds_session_on(&board->node, link) != NULL;
}
#endif
