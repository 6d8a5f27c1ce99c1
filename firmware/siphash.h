// SipHash-2-4, a keyed 64-bit hash (Aumasson and Bernstein, "SipHash: a fast short-input PRF", 2012).
#ifndef HEADWAY_SIPHASH_H
#define HEADWAY_SIPHASH_H

#include <stdint.h>

#define SIPHASH_KEY_BYTES 16

// Hash of one prefix byte followed by size bytes.
uint64_t siphash24(const uint8_t key[SIPHASH_KEY_BYTES], uint8_t prefix, const uint8_t *bytes,
                   int32_t size);

#endif
