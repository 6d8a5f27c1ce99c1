// The authenticated frame: version, type, session, counter, payload, tag.
//
//     byte   0        1     2..5      6..11     12..n-9   n-8..n-1
//            version  type  session   counter   payload   SipHash-2-4 tag
//
// The tag covers the direction and everything before it, so a frame cannot be reflected to its
// sender. All numbers are little-endian. On a byte stream a frame is COBS-encoded and ended by zero.
#ifndef HEADWAY_FRAME_H
#define HEADWAY_FRAME_H

#include "siphash.h"
#include <stdint.h>

#define FRAME_VERSION 1
#define FRAME_HEADER_BYTES 12
#define FRAME_TAG_BYTES 8
#define FRAME_PAYLOAD_MAX 1000
#define FRAME_MAX (FRAME_HEADER_BYTES + FRAME_PAYLOAD_MAX + FRAME_TAG_BYTES)

enum frame_direction { TO_DEVICE, TO_HOST };
enum frame_type { FRAME_SYNC = 1, FRAME_PLAN = 2, FRAME_STATUS = 3 };
enum frame_error {
    FRAME_OK,
    FRAME_BAD_LENGTH,
    FRAME_BAD_VERSION,
    FRAME_BAD_SESSION,
    FRAME_REPLAYED, // counter not above the last accepted one
    FRAME_BAD_TAG,  // line noise, a wrong key or a forgery
};

// One end of a session. Counters only go up; each end has its own direction.
struct session {
    uint8_t key[SIPHASH_KEY_BYTES];
    uint32_t number;
    uint8_t send_direction; // enum frame_direction
    uint64_t sent;          // counter of the last frame sent
    uint64_t received;      // counter of the last frame accepted
};

// Seals `frame`, whose payload is already in place, and returns the frame's size.
int32_t frame_seal(struct session *session, enum frame_type type, uint8_t *frame,
                   int32_t payload_size);

// Checks length, version, session and counter before hashing, so that junk stays cheap. Only an
// authentic frame moves the counter. The payload is frame + FRAME_HEADER_BYTES.
enum frame_error frame_open(struct session *session, const uint8_t *frame, int32_t size);

#endif
