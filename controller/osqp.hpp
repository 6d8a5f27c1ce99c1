// OSQP, in its own scaling off and ours on: Stellato et al., Math. Prog. Comp. 12, 2020.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <memory>
#include <vector>

#include "solver.hpp"

extern "C" {
#include "osqp.h"
}

using Numbers =
    nanobind::ndarray<double, nanobind::ndim<1>, nanobind::c_contig, nanobind::device::cpu>;
using Indices =
    nanobind::ndarray<const OSQPInt, nanobind::ndim<1>, nanobind::c_contig, nanobind::device::cpu>;

struct Sparse { // by columns
    Numbers data;
    Indices indices, indptr;
};

class Osqp : public Solver {
  public:
    // P's upper half, q, A, l and u, in variables that are `scale` in SI. The arrays stay where they
    // are and are read again, P only if it changes.
    Osqp(Sparse hessian, bool hessian_changes, Numbers gradient, Sparse constraints, Numbers lower,
         Numbers upper, Numbers scale, int max_iterations, double tolerance);
    bool update() override;
    Answer solve(double *z) override;
    void forget() override;

  private:
    bool take_matrices(bool hessian);
    bool take_vectors(const double *from);
    void weigh();
    void measure(const double *z, Answer &answer);

    Sparse hessian_;
    bool hessian_changes_;
    Sparse constraints_;
    Numbers gradient_, lower_, upper_, scale_;
    int max_iterations_, round_;
    std::vector<double> slope_, value_; // of the Lagrangian; of the constraints
    std::vector<double> idle_;       // where each solution is looked for first: no deviation at all
    std::vector<double> multiplier_; // of the last answer
    std::vector<double> weight_;     // of a row, while one program is solved
    std::vector<double> weighted_, low_, high_, own_; // the rows' entries, bounds and multipliers
    std::unique_ptr<OSQPSolver, OSQPInt (*)(OSQPSolver *)> solver_{nullptr, osqp_cleanup};
};
