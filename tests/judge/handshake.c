// Replays crc, nonce, hello-*, welcome-* and handshake: how a session begins.
#include "handshake.h"
#include "crc.h"
#include "judge.h"

static void replay_crc(void) {
    int32_t size;
    const uint8_t *message = given_bytes("message", &size);
    say_number("crc", crc_of(message, size));
}

static const uint8_t *given_key(void) {
    int32_t size;
    return given_bytes("key", &size); // 16 bytes; a sanitizer sees it if there are fewer
}

static void given_nonce(const char *name, uint8_t nonce[NONCE_BYTES]) {
    int32_t size;
    const uint8_t *bytes = given_bytes(name, &size);
    for (int32_t i = 0; i < NONCE_BYTES; i++)
        nonce[i] = bytes[i];
}

static struct nonces given_nonces(void) {
    struct nonces nonces;
    given_nonce("host", nonces.host);
    given_nonce("device", nonces.device);
    return nonces;
}

static void replay_nonce(void) {
    uint8_t nonce[NONCE_BYTES];
    nonce_of_device((uint32_t)given("boot"), (uint32_t)given("session"), given_word64("random"),
                    nonce);
    say_bytes("nonce", nonce, NONCE_BYTES);
}

static void replay_hello_encode(void) {
    uint8_t host[NONCE_BYTES];
    given_nonce("host", host);
    uint8_t *frame = room(HANDSHAKE_BYTES);
    hello_encode(host, frame);
    say_bytes("frame", frame, HANDSHAKE_BYTES);
}

static void replay_hello_decode(void) {
    int32_t size;
    const uint8_t *frame = given_bytes("frame", &size);
    uint8_t host[NONCE_BYTES];
    if (hello_decode(frame, size, host))
        say_bytes("host", host, NONCE_BYTES);
    else
        say("malformed");
}

static void replay_welcome_encode(void) {
    struct nonces nonces = given_nonces();
    uint8_t *frame = room(HANDSHAKE_BYTES);
    welcome_encode(given_key(), &nonces, frame);
    say_bytes("frame", frame, HANDSHAKE_BYTES);
}

static void replay_welcome_decode(void) {
    static const char *const verdicts[] = {"ok", "noise", "other", "version", "stale", "wrong-key"};
    int32_t size;
    const uint8_t *frame = given_bytes("frame", &size);
    struct nonces nonces = {{0}, {0}};
    given_nonce("host", nonces.host);
    say(verdicts[welcome_decode(given_key(), frame, size, &nonces)]);
    say_bytes("host", nonces.host, NONCE_BYTES);
    say_bytes("device", nonces.device, NONCE_BYTES);
}

static void replay_handshake(void) {
    struct nonces nonces = given_nonces();
    struct session session;
    handshake_session(given_key(), &nonces, is_word("at", "device") ? TO_HOST : TO_DEVICE,
                      &session);
    say_number("number", session.number);
    say_bytes("send_key", session.send_key, SIPHASH_KEY_BYTES);
    say_bytes("receive_key", session.receive_key, SIPHASH_KEY_BYTES);
}

const struct word handshake_words[] = {
    {"crc", replay_crc},
    {"nonce", replay_nonce},
    {"hello-encode", replay_hello_encode},
    {"hello-decode", replay_hello_decode},
    {"welcome-encode", replay_welcome_encode},
    {"welcome-decode", replay_welcome_decode},
    {"handshake", replay_handshake},
    {0, 0},
};
