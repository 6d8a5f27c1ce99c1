// How a host and a device begin a session, without a trusted source of randomness at the device.
//
//     HELLO    version u8, type u8, host's nonce, zeros, CRC-32                          46 bytes
//     WELCOME  version u8, type u8, host's nonce, device's nonce, proof u64, CRC-32      46 bytes
//
// Three steps, after AKEP2 (Bellare and Rogaway, "Entity authentication and key distribution",
// 1993). The host asks. The device answers with a nonce of its own and proves that it has the
// long-term key, by a hash over both nonces. Then both derive the session's number and a key for
// each direction, and the host's first frame with them proves the host: it has signed nothing
// before. Keys are derived by a pseudorandom function in counter mode (NIST SP 800-108), with
// SipHash-2-4 as the function, the label and counter in one byte and both nonces as the context.
//
// The device's nonce never repeats: it is made of a boot counter that is kept in memory and of the
// session's number within this boot; the ring oscillator's bits are only added. So the keys never
// repeat either, whatever the host's nonce is. What the host's nonce brings: an old WELCOME is of no
// use. The CRC needs no key, so that a wrong key can be told from line noise. Both frames are as
// long, so that nobody gets more out of a device than was put in.
//
// Both are the same in all versions of the protocol, and a HELLO of any is answered: so either end
// can say that the other's version is another one.
#ifndef HEADWAY_HANDSHAKE_H
#define HEADWAY_HANDSHAKE_H

#include "frame.h"

#define NONCE_BYTES 16
#define HANDSHAKE_BYTES 46

struct nonces {
    uint8_t host[NONCE_BYTES];
    uint8_t device[NONCE_BYTES]; // boot u32, session u32, random u64
};

enum welcome_verdict {
    WELCOME_OK,
    WELCOME_NOISE,     // damaged on the line
    WELCOME_OTHER,     // another frame
    WELCOME_VERSION,   // of a device that speaks another version
    WELCOME_STALE,     // the answer to another HELLO
    WELCOME_WRONG_KEY, // the device has another key, or somebody pretends to be a device
};

void nonce_of_device(uint32_t boot, uint32_t session, uint64_t random, uint8_t nonce[NONCE_BYTES]);

void hello_encode(const uint8_t host_nonce[NONCE_BYTES], uint8_t frame[HANDSHAKE_BYTES]);
bool hello_decode(const uint8_t *frame, int32_t size, uint8_t host_nonce[NONCE_BYTES]);

void welcome_encode(const uint8_t key[SIPHASH_KEY_BYTES], const struct nonces *nonces,
                    uint8_t frame[HANDSHAKE_BYTES]);

// Judges an answer to a HELLO with the nonce `nonces->host`; takes the device's nonce if it is good.
enum welcome_verdict welcome_decode(const uint8_t key[SIPHASH_KEY_BYTES], const uint8_t *frame,
                                    int32_t size, struct nonces *nonces);

// Begins the session that belongs to both nonces, at the end that sends in `direction`.
void handshake_session(const uint8_t key[SIPHASH_KEY_BYTES], const struct nonces *nonces,
                       enum frame_prefix direction, struct session *session);

#endif
