// Replays cobs-*, siphash, session*, seal and open.
#include "cobs.h"
#include "frame.h"
#include "judge.h"

static void replay_cobs_encode(void) {
    int32_t size;
    uint8_t *packet = given_bytes("packet", &size);
    uint8_t *out = room(COBS_BOUND(size));
    say_bytes("bytes", out, cobs_encode(packet, size, out));
}

static void replay_cobs_decode(void) {
    int32_t size;
    uint8_t *bytes = given_bytes("bytes", &size);
    size = cobs_decode(bytes, size);
    if (size == -1)
        say("malformed");
    else
        say_bytes("packet", bytes, size);
}

static void replay_siphash(void) {
    int32_t size, message_size;
    const uint8_t *key = given_bytes("key", &size);
    uint8_t *message = given_bytes("message", &message_size);
    say_word64("hash", siphash24(key, (uint8_t)given("prefix"), message, message_size));
}

static struct session session;

static void replay_session_none(void) { session = (struct session){0}; }

static void replay_session(void) {
    int32_t size; // 16 bytes each; a sanitizer sees it if there are fewer
    session_begin(&session, (uint32_t)given("number"),
                  is_word("at", "device") ? TO_HOST : TO_DEVICE, given_bytes("send_key", &size),
                  given_bytes("receive_key", &size));
}

static void replay_session_counters(void) {
    session.sent = (uint64_t)given("sent");
    session.received = (uint64_t)given("received");
    session.window = given_word64("window");
}

static void say_counters(void) {
    say_number("sent", (int64_t)session.sent);
    say_number("received", (int64_t)session.received);
    say_word64("window", session.window);
}

static void replay_seal(void) {
    int32_t size;
    const uint8_t *payload = given_bytes("payload", &size);
    uint8_t *frame = room(FRAME_HEADER_BYTES + size + FRAME_TAG_BYTES);
    for (int32_t i = 0; i < size; i++)
        frame[FRAME_HEADER_BYTES + i] = payload[i];
    int32_t sealed = frame_seal(&session, (enum frame_type)given("type"), frame, size);
    if (sealed == -1)
        say("refused");
    else
        say_bytes("frame", frame, sealed);
    say_counters();
}

static void replay_open(void) {
    static const char *const errors[] = {"ok",          "bad-length", "bad-version",
                                         "bad-session", "replayed",   "bad-tag"};
    int32_t size;
    const uint8_t *frame = given_bytes("frame", &size);
    enum frame_error error = frame_open(&session, frame, size);
    say(errors[error]);
    if (error == FRAME_OK)
        say_number("counter", (int64_t)frame_counter(frame));
    say_counters();
}

const struct word codec_words[] = {
    {"cobs-encode", replay_cobs_encode},
    {"cobs-decode", replay_cobs_decode},
    {"siphash", replay_siphash},
    {"session-none", replay_session_none},
    {"session", replay_session},
    {"session-counters", replay_session_counters},
    {"seal", replay_seal},
    {"open", replay_open},
    {0, 0},
};
