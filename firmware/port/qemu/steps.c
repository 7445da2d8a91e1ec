/* SPDX-License-Identifier: Apache-2.0 */
/* What each step of a node costs, counted: instructions of the whole command from frame to reply, and the stack below it.
 *
 * A node lives through the published first agreement, session and datasheet (tests/vectors/profile/kat.json), with their
 * keys and nonces, so that every reply is known. Flash is RAM here: what a chip's own flash takes comes on top. */
#include "image.h"
#include "octets.h"
#include "teds/node.h"
#include "teds_bearssl.h"
#include "teds_vectors.h"

#include <string.h>

#define IDENTITY 256u
#define SLOT 8192u
#define FIRST_STATION 0xF1u

static teds_bearssl crypto; /* `user` of the port */
static teds_node node;
static teds_config config;
static teds_port port;
static uint8_t flash[IDENTITY + 2 * SLOT];
static const uint8_t *scalar; /* of the next key that is made */
static uint64_t now_ns = 1000000000u;
static uint8_t reply[TEDS_MAX_MESSAGE], frame[TEDS_MAX_MESSAGE];
static uint32_t counter;
static const teds_channel channels[] = {{1, TEDS_SENSOR, 0, 2, 0, 100000}};
static const struct teds_kat *const kat = &teds_vectors_kat;

/* -- the board ------------------------------------------------------------------------------------------------------------ */

static uint8_t *place(int area)
{
    return flash + (area == TEDS_IDENTITY ? 0 : area == TEDS_SLOT_A ? IDENTITY : IDENTITY + SLOT);
}

static int erase(void *user, int area)
{
    (void)user;
    memset(place(area), 0xFF, area == TEDS_IDENTITY ? IDENTITY : SLOT);
    return 0;
}

static int write_flash(void *user, int area, uint32_t at, const uint8_t *octets, size_t length)
{
    (void)user;
    memcpy(place(area) + at, octets, length);
    return 0;
}

static int read_flash(void *user, int area, uint32_t at, uint8_t *out, size_t length)
{
    (void)user;
    memcpy(out, place(area) + at, length);
    return 0;
}

/* Scalars, the nonce of Request and the first counter of Open, as the vectors have them. */
static int draw(void *user, uint8_t *out, size_t length)
{
    (void)user;
    memset(out, 0, length);
    if (length == 32) {
        memcpy(out, scalar, 32);
    } else if (length == 16) {
        memcpy(out, kat->agreement->nonceN.octets, 16);
    } else if (length == 8) {
        memcpy(out, kat->session->c.octets, 8);
    }
    return 0;
}

static uint64_t now(void *user)
{
    (void)user;
    return now_ns;
}

static bool sample(void *user, uint8_t channel, uint64_t tick, uint8_t *out)
{
    (void)user;
    (void)channel;
    teds_put16(out, (uint16_t)(tick / 1000000u));
    return true;
}

static void fill(void)
{
    memcpy(config.uuid, kat->uuid.octets, 10);
    memset(flash, 0xFF, sizeof flash);
    crypto.random = draw;
    port.user = &crypto;
    port.slot_octets = SLOT;
    port.identity_octets = IDENTITY;
    port.unit = 8;
    port.erased = 0xFF;
    port.erase = erase;
    port.write = write_flash;
    port.read = read_flash;
    port.random = draw;
    port.now = now;
    port.step = 1;
    port.drift = 100;
    (void)teds_bearssl_fill(&port, &crypto);
    port.channels = channels;
    port.channel_count = 1;
    port.sample = sample;
}

/* -- counting --------------------------------------------------------------------------------------------------------------- */

static uint64_t started;

static void begin(void)
{
    image_paint();
    started = image_ticks();
}

static void end(const char *step)
{
    uint64_t ticks = image_ticks() - started;
    image_say(step);
    image_say_number(" instructions ", (uint32_t)(ticks * IMAGE_TICK_PICOSECONDS / 1000u));
    image_say(step);
    image_say_number(" stack ", image_stack_used());
}

static void demand(bool good, const char *step)
{
    if (!good) {
        image_say("wrong ");
        image_say(step);
        image_say("\n");
    }
}

static size_t handle(const char *step, const uint8_t *command, size_t length)
{
    const teds_arrival arrival = {TEDS_CAN, true, false, now_ns};
    size_t octets;
    begin();
    octets = teds_node_handle(&node, FIRST_STATION, &arrival, command, length, reply);
    if (step != NULL) {
        end(step);
    }
    teds_node_reply_left(&node, FIRST_STATION);
    return octets;
}

static void say(const char *step, teds_octets command, teds_octets due)
{
    size_t octets = handle(step, command.octets, command.length);
    demand(due.octets == NULL ? reply[0] == 1
                              : octets == due.length && memcmp(reply, due.octets, octets) == 0, step);
}

/* One command in the session of the vectors, sealed here as a station does; its reply must be good. Gives the octets of
 * the inner reply, at reply + 7. */
