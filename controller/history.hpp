// The last samples in the order of their stamps, and the filter after each of them.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "sample.hpp"

// The first row stands for all before it; its sample is of axis -1, of none. Samples are few numbers and move when one comes late; what
// the filter was after them is many, and lies in a ring, where a row keeps its place.
class History {
  public:
    // Room for so many rows at first. Samples within `bundle_us` of each other, on a grid, count for
    // one time: that of the grid before them.
    History(size_t axes, size_t rows, int64_t bundle_us);

    // Forgets all; the filter at a time takes its place.
    void restart(int64_t time_us, const double *z, const double *covariance);

    // Puts samples in their places, but for known ones and those older than all that is remembered.
    // Returns how many rows the filter has to fill in anew: the last ones.
    size_t insert(const Samples &more);

    // Forgets the rows before one.
    void forget(size_t row);

    size_t size() const { return samples.size(); }
    size_t filled() const { return filled_; } // rows whose state is known
    const Sample &sample(size_t row) const { return samples[row]; }
    int64_t time_us(size_t row) const;         // that the row's state is of, not after its sample
    size_t first_since(int64_t time_us) const; // the first row that is not older

    double *z(size_t row) { return &states[place(row) * width]; }           // (3n)
    double *covariance(size_t row) { return z(row) + 3 * n; }               // (3n, 3n)
    double *acceleration(size_t row) { return z(row) + 3 * n + 9 * n * n; } // on the way there (n)
    double &nis(size_t row) { return z(row)[width - 1]; } // normalized innovation squared
    int64_t *rejected(size_t row) { return &outliers[place(row) * n]; } // in a row, by axis (n)
    void fill(size_t row) { filled_ = row + 1; }

  private:
    size_t place(size_t row) const { return (begin + row) % room; }
    void make_room();

    size_t n, width, room, begin = 0, filled_ = 0;
    int64_t bundle_us, begun_us = 0;
    Samples samples;
    std::vector<double> states;
    std::vector<int64_t> outliers;
};
