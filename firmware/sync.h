// Synchronization: stamps in, a disciplined clock out, and how far it may be off.
//
// What stamps prove is in bounds.h. The clock is steered to the middle of the set that they leave,
// and the interval of its possible error is what is left to either side. Stamps of a neighbour that
// may itself be off prove as much less. Whoever lies about his time contradicts the set, and is
// excluded.
//
// Whose time it is: the host's, which is followed and not moved; or, of boards among themselves, that
// of the oldest. Each begins with its own time, and joins whoever is found to be further on, or has
// settled before it, while it may still step (lineage.h).
#ifndef HEADWAY_SYNC_H
#define HEADWAY_SYNC_H

#include "average.h"
#include "bounds.h"
#include "clock.h"
#include "lineage.h"
#include "stamps.h"

#define SYNC_SETTLE_US 1000000 // for so long the error is within its limit before the clock is used
#define SYNC_DRIFT_MAX_PPM 300
#define SYNC_WANDER_MAX_PPB_S 60000
#define SYNC_LIMIT_MAX_US 1000000
#define SYNC_OUTCAST 64     // samples excluded in a row: then it is us who are wrong
#define SYNC_MARK_US 200000 // for so long a mark is steered to
#define SYNC_SOURCES 5
#define SYNC_DOUBT_STEP 64        // of doubt, for a sample that was excluded; 1 less for one taken
#define SYNC_DOUBT_MAX 1024       // then that source, or what is known, is wrong
#define SYNC_ERROR_OPEN INT32_MAX // of an error: not known

enum sync_method {
    SYNC_BOUNDS,  // to the middle of what the stamps allow
    SYNC_AVERAGE, // by the mean offset and half the round trip, see average.h
    SYNC_METHODS,
};

struct sync_settings {
    uint8_t method;              // enum sync_method
    bool among_boards;           // there is no host's time to follow
    uint16_t drift_ppm;          // of the own oscillator against the other clock, at most
    uint16_t wander_ppb_s;       // change of that drift, at most, per second
    uint32_t to_device_least_us; // no frame of the host takes less time to get here ...
    uint32_t to_host_least_us;   // ... and none of ours to get there
    uint32_t limit_us;           // largest error with which the axis may move
    struct average_settings average;
};

// Where a sample is from.
struct sync_source {
    uint8_t number;                               // below SYNC_SOURCES; the host's is 0
    uint32_t to_here_least_us, to_there_least_us; // least delays
    int32_t least_error_ns, most_error_ns;        // of its clock; of the host's both are 0
    struct lineage lineage;                       // not looked at of the host's
};

struct sync {
    bool begun; // there is a base
    bool settled;
    bool doubtful;     // all that is heard contradicts what is known: nothing is, until a restart
    bool doubting;     // by what has come so far
    bool stepped;      // the first sample set the clock
    bool carried;      // nothing has been taken since sync_carry
    bool waited;       // so the last sync_compare did nothing
    int64_t wide_us;   // ticks when the error was last not known to be within the limit
    int64_t heard_us;  // ticks of the last sample that was taken
    uint32_t excluded; // samples that contradicted the set, ever
    uint32_t outcast;  // and in a row
    uint8_t heard;     // bit n: source n has been heard
    uint16_t doubt[SYNC_SOURCES]; // of each: more with each sample excluded, less with each taken
    int32_t least_error_ns, most_error_ns; // own clock minus the other one; at the ends: unknown
    uint32_t id;                           // of this board; 0: it is none among boards
    uint32_t lineage;                      // whose time it is, among boards
    bool marked;                           // there is a mark ...
    int64_t mark_us;                       // ... at these ticks ...
    int64_t mark_q16;   // ... and the middle of what all boards know of the offset then
    int64_t steered_us; // ticks
    int32_t skew_q32;   // of the own oscillator, as steering has found it
    int64_t told_us;    // ticks at which the error was what it says
    int64_t carried_us; // ticks at which the last steering began ...
    int64_t offset_q16; // ... where the clock was then ...
    int64_t behind_q16, above_q16, below_q16; // ... and what the next part found
    struct bounds bounds;
    struct average average;
};

// Forgets everything but who it is and what it has counted: the next sample begins anew.
void sync_restart(struct sync *sync);

// Stamps that arrived at a count, not later than `now_count_us`. The first ones, and among boards
// those of somebody to join, step the clock: where it may not, they are not taken. Returns whether
// they were taken.
bool sync_take(struct sync *sync, const struct sync_settings *settings, struct headway_clock *clock,
               const struct sync_source *source, const struct stamps *stamps, uint32_t arrived_us,
               uint32_t now_count_us, bool may_step);

// When the instant of a mark was, by the other clock, as far as that is known; the own counter showed
// `count_us`, some milliseconds ago at most.
struct mark sync_date(const struct sync *sync, const struct sync_settings *settings,
                      const struct headway_clock *clock, uint16_t number, uint32_t count_us);

// Takes what all boards know of a mark. False if it contradicts what is known here.
bool sync_take_mark(struct sync *sync, const struct sync_settings *settings,
                    const struct headway_clock *clock, const struct mark *mark, uint32_t count_us,
                    uint32_t now_count_us);

// To be called after each clock_advance, at least every second. Returns whether the clock stepped, now
// or by a first sample.
bool sync_steer(struct sync *sync, const struct sync_settings *settings,
                struct headway_clock *clock, bool may_step);

// The same in parts, for a device whose periods are short, which has no time for all of it in one: what
// is known, the first as sync_steer is called; how far the clock is off; then its rate; then what is
// told of its error. The clock does not step. Stamps that come after the first part make the second
// wait for the next time; if they do so again, it does both.
void sync_carry(struct sync *sync, const struct sync_settings *settings,
                const struct headway_clock *clock);
void sync_compare(struct sync *sync, const struct sync_settings *settings,
                  const struct headway_clock *clock);
void sync_lead(struct sync *sync, const struct sync_settings *settings,
               struct headway_clock *clock);
void sync_tell(struct sync *sync, const struct sync_settings *settings);

// Whether the time is its own: nobody is followed.
bool sync_is_reference(const struct sync *sync);

// The error's bound, either way, in us; SYNC_ERROR_OPEN: none.
int32_t sync_error_us(const struct sync *sync);

// The host as a source.
struct sync_source sync_host(const struct sync_settings *settings);

#endif
