// Little-endian numbers and variable-length integers in a byte buffer, with bounds checked once at
// the end: an overrun sets `failed` and later calls do nothing.
#ifndef HEADWAY_WIRE_H
#define HEADWAY_WIRE_H

#include <stdbool.h>
#include <stdint.h>

struct writer {
    uint8_t *bytes;
    int32_t capacity, size;
    bool failed;
};

struct reader {
    const uint8_t *bytes;
    int32_t size, at;
    bool failed;
};

static inline void write_uint(struct writer *w, uint64_t value, int32_t bytes) {
    if (w->failed || w->capacity - w->size < bytes) {
        w->failed = true;
        return;
    }
    for (int32_t i = 0; i < bytes; i++)
        w->bytes[w->size++] = (uint8_t)(value >> (8 * i));
}

static inline uint64_t read_uint(struct reader *r, int32_t bytes) {
    if (r->failed || r->size - r->at < bytes) {
        r->failed = true;
        return 0;
    }
    uint64_t value = 0;
    for (int32_t i = 0; i < bytes; i++)
        value |= (uint64_t)r->bytes[r->at++] << (8 * i);
    return value;
}

static inline void write_bytes(struct writer *w, const uint8_t *bytes, int32_t count) {
    for (int32_t i = 0; i < count; i++)
        write_uint(w, bytes[i], 1);
}

static inline void read_bytes(struct reader *r, uint8_t *bytes, int32_t count) {
    for (int32_t i = 0; i < count; i++)
        bytes[i] = (uint8_t)read_uint(r, 1);
}

// Zigzag, seven bits a byte: small magnitudes of either sign take one byte.
static inline void write_varint(struct writer *w, int64_t value) {
    uint64_t zigzag = ((uint64_t)value << 1) ^ (uint64_t)(value >> 63);
    while (zigzag >= 0x80) {
        write_uint(w, zigzag | 0x80, 1);
        zigzag >>= 7;
    }
    write_uint(w, zigzag, 1);
}

static inline int64_t read_varint(struct reader *r) {
    // Four bytes hold nearly all there are: a small core counts each instruction on 64 bits.
    uint32_t low = 0;
    for (int32_t shift = 0; shift < 28; shift += 7) {
        uint32_t byte = (uint32_t)read_uint(r, 1);
        low |= (byte & 0x7f) << shift;
        if (byte < 0x80)
            return (int32_t)(low >> 1) ^ -(int32_t)(low & 1);
    }
    uint64_t zigzag = low;
    for (int32_t shift = 28; shift < 64; shift += 7) {
        uint64_t byte = read_uint(r, 1);
        zigzag |= (byte & 0x7f) << shift;
        if (byte < 0x80)
            return (int64_t)(zigzag >> 1) ^ -(int64_t)(zigzag & 1);
    }
    r->failed = true;
    return 0;
}

#endif
