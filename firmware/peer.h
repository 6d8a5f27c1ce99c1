// What neighbours say to each other: a board asks the ones beside it for their time, and gives values.
//
//     STAMP_REQUEST   version u8, type u8, nonce u64, tag u64                               18 bytes
//     STAMP_RESPONSE  version u8, type u8, nonce u64, received_us i64, sent_us i64,
//                     least_error_ns i32, most_error_ns i32, lineage u32, flags u8, tag u64  47 bytes
//     FEED            version u8, type u8, number u16, flags u8 (1: steps), count u8, lineage u32,
//                     time_us i64, six points of each before_us u32, value i32; tag u64      74 bytes
//
// There is no session: the boards of a machine share a key of their own for this, which comes by the
// programmer, and a response counts only with the nonce of the last request. So nothing that was said
// before can be said again, and a request that is repeated brings no more than an answer. The tag is
// SipHash-2-4 over all before it.
#ifndef HEADWAY_PEER_H
#define HEADWAY_PEER_H

#include "siphash.h"
#include <stdbool.h>
#include <stdint.h>

#define PEER_REQUEST_BYTES 18
#define PEER_RESPONSE_BYTES 47
#define PEER_FEED_BYTES 74
#define PEER_POINTS 6 // of a feed, in a frame

struct peer_response {
    uint64_t nonce;                        // of the request
    int64_t received_us, sent_us;          // its arrival, rounded up, and the answer's departure
    int32_t least_error_ns, most_error_ns; // system time minus the reference lies between them
    uint32_t lineage;                      // whose time it is, where no host says it
    bool settled;
};

// Points of a value, later and later, the last one not after `time_us`: up to then all is known.
struct peer_point {
    int64_t time_us;
    int32_t value;
};

struct peer_feed {
    uint16_t number;  // of the feed, among all of a machine
    bool steps;       // each point's value holds until the next; else straight lines lead there
    uint8_t count;    // of the points, from 1 on
    uint32_t lineage; // whose time it is, where no host says it; else 0
    int64_t time_us;
    struct peer_point points[PEER_POINTS];
};

void peer_request_encode(const uint8_t key[SIPHASH_KEY_BYTES], uint64_t nonce,
                         uint8_t frame[PEER_REQUEST_BYTES]);
bool peer_request_decode(const uint8_t key[SIPHASH_KEY_BYTES], const uint8_t *frame, int32_t size,
                         uint64_t *nonce);

void peer_response_encode(const uint8_t key[SIPHASH_KEY_BYTES],
                          const struct peer_response *response, uint8_t frame[PEER_RESPONSE_BYTES]);
bool peer_response_decode(const uint8_t key[SIPHASH_KEY_BYTES], const uint8_t *frame, int32_t size,
                          struct peer_response *response);

void peer_feed_encode(const uint8_t key[SIPHASH_KEY_BYTES], const struct peer_feed *feed,
                      uint8_t frame[PEER_FEED_BYTES]);
bool peer_feed_decode(const uint8_t key[SIPHASH_KEY_BYTES], const uint8_t *frame, int32_t size,
                      struct peer_feed *feed);

#endif
