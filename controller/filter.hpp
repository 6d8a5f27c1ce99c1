// An extended Kalman filter over z = [q, v, d] that takes encoder readings in, one at a time.
#pragma once

#include <cstdint>
#include <vector>

#include "bound.hpp"

using Integers = nanobind::ndarray<int64_t, nanobind::device::cpu>;

// Samples in the order of their stamps and the filter after each, a row a sample.
struct Rows {
    Integers time_us, axis;
    Array position;
    Array z, covariance; // (rows, 3n), (rows, 3n, 3n)
    Array nis;           // normalized innovation squared
    Integers rejected;   // outliers in a row, by axis (rows, n)
};

// From time to time: each step's start, middle and end (count, 3), and the tracks then (.., 5n).
struct Steps {
    size_t count;
    const int64_t *times_us;
    const double *tracks;
};

// Such steps through all times, as many between two as keep each within `longest_us`: (count, 3).
std::vector<int64_t> steps_through(const std::vector<int64_t> &times_us, int64_t longest_us);

// What the filter assumes, by axis; z's variances at a reset (3n).
struct Noise {
    Array acceleration, walk; // densities: of white acceleration, of the disturbance's random walk
    Array reading;            // variance
    Array start;
};

// A reading whose NIS is beyond `nis_max` is an outlier. After so many in a row it is the filter
// that is wrong: its covariance is widened.
struct Outliers {
    double nis_max;
    int64_t in_a_row;
};

class Filter {
  public:
    Filter(Bound &step, Noise noise, Outliers outliers);

    size_t axes() const { return n; }
    size_t track_rows() const; // at one time

    // Carries z and its covariance, in place, through all steps. Rows `first` .. `last` - 1 are
    // taken in, and filled in, at the ends of steps that are their times.
    void run(double *z, double *covariance, Steps steps, const Rows &rows, size_t first,
             size_t last);

  private:
    void predict(double *z, double *covariance, double dt_s, const double *tracks);
    void correct(double *z, double *covariance, const Rows &rows, size_t row);

    Bound &step; // x, d, tracks at the start, middle and end, dt to x after, its Jacobian in [x, d]
    Noise noise;
    Outliers outliers;
    size_t n;
    std::vector<double> carried, column, gain; // working memory: F P; P H'; K
};
