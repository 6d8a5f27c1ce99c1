// An extended Kalman filter over z = [q, v, d] that takes encoder readings in, one at a time.
#pragma once

#include <cstdint>
#include <vector>

#include "bound.hpp"
#include "history.hpp"

// Start, middle and end of each step, by time (count, 3), and the tracks then (3 count, 5n).
struct Steps {
    size_t count;
    const int64_t *times_us;
    const double *tracks;
};

// Such steps through all times, which do not decrease, as many between two as keep each within
// `longest_us`: (count, 3). At least one, which may have no length.
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

// Of all samples that are forgotten, as they were last taken in.
struct Statistics {
    int64_t accepted = 0, outliers = 0;
    double nis_sum = 0; // of those accepted
    int64_t taken = 0;  // rows filled in, with those that were known before a late sample
};

class Filter {
  public:
    // `slope`: x, tracks, d and the law to x' and the accelerations' Jacobians in x and in d; `rate`, on
    // the same arrays: to x' alone. `rows`, `bundle_us`: see History; `step_us`: the longest step.
    Filter(Bound &rate, Bound &slope, Noise noise, Outliers outliers, size_t rows,
           int64_t bundle_us, int64_t step_us);

    size_t axes() const { return n; }
    size_t track_rows() const; // at one time

    // Times of the bundles that are to be taken in, from that of the last known state, to now.
    std::vector<int64_t> times_to(int64_t now_us) const;

    // From the last known state through such steps, whose ends are those times: takes the samples
    // in, and tells z and its covariance now.
    void update(double *z, double *covariance, Steps steps);

    // Carries z and its covariance, in place, through all steps.
    void predict(double *z, double *covariance, Steps steps);

    // One step by itself, of z through tracks at its start, middle and end: x after it, and its
    // Jacobian in z (2n, 3n), by columns.
    void step(const double *z, const double *tracks, double dt_s, double *after, double *jacobian);

    // Forgets the samples before the last one that is older than a time.
    void forget(int64_t before_us);

    History history;
    Statistics statistics;
    const int64_t step_us;

  private:
    void step_on(double *z, double *covariance, double dt_s, const double *tracks);
    void correct(double *z, double *covariance, size_t row);
    void take_in(double *z, double *covariance, int64_t time_us);

    Bound &rate, &slope;
    Noise noise;
    Outliers outliers;
    size_t n;
    // Working memory: F P; P H'; K; x after a step and its Jacobian F; by rows, that one's series so
    // far and its rate.
    std::vector<double> carried, column, gain, after, jacobian, s, ds;
    std::vector<double> acceleration; // in the last step, on average
};
