// The tick's problem as solvers have it that go by stages.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <array>
#include <vector>

// Column by column, all in the scaled variables of ocp.py.
using Matrix = nanobind::ndarray<double, nanobind::device::cpu>;

struct Stages {
    int axes, intervals;
    std::vector<std::array<double, 3>> cubic; // rows between two nodes, see Ocp.cubic
    std::vector<int> driven;                  // axes with a motor
    std::vector<int> bounded;                 // axes with soft limits
    Matrix a, b0, b1;                         // the intervals' dynamics, unscaled
    Matrix gradient, lower, upper;            // as OSQP has them
    Matrix column_scale, row_scale;           // of variables and constraints
    Matrix state, torque, step; // Hessian: diagonals (2n, N+1) and (w, N+1), steps (w, N)
    Matrix curvature;           // (2n, 2n(N+1)), unscaled, on top of `state`; or nothing
    // Rows of the task's own after the first node, unscaled: values (r, N) and slopes (r, 2nN).
    Matrix kept, kept_slope;
    Matrix approach_s, soft; // (n,): T, and the slacks' weight
};
