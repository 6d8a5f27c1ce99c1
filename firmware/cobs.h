// Consistent overhead byte stuffing (Cheshire and Baker, 1999): packets without a zero byte, so that
// zero can end each packet on a byte stream.
#ifndef HEADWAY_COBS_H
#define HEADWAY_COBS_H

#include <stdint.h>

// Bytes that cobs_encode may write for a packet of `size` bytes, without the ending zero.
#define COBS_BOUND(size) ((size) + (size) / 254 + 1)

// Returns the encoded size. `out` holds COBS_BOUND(size) bytes.
int32_t cobs_encode(const uint8_t *packet, int32_t size, uint8_t *out);

// Decodes in place. Returns the packet's size, or -1 if the bytes are no encoded packet.
int32_t cobs_decode(uint8_t *bytes, int32_t size);

#endif
