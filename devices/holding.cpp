#include "holding.hpp"

#include <algorithm>
#include <iterator>

void Holding::forget() {
    std::fill(std::begin(held), std::end(held), track{});
    std::copy(std::begin(held), std::end(held), presumed_);
    pending.clear();
}

void Holding::write(track *tracks, const plan &p) {
    for (int sink = 0; sink < TRACK_COUNT; ++sink)
        if (p.tracks & 1 << sink)
            track_write(&tracks[sink], p.first_knot, p.points[sink], p.count);
}

void Holding::send(const Sent &sent) {
    write(presumed_, sent.plan);
    last = sent.plan.number;
    pending.push_back(sent);
}

void Holding::settle(const status &told, int64_t patience_us) {
    while (!pending.empty() && pending[0].plan.number <= told.plan_seen) {
        const uint32_t behind = told.plan_seen - pending[0].plan.number;
        if (behind < 32 && told.accepted_mask >> behind & 1)
            write(held, pending[0].plan);
        pending.pop_front();
    }
    while (!pending.empty() && pending[0].sent_us + patience_us < told.sent_us)
        pending.pop_front(); // it had time to arrive
    if (!(told.accepted_mask & 1) && told.plan_seen > doomed)
        doomed = last;
    std::copy(std::begin(held), std::end(held), presumed_);
    for (const Sent &sent : pending)
        if (sent.plan.number > doomed)
            write(presumed_, sent.plan);
}
