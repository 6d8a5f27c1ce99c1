// Visits the fields of a struct in one order, to write them to bytes or to read them back: since one
// function names them for both, what is read is what was written.
#ifndef HEADWAY_FIELDS_H
#define HEADWAY_FIELDS_H

#include "fixed.h" // scales
#include "wire.h"  // little-endian numbers

struct fields {
    struct writer out;
    struct reader in;
    bool reading;
    bool failed; // while reading: a value that no field of its kind can have
};

static inline uint64_t field(struct fields *f, uint64_t value, int32_t bytes) {
    if (f->reading)
        return read_uint(&f->in, bytes);
    write_uint(&f->out, value, bytes);
    return value;
}

static inline void field_u8(struct fields *f, uint8_t *value) {
    *value = (uint8_t)field(f, *value, 1);
}

static inline void field_u16(struct fields *f, uint16_t *value) {
    *value = (uint16_t)field(f, *value, 2);
}

static inline void field_u32(struct fields *f, uint32_t *value) {
    *value = (uint32_t)field(f, *value, 4);
}

static inline void field_i32(struct fields *f, int32_t *value) {
    *value = (int32_t)(uint32_t)field(f, (uint32_t)*value, 4);
}

static inline void field_varint(struct fields *f, int64_t *value) {
    if (f->reading)
        *value = read_varint(&f->in);
    else
        write_varint(&f->out, *value);
}

static inline void field_bool(struct fields *f, bool *value) {
    uint64_t number = field(f, !f->reading && *value, 1); // what is read over may be no bool yet
    f->failed |= number > 1;
    *value = number == 1;
}

static inline void field_scale(struct fields *f, struct scale *value) {
    field_u16(f, &value->mantissa);
    field_u8(f, &value->shift);
}

static inline void field_bytes(struct fields *f, uint8_t *bytes, int32_t count) {
    for (int32_t i = 0; i < count; i++)
        field_u8(f, &bytes[i]);
}

#endif
