// Replays group-*: the key of a machine's group, on its way to a device.
#include "group.h"
#include "judge.h"
#include <string.h>

static const uint8_t *given_key(const char *name) {
    int32_t size; // 16 bytes; a sanitizer sees it if there are fewer
    return given_bytes(name, &size);
}

static void replay_group_encode(void) {
    struct session session = {.sent = (uint64_t)given("sent")};
    struct session group = {.number = (uint32_t)given("group_number"),
                            .sent = (uint64_t)given("group_sent")};
    memcpy(session.send_key, given_key("send_key"), SIPHASH_KEY_BYTES);
    memcpy(group.send_key, given_key("group_key"), SIPHASH_KEY_BYTES);
    int32_t capacity = (int32_t)given("capacity");
    uint8_t *payload = room(capacity);
    int32_t size = group_encode(&session, &group, payload, capacity);
    if (size == -1)
        say("refused");
    else
        say_bytes("payload", payload, size);
}

static void replay_group_decode(void) {
    struct session session = {.number = (uint32_t)given("number"),
                              .send_direction = is_word("at", "device") ? TO_HOST : TO_DEVICE};
    struct session group = {0};
    memcpy(session.receive_key, given_key("receive_key"), SIPHASH_KEY_BYTES);
    int32_t size;
    const uint8_t *frame = given_bytes("frame", &size);
    if (!group_decode(&session, frame, size - FRAME_HEADER_BYTES, &group)) {
        say("malformed");
        return;
    }
    say(group.send_direction == TO_HOST ? "device" : "host");
    say_number("number", group.number);
    say_bytes("send_key", group.send_key, SIPHASH_KEY_BYTES);
    say_bytes("receive_key", group.receive_key, SIPHASH_KEY_BYTES);
    say_number("sent", (int64_t)group.sent);
    say_number("received", (int64_t)group.received);
    say_word64("window", group.window);
}

const struct word group_words[] = {
    {"group-encode", replay_group_encode},
    {"group-decode", replay_group_decode},
    {0, 0},
};
