// HPIPM, an interior-point method on the problem's stages: Frison, Diehl, IFAC-PapersOnLine 53, 2020.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <memory>
#include <vector>

#include "solver.hpp"

extern "C" {
#include "hpipm_d_ocp_qp.h"
#include "hpipm_d_ocp_qp_dim.h"
#include "hpipm_d_ocp_qp_ipm.h"
#include "hpipm_d_ocp_qp_sol.h"
}

// Column by column, all in the scaled variables of ocp.py.
using Matrix = nanobind::ndarray<double, nanobind::device::cpu>;

struct Stages {
    int axes, intervals;
    std::vector<int> driven;        // axes with a motor
    std::vector<int> bounded;       // axes with soft limits
    Matrix a, b0, b1;               // the intervals' dynamics, unscaled
    Matrix gradient, lower, upper;  // as OSQP has them
    Matrix column_scale, row_scale; // of variables and constraints
    Matrix state, torque, step;     // Hessian: diagonals (2n, N+1) and (w, N+1), steps (w, N)
    Matrix curvature;               // (2n, 2n(N+1)), unscaled, on top of `state`; or nothing
    Matrix approach_s, soft;        // (n,): T, and the slacks' weight
};

class Hpipm : public Solver {
  public:
    // The arrays stay where they are and are read again.
    Hpipm(Stages stages, int max_iterations, double tolerance);
    Hpipm(const Hpipm &) = delete;
    bool update() override;
    Answer solve(double *z) override;

  private:
    void set_constant();
    void set_states();
    void set_vectors();
    void measure(Answer &answer) const;

    Stages p_;
    std::vector<std::unique_ptr<char[]>> memory_; // what HPIPM works in
    d_ocp_qp_dim dim_{};
    d_ocp_qp qp_{};
    d_ocp_qp_sol sol_{};
    d_ocp_qp_ipm_arg arg_{};
    d_ocp_qp_ipm_ws work_{};
    std::vector<double> buffer_; // for one block at a time
    std::vector<double> offset_; // of each stage's change of speed, which the dynamics fix
};
