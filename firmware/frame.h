// The authenticated frame: version, type, session, counter, payload, tag.
//
//     byte   0        1     2..5      6..11     12..n-9   n-8..n-1
//            version  type  session   counter   payload   SipHash-2-4 tag
//
// The tag covers the direction and everything before it, and each direction has a key of its own, so
// a frame cannot be reflected to its sender. All numbers are little-endian. On a byte stream a frame
// is COBS-encoded and ended by zero. HELLO and WELCOME are made otherwise (handshake.h),
// and what neighbours say to each other (peer.h).
#ifndef HEADWAY_FRAME_H
#define HEADWAY_FRAME_H

#include "siphash.h"
#include <stdbool.h>
#include <stdint.h>

#define FRAME_VERSION 1
#define FRAME_HEADER_BYTES 12
#define FRAME_TAG_BYTES 8
#define FRAME_PAYLOAD_MAX 1000
#define FRAME_MAX (FRAME_HEADER_BYTES + FRAME_PAYLOAD_MAX + FRAME_TAG_BYTES)
#define FRAME_COUNTER_MAX ((1ULL << 48) - 1)
#define FRAME_WINDOW 64 // counters: a frame that so many have overtaken is too old

enum frame_type {
    FRAME_SYNC = 1,
    FRAME_PLAN,
    FRAME_STATUS,
    FRAME_COMMAND,
    FRAME_FAULTS, // the fault log, on demand
    FRAME_HELLO,
    FRAME_WELCOME,
    FRAME_GROUP,    // the key of a machine's group, see group.h
    FRAME_SETTINGS, // from the host: new ones, or none to ask; from the device: its own, its firmware
    FRAME_STAMP_REQUEST,  // between neighbours, see peer.h
    FRAME_STAMP_RESPONSE, //
    FRAME_SIGNALS,        // pieces for tracks, see batch.h
    FRAME_LOGIC,          // what to do with them, see logic.h
    FRAME_READINGS,       // what was sampled, see report.h
    FRAME_FEED,           // between neighbours: points of a value, see peer.h
};
enum frame_error {
    FRAME_OK,
    FRAME_BAD_LENGTH,
    FRAME_BAD_VERSION,
    FRAME_BAD_SESSION,
    FRAME_REPLAYED, // accepted before, or too old to tell
    FRAME_BAD_TAG,  // line noise, a wrong key or a forgery
};

// What a session key hashes begins with one of these: no hash can stand for another kind's.
enum frame_prefix { TO_DEVICE, TO_HOST, GROUP_PAD_LOW, GROUP_PAD_HIGH, PEER };

// One end of a session. Counters only go up, and never again from the start.
struct session {
    bool begun;             // else it seals and opens nothing
    uint8_t send_direction; // TO_DEVICE or TO_HOST
    uint8_t send_key[SIPHASH_KEY_BYTES], receive_key[SIPHASH_KEY_BYTES];
    uint32_t number;
    uint64_t sent;     // counter of the last frame sent
    uint64_t received; // highest counter accepted
    uint64_t window;   // bit i: the counter `received` - i is not to be accepted again
};

void session_begin(struct session *session, uint32_t number, enum frame_prefix send_direction,
                   const uint8_t send_key[SIPHASH_KEY_BYTES],
                   const uint8_t receive_key[SIPHASH_KEY_BYTES]);

// Seals `frame`, whose payload is already in place, and returns the frame's size. Returns -1 if the
// session has not begun, or has used up its counters.
int32_t frame_seal(struct session *session, enum frame_type type, uint8_t *frame,
                   int32_t payload_size);

// Whether a frame's header may be that of one to accept: what frame_open checks before it hashes.
enum frame_error frame_screen(const struct session *session, const uint8_t *frame);

// Checks length, version, session and counter before hashing, so that junk stays cheap. Only an
// authentic frame moves the window. The payload is frame + FRAME_HEADER_BYTES.
enum frame_error frame_open(struct session *session, const uint8_t *frame, int32_t size);

// The counter of a frame that was opened.
uint64_t frame_counter(const uint8_t *frame);

#endif
