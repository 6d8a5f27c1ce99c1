// A fuzzer's bytes, read one after the other; zeros once they are at an end.
#ifndef HEADWAY_FUZZ_SCRIPT_H
#define HEADWAY_FUZZ_SCRIPT_H

#include <stddef.h>
#include <stdint.h>

struct script {
    const uint8_t *bytes;
    size_t size, at;
};

static inline uint8_t next(struct script *script) {
    return script->at < script->size ? script->bytes[script->at++] : 0;
}

static inline int32_t next_whole(struct script *script) {
    uint32_t word = 0;
    for (int32_t i = 0; i < 4; i++)
        word = word << 8 | next(script);
    return (int32_t)word;
}

#endif
