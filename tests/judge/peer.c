// Replays peer-*, lineage and marks*: what boards say to each other, and see at once.
#include "peer.h"
#include "judge.h"
#include "lineage.h"
#include "mark.h"

static const uint8_t *given_key(void) {
    int32_t size; // 16 bytes; a sanitizer sees it if there are fewer
    return given_bytes("key", &size);
}

static void replay_request_encode(void) {
    uint8_t *frame = room(PEER_REQUEST_BYTES);
    peer_request_encode(given_key(), given_word64("nonce"), frame);
    say_bytes("frame", frame, PEER_REQUEST_BYTES);
}

static void replay_request_decode(void) {
    int32_t size;
    const uint8_t *frame = given_bytes("frame", &size);
    uint64_t nonce;
    if (peer_request_decode(given_key(), frame, size, &nonce))
        say_word64("nonce", nonce);
    else
        say("refused");
}

static void replay_response_encode(void) {
    struct peer_response response = {
        .nonce = given_word64("nonce"),
        .received_us = given("received_us"),
        .sent_us = given("sent_us"),
        .least_error_ns = (int32_t)given("least_error_ns"),
        .most_error_ns = (int32_t)given("most_error_ns"),
        .lineage = (uint32_t)given("lineage"),
        .settled = given("settled") != 0,
    };
    uint8_t *frame = room(PEER_RESPONSE_BYTES);
    peer_response_encode(given_key(), &response, frame);
    say_bytes("frame", frame, PEER_RESPONSE_BYTES);
}

static void replay_response_decode(void) {
    int32_t size;
    const uint8_t *frame = given_bytes("frame", &size);
    struct peer_response response;
    if (!peer_response_decode(given_key(), frame, size, &response)) {
        say("refused");
        return;
    }
    say_word64("nonce", response.nonce);
    say_number("received_us", response.received_us);
    say_number("sent_us", response.sent_us);
    say_number("least_error_ns", response.least_error_ns);
    say_number("most_error_ns", response.most_error_ns);
    say_number("lineage", response.lineage);
    say_number("settled", response.settled);
}

// Points: when and what, one after the other.
static void replay_feed_encode(void) {
    int32_t numbers[2 * PEER_POINTS];
    struct peer_feed feed = {.number = (uint16_t)given("number"),
                             .steps = given("steps") != 0,
                             .lineage = (uint32_t)given("lineage"),
                             .time_us = given("time_us")};
    feed.count = (uint8_t)(given_list("points", numbers, 2 * PEER_POINTS) / 2);
    for (int32_t i = 0; i < feed.count; i++)
        feed.points[i] =
            (struct peer_point){feed.time_us - (uint32_t)numbers[2 * i], numbers[2 * i + 1]};
    uint8_t *frame = room(PEER_FEED_BYTES);
    peer_feed_encode(given_key(), &feed, frame);
    say_bytes("frame", frame, PEER_FEED_BYTES);
}

static void replay_feed_decode(void) {
    int32_t size;
    const uint8_t *frame = given_bytes("frame", &size);
    struct peer_feed feed;
    if (!peer_feed_decode(given_key(), frame, size, &feed)) {
        say("refused");
        return;
    }
    say_number("number", feed.number);
    say_number("steps", feed.steps);
    say_number("lineage", feed.lineage);
    say_number("time_us", feed.time_us);
    for (int32_t i = 0; i < feed.count; i++) {
        say_number("at_us", feed.points[i].time_us);
        say_number("value", feed.points[i].value);
    }
}

static void replay_lineage(void) {
    struct lineage own = {(uint32_t)given("own"), given("own_settled") != 0};
    struct lineage other = {(uint32_t)given("other"), given("other_settled") != 0};
    bool joins = lineage_joins(own, other, given("ahead_least_us"), given("ahead_most_us"));
    say(joins ? "joins" : "stays");
}

static struct marks marks;

static void replay_marks(void) { marks = (struct marks){0}; }

static void replay_marks_note(void) {
    bool noted = marks_note(&marks, (uint16_t)given("mark_number"), (uint32_t)given("count_us"));
    say(noted ? "noted" : "passed");
}

static void replay_marks_find(void) {
    uint32_t count_us;
    if (marks_find(&marks, (uint16_t)given("mark_number"), &count_us))
        say_number("count_us", count_us);
    else
        say("none");
}

const struct word peer_words[] = {
    {"peer-request-encode", replay_request_encode},
    {"peer-request-decode", replay_request_decode},
    {"peer-response-encode", replay_response_encode},
    {"peer-response-decode", replay_response_decode},
    {"peer-feed-encode", replay_feed_encode},
    {"peer-feed-decode", replay_feed_decode},
    {"lineage", replay_lineage},
    {"marks", replay_marks},
    {"marks-note", replay_marks_note},
    {"marks-find", replay_marks_find},
    {0, 0},
};
