// Whose time boards keep that have no host's: each begins with its own, and one prevails.
//
// A time that a group has settled on is never left for one that has not: newcomers join. Among those
// that have not settled the oldest wins; where none is provably older, the higher number, so that
// two never differ on who that is.
#ifndef HEADWAY_LINEAGE_H
#define HEADWAY_LINEAGE_H

#include <stdbool.h>
#include <stdint.h>

struct lineage {
    uint32_t id; // drawn by the board whose time it is; 0: none
    bool settled;
};

// Whether to leave the own time for another one, of which it is proven that it is ahead of the own
// by at least `ahead_least_us` and at most `ahead_most_us`.
bool lineage_joins(struct lineage own, struct lineage other, int64_t ahead_least_us,
                   int64_t ahead_most_us);

#endif
