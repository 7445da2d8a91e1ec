/* SPDX-License-Identifier: Apache-2.0 */
/* Counts instructions of what a node computes, step by step, and the stack that it takes: under qemu -icount shift=0. */
#include "image.h"
#include "teds/node.h"
#include "teds_bearssl.h"

#include <string.h>

static teds_bearssl board;
static teds_port port;

static int draw(void *user, uint8_t *out, size_t length)
{
    static uint8_t next = 1;
    (void)user;
    for (size_t i = 0; i < length; i++) {
        out[i] = (uint8_t)(next = (uint8_t)(next * 5u + 77u));
    }
    return 0;
}

static uint64_t started;

static void begin(void)
{
    image_paint();
    started = image_ticks();
}

static void end(const char *what)
{
    uint64_t ticks = image_ticks() - started;
    image_say(what);
    image_say_number(" instructions ", (uint32_t)(ticks * IMAGE_TICK_PICOSECONDS / 1000u));
    image_say(what);
    image_say_number(" stack ", image_stack_used());
}

int main(void)
{
    static teds_key_ref key, one_time;
    static uint8_t point[65], other[65], hash[32] = {7}, signature[64], shared[32], message[80], sealed[96];
    static const uint8_t aes[16] = {1}, nonce[13] = {2};
    const teds_part part = {message, sizeof message};
    board.random = draw;
    port.user = &board;
    (void)teds_bearssl_fill(&port, &board);
    begin();
    (void)port.p256_make(port.user, TEDS_KEY_SIGNS, &key, point);
    end("make");
    (void)port.p256_make(port.user, TEDS_KEY_AGREES, &one_time, other);
    begin();
    (void)port.p256_sign(port.user, &key, hash, signature);
    end("sign");
    begin();
    if (!port.p256_verify(port.user, point, hash, signature)) {
        image_say("wrong\n");
    }
    end("verify");
    begin();
    (void)port.p256_ecdh(port.user, &one_time, point, shared);
    end("ecdh");
    begin();
    if (!port.p256_good(port.user, point)) {
        image_say("wrong\n");
    }
    end("good");
    begin();
    (void)port.ccm_seal(port.user, aes, nonce, message, 51, sealed, 8);
    end("ccm-25-samples");
    begin();
    (void)port.hmac(port.user, aes, 16, &part, 1, hash);
    end("hmac-80");
    return 0;
}
