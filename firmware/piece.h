// A track of pieces: each goes straight from one value to another in its time, and holds the latter from
// then on. An event is a piece that takes no time. Values are the host's own quanta.
#ifndef HEADWAY_PIECE_H
#define HEADWAY_PIECE_H

#include <stdbool.h>
#include <stdint.h>

#define PIECES 32                  // of a track that are remembered; a power of two
#define PIECES_MANY (1u << 31)     // of which none is taken any more: numbers do not wrap
#define PIECE_LONGEST_US (1 << 30) // 18 minutes
#define PIECE_TIME_MAX (1LL << 60) // no time beyond: sums and differences of a few cannot overflow

struct piece {
    int64_t start_us, end_us;
    int64_t slope_q31; // per us, rounded towards 0
    int32_t from, to;
};

// As it is sent. Where a start is left out it is the end of the piece before; where a first value is
// left out it is what the track has at the start.
struct wanted_piece {
    bool has_start, has_from;
    int64_t start_us, end_us;
    int32_t from, to;
};

struct pieces {
    uint32_t next;    // number of the piece that comes next: they count up from 0
    uint32_t current; // of the one that runs, or ran last, when it was last asked for
    struct piece ring[PIECES];
};

enum piece_result {
    PIECE_TAKEN, // or taken before
    PIECE_GAP,   // others are missing before it, or there is none to go on from
    PIECE_LATE,  // taken, but its start was past: the track goes on from where it should be
    PIECE_ORDER, // before the one before it, ends before it starts, or takes too long
    PIECE_FULL,  // would overwrite one that has not begun, or there have been too many
};

enum piece_result pieces_take(struct pieces *track, uint32_t number,
                              const struct wanted_piece *wanted, int64_t now_us);

// The value at a time, as far back as pieces are remembered; before the first one it is 0. At the end
// it is exact, on the way off by less than 2.
int32_t pieces_at(const struct pieces *track, int64_t time_us);

// The value at a past time; false, and nothing is found, before the first piece and where pieces are no
// longer remembered. Of pieces that came late it has what should have been. Six steps at most.
bool pieces_past(const struct pieces *track, int64_t time_us, int32_t *found);

// The same as pieces_at, at little cost at a time near that of the last call. The clock may have stepped back.
int32_t pieces_now(struct pieces *track, int64_t time_us);

// Whether the piece that pieces_now found last had begun at its time: there is none before the first.
bool pieces_begun(const struct pieces *track, int64_t time_us);

#endif
