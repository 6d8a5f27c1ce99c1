// Readings: values with their stamps in system time, kept until the host has them or the ring is full.
#ifndef HEADWAY_READING_H
#define HEADWAY_READING_H

#include <stdint.h>

#define READINGS 128        // a power of two
#define READINGS_PATIENCE 4 // tellings without an answer, then all are told again

struct reading {
    int64_t time_us;
    int32_t value;
    uint8_t trigger; // whose it is
};

struct readings {
    uint32_t taken; // ever; they are numbered from 0
    uint32_t kept;  // the first that the host may not have
    uint32_t told;  // the next to be told
    uint8_t waited; // times that some were told since it said that it has more
    struct reading ring[READINGS];
};

void readings_push(struct readings *readings, int64_t time_us, int32_t value, uint8_t trigger);

// The host has all before this number. One that cannot be says nothing.
void readings_seen(struct readings *readings, uint32_t number);

// What is to be told now, so many at most: the number of the first, and how many. What follows what was
// told last; after a while without an answer what has none.
uint32_t readings_tell(struct readings *readings, uint32_t most, uint32_t *count);

#endif
