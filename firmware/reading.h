// Readings: values with their stamps in system time, kept until the host has them or the ring is full.
#ifndef HEADWAY_READING_H
#define HEADWAY_READING_H

#include <stdint.h>

#define READINGS 128 // a power of two

struct reading {
    int64_t time_us;
    int32_t value;
    uint8_t trigger; // whose it is
};

struct readings {
    uint32_t taken; // ever; they are numbered from 0
    uint32_t kept;  // the first that the host may not have
    uint32_t lost;  // overwritten before it had them
    struct reading ring[READINGS];
};

void readings_push(struct readings *readings, int64_t time_us, int32_t value, uint8_t trigger);

// The host has all before this number. One that cannot be says nothing.
void readings_seen(struct readings *readings, uint32_t number);

#endif
