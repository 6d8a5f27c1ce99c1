// Feeds: values that a device gives the boards beside it, and tracks of pieces that it has from them.
//
// Now and then a feed takes a point of its source, stamped in system time, and gives the last few of them
// in a frame of its own (peer.h). Each says what the source had then, to hold a while later: that much a
// frame may take. Who takes a feed makes pieces of its points: straight ones from each to the next, or
// steps. So one frame that is lost costs nothing, and more than a frame has points for is a gap: the
// track holds what it had. Nothing is answered.
//
// A point comes once: it is later than the one before, whoever sends it again. A frame whose time is not
// about now is refused, and so one that was kept to be sent another time.
#ifndef HEADWAY_FEED_H
#define HEADWAY_FEED_H

#include "logic.h"
#include "peer.h"
#include "piece.h"

#define FEED_TRACKS (SOURCE_OF_INPUTS - SOURCE_OF_PIECES)
#define FEED_FRESH_US 100000       // a frame's time is so near to now
#define FEED_ALONE_US (1 << 28)    // a step that lasts so long is said again
#define FEED_OLDEST_US (1LL << 31) // no point of a frame is older: it has 32 bits for that
#define FEED_UNKNOWN_MS INT32_MAX  // nothing has been heard yet

// A feed that is given.
struct given {
    bool waits;    // to be sent
    uint16_t wait; // servo periods until the next one
    struct peer_feed frame;
};

// A track that is taken from another board.
struct taken {
    bool begun;       // there has been a frame
    uint16_t feed;    // its number
    int64_t last_us;  // of the last point that was taken
    int64_t known_us; // up to which all is known
};

struct feeds {
    uint8_t given_last;
    uint16_t fed; // bit i: track i of pieces is taken from another board
    uint32_t gaps;
    struct given given[LOGIC_FEEDS];
    struct taken taken[FEED_TRACKS];
};

// Another logic: feeds begin anew. Returns which tracks have another producer now, bit by bit.
uint16_t feeds_rule(struct feeds *feeds, const struct logic *logic);

// After a servo period at a time: takes points of what was found in it. Returns how many milliseconds
// ago that time is up to which all tracks are known that come from other boards; 0: none lags.
int32_t feeds_step(struct feeds *feeds, const struct logic *logic, const int32_t *values,
                   int64_t time_us);

// The frame that waits, one after the other; 0 if none does.
const struct peer_feed *feeds_next(struct feeds *feeds, int32_t count);

// Takes the pieces of a frame for a track; they are counted. False for one that is not about now.
// `anew`: the track has been emptied.
bool feeds_take(struct feeds *feeds, int32_t track, struct pieces *pieces,
                const struct peer_feed *frame, int64_t now_us, uint32_t *refused, uint32_t *late,
                bool *anew);

#endif
