// Fixed-point arithmetic for a core with a 32-bit multiplier and no divider (Cortex-M0+).
//
// Right shifts of negative numbers are arithmetic on every compiler we build with (gcc, clang).
#ifndef HEADWAY_FIXED_H
#define HEADWAY_FIXED_H

#include <stdint.h>

// A positive factor: value = mantissa / 2^shift, shift 0..31. Sixteen bits of mantissa keep a
// product at two 32-bit multiplications.
struct scale {
    uint16_t mantissa;
    uint8_t shift;
};

static inline int32_t fixed_clamp(int32_t value, int32_t limit) {
    return value > limit ? limit : value < -limit ? -limit : value;
}

static inline int32_t fixed_clamp64(int64_t value, int32_t limit) {
    if (value == (int32_t)value) // two words compared are many instructions
        return fixed_clamp((int32_t)value, limit);
    return value < 0 ? -limit : limit;
}

// a + b within +-limit.
static inline int32_t fixed_add(int32_t a, int32_t b, int32_t limit) {
    int32_t sum = (int32_t)((uint32_t)a + (uint32_t)b);
    if (((sum ^ a) & (sum ^ b)) < 0) // beyond 32 bits
        return a < 0 ? -limit : limit;
    return fixed_clamp(sum, limit);
}

// a - b modulo 2^32: also between positions of an axis that turns for ever.
static inline int32_t fixed_difference(int32_t a, int32_t b) {
    return (int32_t)((uint32_t)a - (uint32_t)b);
}

// a + b modulo 2^32.
static inline int32_t fixed_sum(int32_t a, int32_t b) {
    return (int32_t)((uint32_t)a + (uint32_t)b);
}

// a * b / 2^16, rounded down, b below 2^16; exact in 48 bits, never overflows.
static inline int32_t fixed_mul_q16(int32_t a, uint32_t b) {
    int32_t high = (a >> 16) * (int32_t)b;
    uint32_t low = ((uint32_t)a & 0xffffu) * b;
    return high + (int32_t)(low >> 16);
}

// a * b, exact. The core's own multiplications have 32 bits; of one with 64 the compiler makes a call.
static inline int64_t fixed_mul_u16(int32_t a, uint16_t b) {
    int32_t high = (a >> 16) * (int32_t)b;
    uint32_t low = ((uint32_t)a & 0xffffu) * b;
    return (int64_t)high * (1 << 16) + low;
}

static inline uint64_t fixed_mul_u32(uint32_t a, uint32_t b) {
    uint32_t a0 = a & 0xffffu, a1 = a >> 16, b0 = b & 0xffffu, b1 = b >> 16;
    return ((uint64_t)(a1 * b1) << 32) + ((uint64_t)(a0 * b1) << 16) + ((uint64_t)(a1 * b0) << 16) +
           a0 * b0;
}

static inline int64_t fixed_mul_i32(int32_t a, uint32_t b) {
    return fixed_mul_u16(a, (uint16_t)(b >> 16)) * (1 << 16) + fixed_mul_u16(a, (uint16_t)b);
}

// a * scale, rounded down. Saturates to +-INT32_MAX, from 2^(16 - shift) before the ends on.
static inline int32_t fixed_scale(int32_t a, struct scale scale) {
    int32_t high = (a >> 16) * (int32_t)scale.mantissa;
    uint32_t low = ((uint32_t)a & 0xffffu) * scale.mantissa;
    if (scale.shift >= 16)
        return (high + (int32_t)(low >> 16)) >> (scale.shift - 16);
    int32_t whole = high + (int32_t)(low >> 16); // the 48-bit product without its last 16 bits
    int32_t limit = INT32_MAX >> (16 - scale.shift);
    if (whole > limit - 1)
        return INT32_MAX;
    if (whole < -limit)
        return -INT32_MAX;
    return whole * (1 << (16 - scale.shift)) + (int32_t)((low & 0xffffu) >> scale.shift);
}

// Within +-2^bits.
static inline int32_t fixed_within(int32_t value, int32_t bits) {
    if ((uint32_t)(value >> bits) + 1 <= 1) // no constant is to be made
        return value;
    return value < 0 ? -(1 << bits) : 1 << bits;
}

// a * scale, rounded down, within +-2^bits, 16 <= bits <= 30.
static inline int32_t fixed_scale_any(int32_t a, struct scale scale, int32_t bits) {
    int32_t high = (a >> 16) * (int32_t)scale.mantissa;
    uint32_t low = ((uint32_t)a & 0xffffu) * scale.mantissa;
    int32_t whole = high + (int32_t)(low >> 16);
    if (scale.shift >= 16)
        return fixed_within(whole >> (scale.shift - 16), bits);
    int32_t spare = 31 - bits + 16 - scale.shift; // bits that are signs
    if ((int32_t)((uint32_t)whole << spare) >> spare != whole)
        return whole < 0 ? -(1 << bits) : 1 << bits;
    return whole * (1 << (16 - scale.shift)) + (int32_t)((low & 0xffffu) >> scale.shift);
}

// The same, called where it is not at hand: in fixed.c.
int32_t fixed_scale_within(int32_t a, struct scale scale, int32_t bits);

// The same of what is mostly within 16 bits: there one product will do.
static inline int32_t fixed_scale_small(int32_t a, struct scale scale, int32_t bits) {
    if (a != (int16_t)a)
        return fixed_scale_within(a, scale, bits);
    return fixed_within(a * (int32_t)scale.mantissa >> scale.shift, bits);
}

// The same of a scale that is mostly below 1.
static inline int32_t fixed_scale_less(int32_t a, struct scale scale, int32_t bits) {
    if (scale.shift < 16)
        return fixed_scale_within(a, scale, bits);
    return fixed_within(fixed_mul_q16(a, scale.mantissa) >> (scale.shift - 16), bits);
}

#endif
