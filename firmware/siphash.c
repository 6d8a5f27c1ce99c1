#include "siphash.h"

struct state {
    uint64_t a, b, c, d;
};

static uint64_t rotate(uint64_t x, int bits) { return x << bits | x >> (64 - bits); }

static uint64_t load64(const uint8_t *bytes) {
    uint64_t word = 0;
    for (int i = 7; i >= 0; i--)
        word = word << 8 | bytes[i];
    return word;
}

static void sip_round(struct state *s) {
    s->a += s->b;
    s->b = rotate(s->b, 13) ^ s->a;
    s->a = rotate(s->a, 32);
    s->c += s->d;
    s->d = rotate(s->d, 16) ^ s->c;
    s->a += s->d;
    s->d = rotate(s->d, 21) ^ s->a;
    s->c += s->b;
    s->b = rotate(s->b, 17) ^ s->c;
    s->c = rotate(s->c, 32);
}

static void absorb(struct state *s, uint64_t word) {
    s->d ^= word;
    sip_round(s);
    sip_round(s);
    s->a ^= word;
}

static uint32_t load32(const uint8_t *bytes) {
    return bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

// The message is the prefix and then the bytes, taken eight at a time, little-endian; the last word
// carries the length in its top byte.
uint64_t siphash24(const uint8_t key[SIPHASH_KEY_BYTES], uint8_t prefix, const uint8_t *bytes,
                   int32_t size) {
    uint64_t k0 = load64(key), k1 = load64(key + 8);
    struct state s = {k0 ^ 0x736f6d6570736575u, k1 ^ 0x646f72616e646f6du, k0 ^ 0x6c7967656e657261u,
                      k1 ^ 0x7465646279746573u};
    uint32_t before = prefix; // the first byte of the word that comes
    int32_t left = size + 1;  // of the message
    for (; left > 8; left -= 8, bytes += 8) {
        uint32_t low = before | load32(bytes) << 8, high = load32(bytes + 3);
        absorb(&s, (uint64_t)high << 32 | low);
        before = bytes[7];
    }
    uint64_t word = before;
    for (int32_t i = 1; i < left; i++)
        word |= (uint64_t)bytes[i - 1] << (8 * i);
    if (left == 8) {
        absorb(&s, word);
        word = 0;
    }
    absorb(&s, word | (uint64_t)((size + 1) & 0xff) << 56);
    s.c ^= 0xff;
    for (int i = 0; i < 4; i++)
        sip_round(&s);
    return s.a ^ s.b ^ s.c ^ s.d;
}
