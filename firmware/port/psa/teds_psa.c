/* SPDX-License-Identifier: Apache-2.0 */
#include "teds_psa.h"

#include <psa/crypto.h>
#include <string.h>

typedef char running_sha256_fits[sizeof(psa_hash_operation_t) <= TEDS_SHA256_OCTETS ? 1 : -1];

#define ECC PSA_KEY_TYPE_ECC_KEY_PAIR(PSA_ECC_FAMILY_SECP_R1)
#define SIGNS PSA_ALG_DETERMINISTIC_ECDSA(PSA_ALG_SHA_256)

static bool is_persistent;

static psa_key_id_t id_of(const teds_key_ref *key)
{
    return (psa_key_id_t)key->octets[0] << 24 | (psa_key_id_t)key->octets[1] << 16 | (psa_key_id_t)key->octets[2] << 8 |
           key->octets[3];
}

static void put_id(teds_key_ref *key, psa_key_id_t id)
{
    memset(key, 0, sizeof *key);
    key->octets[0] = (uint8_t)(id >> 24);
    key->octets[1] = (uint8_t)(id >> 16);
    key->octets[2] = (uint8_t)(id >> 8);
    key->octets[3] = (uint8_t)id;
}

static int draw(void *user, uint8_t *out, size_t length)
{
    (void)user;
    return psa_generate_random(out, length) == PSA_SUCCESS ? 0 : -1;
}

static void sha256_start(void *user, teds_sha256 *state)
{
    (void)user;
    memset(state, 0, sizeof *state);
    (void)psa_hash_setup((psa_hash_operation_t *)(void *)state, PSA_ALG_SHA_256);
}

static void sha256_update(void *user, teds_sha256 *state, const uint8_t *octets, size_t length)
{
    (void)user;
    (void)psa_hash_update((psa_hash_operation_t *)(void *)state, octets, length);
}

/* A hash that failed on its way is all zeros, which no signature and no digest of a datasheet is over. */
static void sha256_finish(void *user, teds_sha256 *state, uint8_t out[32])
{
    size_t length = 0;
    (void)user;
    if (psa_hash_finish((psa_hash_operation_t *)(void *)state, out, 32, &length) != PSA_SUCCESS) {
        (void)psa_hash_abort((psa_hash_operation_t *)(void *)state);
        memset(out, 0, 32);
    }
}

static psa_status_t import(const uint8_t *octets, size_t length, psa_key_type_t type, psa_algorithm_t algorithm,
                           psa_key_usage_t usage, psa_key_id_t *id)
{
    psa_key_attributes_t attributes = PSA_KEY_ATTRIBUTES_INIT;
    psa_set_key_type(&attributes, type);
    psa_set_key_algorithm(&attributes, algorithm);
    psa_set_key_usage_flags(&attributes, usage);
    return psa_import_key(&attributes, octets, length, id);
}

static int hmac(void *user, const uint8_t *key, size_t key_length, const teds_part *parts, size_t count,
                uint8_t out[32])
{
    psa_mac_operation_t state = PSA_MAC_OPERATION_INIT;
    psa_key_id_t id = 0;
    psa_status_t status;
    size_t length = 0;
    (void)user;
    status = import(key, key_length, PSA_KEY_TYPE_HMAC, PSA_ALG_HMAC(PSA_ALG_SHA_256), PSA_KEY_USAGE_SIGN_MESSAGE, &id);
    if (status == PSA_SUCCESS) {
        status = psa_mac_sign_setup(&state, id, PSA_ALG_HMAC(PSA_ALG_SHA_256));
    }
    for (size_t i = 0; i < count && status == PSA_SUCCESS; i++) {
        status = psa_mac_update(&state, parts[i].octets, parts[i].length);
    }
    if (status == PSA_SUCCESS) {
        status = psa_mac_sign_finish(&state, out, 32, &length);
    }
    (void)psa_mac_abort(&state);
    (void)psa_destroy_key(id);
    return status == PSA_SUCCESS ? 0 : -1;
}

static int p256_make(void *user, int use, teds_key_ref *key, uint8_t point[65])
{
    psa_key_attributes_t attributes = PSA_KEY_ATTRIBUTES_INIT;
    psa_key_id_t id = 0;
    size_t length = 0;
    (void)user;
    psa_set_key_type(&attributes, ECC);
    psa_set_key_bits(&attributes, 256);
    if (use == TEDS_KEY_SIGNS) {
        psa_set_key_algorithm(&attributes, SIGNS);
        psa_set_key_usage_flags(&attributes, PSA_KEY_USAGE_SIGN_HASH);
        if (is_persistent) {
            psa_set_key_id(&attributes, TEDS_PSA_KEY);
            (void)psa_destroy_key(TEDS_PSA_KEY); /* one without an identity in flash was never shown to anybody */
        }
    } else {
        psa_set_key_algorithm(&attributes, PSA_ALG_ECDH);
        psa_set_key_usage_flags(&attributes, PSA_KEY_USAGE_DERIVE);
    }
    if (psa_generate_key(&attributes, &id) != PSA_SUCCESS) {
        return -1;
    }
    if (psa_export_public_key(id, point, 65, &length) != PSA_SUCCESS || length != 65) {
        (void)psa_destroy_key(id);
        return -1;
    }
    put_id(key, id);
    return 0;
}

