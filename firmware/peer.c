#include "peer.h"
#include "frame.h" // version, types, prefixes
#include "plan.h"  // the times' bound
#include "wire.h"  // fields

#define TAG_BYTES 8

static void seal(const uint8_t key[SIPHASH_KEY_BYTES], struct writer *w) {
    write_uint(w, siphash24(key, PEER, w->bytes, w->size), TAG_BYTES);
}

static bool opens(const uint8_t key[SIPHASH_KEY_BYTES], const uint8_t *frame, int32_t size,
                  int32_t expected, enum frame_type type) {
    if (size != expected || frame[0] != FRAME_VERSION || frame[1] != type)
        return false;
    struct reader tag = {frame + size - TAG_BYTES, TAG_BYTES, 0, false};
    return read_uint(&tag, TAG_BYTES) == siphash24(key, PEER, frame, size - TAG_BYTES);
}

// Beyond it the differences of times would overflow.
static bool is_time(int64_t time_us) {
    return time_us <= PLAN_TIME_MAX && time_us >= -PLAN_TIME_MAX;
}

void peer_request_encode(const uint8_t key[SIPHASH_KEY_BYTES], uint64_t nonce,
                         uint8_t frame[PEER_REQUEST_BYTES]) {
    struct writer w = {frame, PEER_REQUEST_BYTES, 0, false};
    write_uint(&w, FRAME_VERSION, 1);
    write_uint(&w, FRAME_STAMP_REQUEST, 1);
    write_uint(&w, nonce, 8);
    seal(key, &w);
}

bool peer_request_decode(const uint8_t key[SIPHASH_KEY_BYTES], const uint8_t *frame, int32_t size,
                         uint64_t *nonce) {
    struct reader r = {frame, size, 2, false};
    if (!opens(key, frame, size, PEER_REQUEST_BYTES, FRAME_STAMP_REQUEST))
        return false;
    *nonce = read_uint(&r, 8);
    return true;
}

void peer_response_encode(const uint8_t key[SIPHASH_KEY_BYTES],
                          const struct peer_response *response,
                          uint8_t frame[PEER_RESPONSE_BYTES]) {
    struct writer w = {frame, PEER_RESPONSE_BYTES, 0, false};
    write_uint(&w, FRAME_VERSION, 1);
    write_uint(&w, FRAME_STAMP_RESPONSE, 1);
    write_uint(&w, response->nonce, 8);
    write_uint(&w, (uint64_t)response->received_us, 8);
    write_uint(&w, (uint64_t)response->sent_us, 8);
    write_uint(&w, (uint32_t)response->least_error_ns, 4);
    write_uint(&w, (uint32_t)response->most_error_ns, 4);
    write_uint(&w, response->lineage, 4);
    write_uint(&w, response->settled, 1);
    seal(key, &w);
}

bool peer_response_decode(const uint8_t key[SIPHASH_KEY_BYTES], const uint8_t *frame, int32_t size,
                          struct peer_response *response) {
    struct reader r = {frame, size, 2, false};
    if (!opens(key, frame, size, PEER_RESPONSE_BYTES, FRAME_STAMP_RESPONSE))
        return false;
    response->nonce = read_uint(&r, 8);
    response->received_us = (int64_t)read_uint(&r, 8);
    response->sent_us = (int64_t)read_uint(&r, 8);
    response->least_error_ns = (int32_t)(uint32_t)read_uint(&r, 4);
    response->most_error_ns = (int32_t)(uint32_t)read_uint(&r, 4);
    response->lineage = (uint32_t)read_uint(&r, 4);
    response->settled = read_uint(&r, 1) & 1;
    return is_time(response->received_us) && is_time(response->sent_us);
}

void peer_feed_encode(const uint8_t key[SIPHASH_KEY_BYTES], const struct peer_feed *feed,
                      uint8_t frame[PEER_FEED_BYTES]) {
    struct writer w = {frame, PEER_FEED_BYTES, 0, false};
    write_uint(&w, FRAME_VERSION, 1);
    write_uint(&w, FRAME_FEED, 1);
    write_uint(&w, feed->number, 2);
    write_uint(&w, feed->steps, 1);
    write_uint(&w, feed->count, 1);
    write_uint(&w, feed->lineage, 4);
    write_uint(&w, (uint64_t)feed->time_us, 8);
    for (int32_t i = 0; i < PEER_POINTS; i++) {
        bool used = i < feed->count;
        write_uint(&w, used ? (uint32_t)(feed->time_us - feed->points[i].time_us) : 0, 4);
        write_uint(&w, used ? (uint32_t)feed->points[i].value : 0, 4);
    }
    seal(key, &w);
}

bool peer_feed_decode(const uint8_t key[SIPHASH_KEY_BYTES], const uint8_t *frame, int32_t size,
                      struct peer_feed *feed) {
    struct reader r = {frame, size, 2, false};
    if (!opens(key, frame, size, PEER_FEED_BYTES, FRAME_FEED))
        return false;
    feed->number = (uint16_t)read_uint(&r, 2);
    feed->steps = read_uint(&r, 1) & 1;
    feed->count = (uint8_t)read_uint(&r, 1);
    feed->lineage = (uint32_t)read_uint(&r, 4);
    feed->time_us = (int64_t)read_uint(&r, 8);
    if (feed->count == 0 || feed->count > PEER_POINTS || !is_time(feed->time_us))
        return false;
    for (int32_t i = 0; i < feed->count; i++) {
        struct peer_point *point = &feed->points[i];
        point->time_us = feed->time_us - (int64_t)read_uint(&r, 4);
        point->value = (int32_t)(uint32_t)read_uint(&r, 4);
        if (i > 0 && point->time_us <= feed->points[i - 1].time_us)
            return false;
    }
    return true;
}
