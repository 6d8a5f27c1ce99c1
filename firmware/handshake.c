#include "handshake.h"
#include "crc.h"
#include "wire.h" // fields
#include <string.h>

// What the long-term key is used for: the first byte of what is hashed, before both nonces.
enum label {
    LABEL_PROOF = 1,
    LABEL_NUMBER,
    LABEL_TO_DEVICE_LOW,
    LABEL_TO_DEVICE_HIGH,
    LABEL_TO_HOST_LOW,
    LABEL_TO_HOST_HIGH,
};

static uint64_t derive(const uint8_t key[SIPHASH_KEY_BYTES], enum label label,
                       const struct nonces *nonces) {
    uint8_t context[2 * NONCE_BYTES];
    memcpy(context, nonces->host, NONCE_BYTES);
    memcpy(context + NONCE_BYTES, nonces->device, NONCE_BYTES);
    return siphash24(key, (uint8_t)label, context, sizeof context);
}

static void derive_key(const uint8_t key[SIPHASH_KEY_BYTES], enum label low, enum label high,
                       const struct nonces *nonces, uint8_t derived[SIPHASH_KEY_BYTES]) {
    struct writer w = {derived, SIPHASH_KEY_BYTES, 0, false};
    write_uint(&w, derive(key, low, nonces), 8);
    write_uint(&w, derive(key, high, nonces), 8);
}

static void finish(struct writer *w) {
    while (w->size < HANDSHAKE_BYTES - CRC_BYTES)
        write_uint(w, 0, 1);
    write_uint(w, crc_of(w->bytes, w->size), CRC_BYTES);
}

static bool whole(const uint8_t *frame, int32_t size) {
    if (size != HANDSHAKE_BYTES)
        return false;
    struct reader crc = {frame + size - CRC_BYTES, CRC_BYTES, 0, false};
    return read_uint(&crc, CRC_BYTES) == crc_of(frame, size - CRC_BYTES);
}

void nonce_of_device(uint32_t boot, uint32_t session, uint64_t random, uint8_t nonce[NONCE_BYTES]) {
    struct writer w = {nonce, NONCE_BYTES, 0, false};
    write_uint(&w, boot, 4);
    write_uint(&w, session, 4);
    write_uint(&w, random, 8);
}

void hello_encode(const uint8_t host_nonce[NONCE_BYTES], uint8_t frame[HANDSHAKE_BYTES]) {
    struct writer w = {frame, HANDSHAKE_BYTES, 0, false};
    write_uint(&w, FRAME_VERSION, 1);
    write_uint(&w, FRAME_HELLO, 1);
    write_bytes(&w, host_nonce, NONCE_BYTES);
    finish(&w);
}

bool hello_decode(const uint8_t *frame, int32_t size, uint8_t host_nonce[NONCE_BYTES]) {
    if (!whole(frame, size) || frame[1] != FRAME_HELLO) // of any version: the answer tells ours
        return false;
    memcpy(host_nonce, frame + 2, NONCE_BYTES);
    return true;
}

void welcome_encode(const uint8_t key[SIPHASH_KEY_BYTES], const struct nonces *nonces,
                    uint8_t frame[HANDSHAKE_BYTES]) {
    struct writer w = {frame, HANDSHAKE_BYTES, 0, false};
    write_uint(&w, FRAME_VERSION, 1);
    write_uint(&w, FRAME_WELCOME, 1);
    write_bytes(&w, nonces->host, NONCE_BYTES);
    write_bytes(&w, nonces->device, NONCE_BYTES);
    write_uint(&w, derive(key, LABEL_PROOF, nonces), 8);
    finish(&w);
}

enum welcome_verdict welcome_decode(const uint8_t key[SIPHASH_KEY_BYTES], const uint8_t *frame,
                                    int32_t size, struct nonces *nonces) {
    if (!whole(frame, size)) {
        bool damaged = size == HANDSHAKE_BYTES || size < 2 || frame[1] == FRAME_WELCOME;
        return damaged ? WELCOME_NOISE : WELCOME_OTHER;
    }
    if (frame[0] != FRAME_VERSION)
        return WELCOME_VERSION;
    if (frame[1] != FRAME_WELCOME)
        return WELCOME_OTHER;
    if (memcmp(frame + 2, nonces->host, NONCE_BYTES) != 0)
        return WELCOME_STALE;
    struct nonces both = *nonces;
    memcpy(both.device, frame + 2 + NONCE_BYTES, NONCE_BYTES);
    struct reader proof = {frame + 2 + 2 * NONCE_BYTES, 8, 0, false};
    if (read_uint(&proof, 8) != derive(key, LABEL_PROOF, &both))
        return WELCOME_WRONG_KEY;
    *nonces = both;
    return WELCOME_OK;
}

void handshake_session(const uint8_t key[SIPHASH_KEY_BYTES], const struct nonces *nonces,
                       enum frame_prefix direction, struct session *session) {
    uint8_t to_device[SIPHASH_KEY_BYTES], to_host[SIPHASH_KEY_BYTES];
    derive_key(key, LABEL_TO_DEVICE_LOW, LABEL_TO_DEVICE_HIGH, nonces, to_device);
    derive_key(key, LABEL_TO_HOST_LOW, LABEL_TO_HOST_HIGH, nonces, to_host);
    uint32_t number = (uint32_t)derive(key, LABEL_NUMBER, nonces);
    bool at_device = direction == TO_HOST;
    session_begin(session, number, direction, at_device ? to_host : to_device,
                  at_device ? to_device : to_host);
}
