#include "history.hpp"

#include <algorithm>
#include <utility>

static bool before(const Sample &a, const Sample &b) {
    return std::make_pair(a.time_us, a.axis) < std::make_pair(b.time_us, b.axis);
}

History::History(size_t axes, size_t rows, int64_t bundle_us)
    : n(axes), width(4 * axes + 9 * axes * axes + 1), room(rows), bundle_us(bundle_us),
      states(room * width), outliers(room * axes) {
    samples.reserve(room);
}

void History::restart(int64_t time_us, const double *z_then, const double *covariance_then) {
    samples.assign(1, {time_us, -1, 0});
    begun_us = time_us;
    begin = 0;
    std::copy_n(z_then, 3 * n, z(0));
    std::copy_n(covariance_then, 9 * n * n, covariance(0));
    std::fill_n(acceleration(0), n, 0.0);
    std::fill_n(rejected(0), n, 0);
    fill(0);
}

size_t History::insert(const Samples &more) {
    for (const Sample &sample : more) {
        auto at = std::lower_bound(samples.begin(), samples.end(), sample, before);
        bool known = at != samples.end() && !before(sample, *at);
        if (known || at == samples.begin())
            continue;
        filled_ = std::min(filled_, (size_t)(at - samples.begin()));
        samples.insert(at, sample);
    }
    if (samples.size() > room)
        make_room();
    return samples.size() - filled_;
}

int64_t History::time_us(size_t row) const {
    const int64_t at_us = samples[row].time_us,
                  into_us = (at_us % bundle_us + bundle_us) % bundle_us;
    return std::max(at_us - into_us, begun_us);
}

void History::forget(size_t row) {
    samples.erase(samples.begin(), samples.begin() + (std::ptrdiff_t)row);
    begin = place(row);
    filled_ -= row;
}

size_t History::first_since(int64_t time_us) const {
    auto at =
        std::lower_bound(samples.begin(), samples.end(), Sample{time_us, INT64_MIN, 0}, before);
    return (size_t)(at - samples.begin());
}

// A larger ring, with what is known at its front.
void History::make_room() {
    std::vector<double> larger(2 * samples.size() * width);
    std::vector<int64_t> more(2 * samples.size() * n);
    for (size_t row = 0; row < filled_; ++row) {
        std::copy_n(z(row), width, &larger[row * width]);
        std::copy_n(rejected(row), n, &more[row * n]);
    }
    states.swap(larger);
    outliers.swap(more);
    room = 2 * samples.size();
    begin = 0;
}