/* Imported as a public key, which checks that it lies on the curve. */
static bool p256_good(void *user, const uint8_t point[65])
{
    psa_key_id_t id = 0;
    psa_status_t status;
    (void)user;
    status = import(point, 65, PSA_KEY_TYPE_ECC_PUBLIC_KEY(PSA_ECC_FAMILY_SECP_R1), SIGNS, PSA_KEY_USAGE_VERIFY_HASH, &id);
    (void)psa_destroy_key(id);
    return status == PSA_SUCCESS;
}

static int p256_ecdh(void *user, const teds_key_ref *key, const uint8_t peer[65], uint8_t out[32])
{
    size_t length = 0;
    (void)user;
    return psa_raw_key_agreement(PSA_ALG_ECDH, id_of(key), peer, 65, out, 32, &length) == PSA_SUCCESS && length == 32
               ? 0
               : -1;
}

static int p256_sign(void *user, const teds_key_ref *key, const uint8_t hash[32], uint8_t out[64])
{
    size_t length = 0;
    (void)user;
    return psa_sign_hash(id_of(key), SIGNS, hash, 32, out, 64, &length) == PSA_SUCCESS && length == 64 ? 0 : -1;
}

static bool p256_verify(void *user, const uint8_t point[65], const uint8_t hash[32], const uint8_t signature[64])
{
    psa_key_id_t id = 0;
    psa_status_t status;
    (void)user;
    status = import(point, 65, PSA_KEY_TYPE_ECC_PUBLIC_KEY(PSA_ECC_FAMILY_SECP_R1), PSA_ALG_ECDSA(PSA_ALG_SHA_256),
                    PSA_KEY_USAGE_VERIFY_HASH, &id);
    if (status == PSA_SUCCESS) {
        status = psa_verify_hash(id, PSA_ALG_ECDSA(PSA_ALG_SHA_256), hash, 32, signature, 64);
    }
    (void)psa_destroy_key(id);
    return status == PSA_SUCCESS;
}

static void p256_drop(void *user, teds_key_ref *key)
{
    (void)user;
    (void)psa_destroy_key(id_of(key));
}

static int ccm_seal(void *user, const uint8_t key[16], const uint8_t nonce[13], const uint8_t *in, size_t length,
                    uint8_t *out, size_t tag_length)
{
    const psa_algorithm_t algorithm = PSA_ALG_AEAD_WITH_SHORTENED_TAG(PSA_ALG_CCM, tag_length);
    psa_key_id_t id = 0;
    psa_status_t status;
    size_t sealed = 0;
    (void)user;
    status = import(key, 16, PSA_KEY_TYPE_AES, algorithm, PSA_KEY_USAGE_ENCRYPT, &id);
    if (status == PSA_SUCCESS) {
        status = psa_aead_encrypt(id, algorithm, nonce, 13, NULL, 0, in, length, out, length + tag_length, &sealed);
    }
    (void)psa_destroy_key(id);
    return status == PSA_SUCCESS ? 0 : -1;
}

static bool ccm_open(void *user, const uint8_t key[16], const uint8_t nonce[13], const uint8_t *in, size_t length,
                     uint8_t *out, size_t tag_length)
{
    const psa_algorithm_t algorithm = PSA_ALG_AEAD_WITH_SHORTENED_TAG(PSA_ALG_CCM, tag_length);
    psa_key_id_t id = 0;
    psa_status_t status;
    size_t opened = 0;
    (void)user;
    status = import(key, 16, PSA_KEY_TYPE_AES, algorithm, PSA_KEY_USAGE_DECRYPT, &id);
    if (status == PSA_SUCCESS) {
        status = psa_aead_decrypt(id, algorithm, nonce, 13, NULL, 0, in, length + tag_length, out, length, &opened);
    }
    (void)psa_destroy_key(id);
    return status == PSA_SUCCESS;
}

int teds_psa_fill(teds_port *port, bool persistent)
{
    is_persistent = persistent;
    port->random = draw;
    port->sha256_start = sha256_start;
    port->sha256_update = sha256_update;
    port->sha256_finish = sha256_finish;
    port->hmac = hmac;
    port->p256_make = p256_make;
    port->p256_good = p256_good;
    port->p256_ecdh = p256_ecdh;
    port->p256_sign = p256_sign;
    port->p256_verify = p256_verify;
    port->p256_drop = p256_drop;
    port->ccm_seal = ccm_seal;
    port->ccm_open = ccm_open;
    return psa_crypto_init() == PSA_SUCCESS ? 0 : -1;
}