static size_t sealed(const char *step, const uint8_t *inner, size_t length)
{
    uint8_t nonce[13] = {0};
    size_t padding = 16 - length % 16, octets;
    memcpy(frame + 10, inner, length);
    memset(frame + 10 + length, (int)padding, padding);
    teds_put32(nonce + 9, ++counter);
    memcpy(frame, "\0\0\x80\x04", 4);
    teds_put16(frame + 4, (uint16_t)(4 + length + padding + 16));
    teds_put32(frame + 6, counter);
    (void)port.ccm_seal(port.user, kat->session->k_sn.octets, nonce, frame + 10, length + padding, frame + 10, 16);
    octets = handle(step, frame, 10 + length + padding + 16);
    demand(octets > 23 && port.ccm_open(port.user, kat->session->k_ns.octets, nonce, reply + 7, octets - 23, frame, 16) &&
               frame[0] == 1, step != NULL ? step : "a step in between");
    return octets;
}

static void write_teds(const char *step, uint8_t channel, uint8_t code, teds_octets teds)
{
    uint8_t inner[TEDS_MAX_MESSAGE];
    memcpy(inner, "\0\0\x01\x03", 4);
    inner[1] = channel;
    teds_put16(inner + 4, (uint16_t)(teds.length + 5));
    inner[6] = code;
    teds_put32(inner + 7, 0);
    memcpy(inner + 11, teds.octets, teds.length);
    (void)sealed(step, inner, 11 + teds.length);
}

/* -- the steps ---------------------------------------------------------------------------------------------------------------- */

static void agree_and_open(void)
{
    static const uint8_t identify[] = {0, 0, 128, 7, 0, 0};
    uint8_t prove[38] = {0, 0, 128, 8, 0, 32};
    scalar = kat->node->d.octets;
    begin();
    demand(teds_node_init(&node, &config, &port) == 0, "start");
    end("first-start");
    say("identify", (teds_octets){identify, sizeof identify}, (teds_octets){NULL, 0});
    memcpy(prove + 6, kat->prove->challenge.octets, 32);
    say("prove", (teds_octets){prove, sizeof prove}, (teds_octets){NULL, 0});
    scalar = kat->one_time_node->d.octets;
    begin();
    (void)teds_idle_work(&node);
    end("one-time-key");
    say("request", kat->agreement->request_frame, kat->agreement->reply_frame);
    say("confirm", kat->agreement->confirm_frame, kat->agreement->confirm_reply);
    begin();
    (void)teds_node_poll(&node, now_ns);
    end("erase");
    scalar = kat->session->En->d.octets;
    (void)teds_idle_work(&node);
    say("open-asks", kat->session->c_frame, kat->session->c_reply);
    say("open", kat->session->open_frame, kat->session->open_reply);
}

static void commit(void)
{
    static const uint8_t identify[] = {0, 0, 128, 7, 0, 0}, update[] = {0, 0, 1, 4, 0, 1, 128};
    static const uint8_t read[] = {0, 0, 1, 2, 0, 5, 128, 0, 0, 0, 0};
    (void)sealed("sealed-identify", identify, sizeof identify);
    for (size_t i = 0; i < kat->datasheet->blocks_count; i++) {
        const struct teds_kat_datasheet_blocks *block = &kat->datasheet->blocks[i];
        write_teds(NULL, (uint8_t)block->channel, (uint8_t)block->access_code, block->teds);
    }
    write_teds("write-639-octets", 0, 128, kat->datasheet->security_teds);
    (void)sealed("commit", update, sizeof update);
    (void)teds_node_poll(&node, now_ns);
    (void)sealed("read-639-octets", read, sizeof read);
}

static void measure(void)
{
    uint8_t operate[23] = {0, 0, 4, 1, 0, 17};
    static const uint8_t one[] = {0, 0, 128, 12, 0, 1, 1};
    static const uint8_t subscribe[28] = {0, 0, 128, 14, 0, 22, 0, 0, 25, 3, 0xE8, 0, 0, 0, 0, 5, 0xF5, 0xE1, 0,
                                          0, 0, 0, 0, 0, 0, 0, 0, 1};
    uint8_t hash[32];
    teds_sha256 state;
    teds_can_frame out;
    size_t frames = 0;
    port.sha256_start(port.user, &state);
    port.sha256_update(port.user, &state, kat->datasheet->security_teds.octets, kat->datasheet->security_teds.length);
    port.sha256_finish(port.user, &state, hash);
    memcpy(operate + 6, hash, 16);
    operate[22] = 60;
    (void)sealed("operate", operate, sizeof operate);
    (void)sealed("sample", one, sizeof one);
    (void)sealed("subscribe", subscribe, sizeof subscribe);
    begin(); /* 25 samples at their times, sealing, and the frames of the message */
    for (int i = 0; i < 60 && frames < 8; i++) {
        uint64_t due = teds_node_poll(&node, now_ns);
        while (teds_can_tx(&node, &out, now_ns)) {
            frames++;
            now_ns += 300000u;
        }
        now_ns = due > now_ns ? due : now_ns + 300000u;
    }
    end("data-message-of-25");
    demand(frames == 8, "data-message-of-25");
}

int main(void)
{
    fill();
    agree_and_open();
    commit();
    measure();
    return 0;
}
