// Signals: all that a device does in time beside its axis. Tracks of pieces come in; logic makes more of
// them; outputs follow, and readings are taken when triggers say so.
#ifndef HEADWAY_SIGNALS_H
#define HEADWAY_SIGNALS_H

#include "batch.h"
#include "clock.h"
#include "feed.h"
#include "report.h"
#include "track.h"

#define SIGNALS_READ_PAST 31 // bit of `reads`: a node reads a track's past
#define SIGNALS_AHEAD 5 // servo periods of changes that the board is told ahead: so late one may be

// What every servo period touches comes first: a small core reaches 32 bytes at no cost.
struct signals {
    bool used;                     // some have come
    bool ruled;                    // there is a logic
    bool by_nodes;                 // of which only nodes drive outputs, digital ones ...
    bool steady;                   // ... and these have been told since the last change
    bool stepped;                  // values are of the logic at hand, and no feed has had them
    uint8_t on;                    // bit i: digital output i, as the board was told last ...
    uint8_t ahead;                 // ... bit i: with a count that was yet to come
    uint8_t placed;                // bit i: told[i] is right
    uint8_t pwm_off;               // bit i: the board was told 0 for PWM output i
    uint8_t digitals, pwms;        // bit i: something drives output i
    uint8_t met;                   // bit i: the condition of trigger i was true
    uint8_t result, wrong;         // of the logic that came last: what was wrong with it
    uint16_t begun;                // bit i: there are pieces of track i
    uint16_t wait[LOGIC_TRIGGERS]; // periods until its next reading
    uint32_t asked;                // number of the logic that came last
    uint32_t reads;                // bit i: the logic reads source i, a track or an input, now
    uint32_t refused;              // pieces, ever
    uint32_t late;                 // of those that were taken
    uint32_t told[BOARD_DIGITAL];  // the piece of its track that output i is told of next
    struct graph graph;
    int32_t values[GRAPH_VALUES]; // of the last period
    struct logic logic;           // that holds
    struct pieces tracks[REPORT_TRACKS];
    struct readings readings;
    struct feeds feeds;
};

// Pieces are taken one by one: one that is refused is missing, and so those after it in its track. One
// that is late is taken, and counted. A track that comes from another board takes none of the host's.
void signals_take(struct signals *signals, const struct batch *batch, int64_t now_us);

// What another board gives, for the tracks that the logic has from there. False for what is not about now.
bool signals_feed(struct signals *signals, const struct peer_feed *frame, int64_t now_us);

// As a whole or not at all; the same number again changes nothing. A track that gets another producer
// begins anew.
void signals_rule(struct signals *signals, const struct logic *logic, int32_t knot_shift);

// What is to be told now; it counts as told.
void signals_report(struct signals *signals, struct report *report);

// Values of nodes that read the past of tracks: those of motion, which are given, and those of pieces.
void signals_recall(struct signals *signals, const struct track *tracks, int64_t time_us,
                    int32_t knot_shift);

// One servo period at the clock's time. `values` has what is read of tracks of motion and inputs. While
// it is not `live`, all outputs are off.
void signals_step(struct signals *signals, struct board *board, const struct headway_clock *clock,
                  uint16_t period_us, bool live);

// Nothing has come, and the board knows that all outputs are off: there is nothing to do.
bool signals_idle(const struct signals *signals);

// Forgets all but where the outputs are: another host counts from the start.
void signals_restart(struct signals *signals);

#endif
