// The tracks that a device holds: as it has acknowledged them, and as they will be once what is under
// way has arrived.
#pragma once

#include <cstdint>
#include <deque>

extern "C" {
#include "plan.h"
#include "status.h"
#include "track.h"
}

struct Sent {
    int64_t sent_us;
    struct plan plan;
};

class Holding {
  public:
    Holding() { forget(); }

    // A new epoch: the device drops its tracks.
    void forget();

    // A plan is under way.
    void send(const Sent &sent);

    // Settles those plans that a status has an answer for; one without an answer after
    // `patience_us` counts as lost.
    void settle(const status &told, int64_t patience_us);

    const track &presumed(int sink) const { return presumed_[sink]; }

    // When the first of the plans under way was sent; far in the future if there is none.
    int64_t waiting_since_us() const { return pending.empty() ? INT64_MAX : pending[0].sent_us; }

  private:
    static void write(track *tracks, const plan &points);

    track held[TRACK_COUNT], presumed_[TRACK_COUNT];
    std::deque<Sent> pending;
    uint32_t last = 0;   // plan sent
    uint32_t doomed = 0; // pending plans up to this number are taken to be refused
};
