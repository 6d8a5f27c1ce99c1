// The plain routine: the mean of the neighbours' offsets shims the own rate.
//
// An offset is remote minus local, with half the round trip taken off. Once an interval the mean of
// the offsets that came in makes the clock faster if it is behind, slower if it is ahead, by
// `phase_gain`; a second gain filters what the oscillator's own skew is found to be (J. Read,
// "Distributed Motion Systems Using Clock Synchronization and Time Encoded Trajectories", 2025).
#ifndef HEADWAY_AVERAGE_H
#define HEADWAY_AVERAGE_H

#include <stdbool.h>
#include <stdint.h>

#define AVERAGE_GAIN_BITS 8

struct average_settings {
    uint32_t interval_us;
    uint16_t phase_gain;   // rate in 2^-32 per us of offset
    uint16_t skew_gain_q8; // skew in 2^-32 per us of offset and interval
};

struct average {
    int64_t sum_us;
    int32_t count;
    int64_t began_us; // ticks
    int32_t skew_q32;
};

// An offset, remote minus local.
void average_take(struct average *average, int64_t offset_us);

// At the end of an interval: whether there is a new rate, and the rate.
bool average_rate(struct average *average, const struct average_settings *settings,
                  int64_t ticks_us, int32_t drift_q32, int32_t *rate_q32);

#endif
