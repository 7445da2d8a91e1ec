/* SPDX-License-Identifier: Apache-2.0 */
#include "teds_bearssl.h"

#include <bearssl.h>
#include <string.h>

/* TEDS_BEARSSL_M15: for cores whose multiplication gives 32 bits alone (Cortex-M0, M0+). */
#if defined(TEDS_BEARSSL_M15)
#define EC (&br_ec_p256_m15)
#define SIGN br_ecdsa_i15_sign_raw
#define VERIFY br_ecdsa_i15_vrfy_raw
#else
#define EC (&br_ec_p256_m31)
#define SIGN br_ecdsa_i31_sign_raw
#define VERIFY br_ecdsa_i31_vrfy_raw
#endif

#if defined(__SIZEOF_INT128__)
typedef br_aes_ct64_ctrcbc_keys aes_keys;
#define AES_INIT br_aes_ct64_ctrcbc_init
#else
typedef br_aes_ct_ctrcbc_keys aes_keys;
#define AES_INIT br_aes_ct_ctrcbc_init
#endif

typedef char running_sha256_fits[sizeof(br_sha256_context) <= TEDS_SHA256_OCTETS ? 1 : -1];

static void wipe(void *octets, size_t length)
{
    volatile uint8_t *at = octets;
    while (length-- > 0) {
        *at++ = 0;
    }
}

static void sha256_start(void *user, teds_sha256 *state)
{
    (void)user;
    br_sha256_init((br_sha256_context *)(void *)state);
}

static void sha256_update(void *user, teds_sha256 *state, const uint8_t *octets, size_t length)
{
    (void)user;
    br_sha256_update((br_sha256_context *)(void *)state, octets, length);
}

static void sha256_finish(void *user, teds_sha256 *state, uint8_t out[32])
{
    (void)user;
    br_sha256_out((br_sha256_context *)(void *)state, out);
}

static int hmac(void *user, const uint8_t *key, size_t key_length, const teds_part *parts, size_t count,
                uint8_t out[32])
{
    br_hmac_key_context keyed;
    br_hmac_context state;
    (void)user;
    br_hmac_key_init(&keyed, &br_sha256_vtable, key, key_length);
    br_hmac_init(&state, &keyed, 0);
    for (size_t i = 0; i < count; i++) {
        br_hmac_update(&state, parts[i].octets, parts[i].length);
    }
    br_hmac_out(&state, out);
    wipe(&keyed, sizeof keyed);
    wipe(&state, sizeof state);
    return 0;
}

/* A scalar between 1 and the group order - 1, drawn until it is one. */
static int p256_make(void *user, int use, teds_key_ref *key, uint8_t point[65])
{
    const teds_bearssl *own = user;
    static const uint8_t high[4] = {0xFF, 0xFF, 0xFF, 0xFF};
    (void)use;
    for (int tries = 0; tries < 16; tries++) {
        uint8_t any = 0;
        if (own->random(user, key->octets, 32) != 0) {
            return -1;
        }
        for (size_t i = 0; i < 32; i++) {
            any |= key->octets[i];
        }
        /* All that begin with FFFFFFFF are left out: one in 2^32, and most of those are below the order all the same. */
        if (any != 0 && memcmp(key->octets, high, 4) != 0) {
            return EC->mulgen(point, key->octets, 32, BR_EC_secp256r1) == 65 ? 0 : -1;
        }
    }
    return -1;
}

/* A point is decoded strictly before it is multiplied; by 1, that costs little. */
static bool p256_good(void *user, const uint8_t point[65])
{
    static const uint8_t one = 1;
    uint8_t copy[65];
    (void)user;
    memcpy(copy, point, 65);
    return copy[0] == 4 && EC->mul(copy, 65, &one, 1, BR_EC_secp256r1) == 1;
}

static int p256_ecdh(void *user, const teds_key_ref *key, const uint8_t peer[65], uint8_t out[32])
{
    uint8_t product[65];
    uint32_t good;
    (void)user;
    memcpy(product, peer, 65);
    good = EC->mul(product, 65, key->octets, 32, BR_EC_secp256r1);
    memcpy(out, product + 1, 32);
    wipe(product, sizeof product);
    return good == 1 ? 0 : -1;
}

static int p256_sign(void *user, const teds_key_ref *key, const uint8_t hash[32], uint8_t out[64])
{
    uint8_t scalar[32];
    br_ec_private_key own = {BR_EC_secp256r1, scalar, sizeof scalar};
    size_t length;
    (void)user;
    memcpy(scalar, key->octets, 32);
    length = SIGN(EC, &br_sha256_vtable, hash, &own, out);
    wipe(scalar, sizeof scalar);
    return length == 64 ? 0 : -1;
}

static bool p256_verify(void *user, const uint8_t point[65], const uint8_t hash[32], const uint8_t signature[64])
{
    uint8_t copy[65];
    br_ec_public_key key = {BR_EC_secp256r1, copy, sizeof copy};
    (void)user;
    memcpy(copy, point, 65);
    return VERIFY(EC, hash, 32, &key, signature, 64) == 1;
}

static void ccm_start(br_ccm_context *state, aes_keys *aes, const uint8_t key[16], const uint8_t nonce[13],
                      size_t length, size_t tag_length)
{
    AES_INIT(aes, key, 16);
    br_ccm_init(state, &aes->vtable);
    br_ccm_reset(state, nonce, 13, 0, length, tag_length);
    br_ccm_flip(state);
}

static int ccm_seal(void *user, const uint8_t key[16], const uint8_t nonce[13], const uint8_t *in, size_t length,
                    uint8_t *out, size_t tag_length)
{
    br_ccm_context state;
    aes_keys aes;
    (void)user;
    ccm_start(&state, &aes, key, nonce, length, tag_length);
    memmove(out, in, length);
    br_ccm_run(&state, 1, out, length);
    br_ccm_get_tag(&state, out + length);
    wipe(&aes, sizeof aes);
    wipe(&state, sizeof state);
    return 0;
}

static bool ccm_open(void *user, const uint8_t key[16], const uint8_t nonce[13], const uint8_t *in, size_t length,
                     uint8_t *out, size_t tag_length)
{
    br_ccm_context state;
    aes_keys aes;
    bool good;
    (void)user;
    ccm_start(&state, &aes, key, nonce, length, tag_length);
    memcpy(out, in, length);
    br_ccm_run(&state, 0, out, length);
    good = br_ccm_check_tag(&state, in + length) == 1;
    wipe(&aes, sizeof aes);
    wipe(&state, sizeof state);
    return good;
}

int teds_bearssl_fill(teds_port *port, const teds_bearssl *context)
{
    if (context == NULL || port->user != context || context->random == NULL) {
        return -1; /* p256_make would call whatever `user` begins with */
    }
    port->sha256_start = sha256_start;
    port->sha256_update = sha256_update;
    port->sha256_finish = sha256_finish;
    port->hmac = hmac;
    port->p256_make = p256_make;
    port->p256_good = p256_good;
    port->p256_ecdh = p256_ecdh;
    port->p256_sign = p256_sign;
    port->p256_verify = p256_verify;
    port->p256_drop = NULL;
    port->ccm_seal = ccm_seal;
    port->ccm_open = ccm_open;
    return 0;
}
