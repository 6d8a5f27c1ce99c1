// A solver compiled for one machine and horizon (riccati.c), which does not know Python's arrays.
#pragma once

#include <memory>
#include <string>
#include <vector>

#include "solver.hpp"
#include "stages.hpp"

extern "C" {
#include "riccati.h"
}

class Riccati : public Solver {
  public:
    // The arrays stay where they are and are read again. Throws std::runtime_error for a library that
    // is not of riccati.c.
    Riccati(const std::string &library, Stages stages, int max_iterations, double tolerance);
    Riccati(const Riccati &) = delete;
    bool update() override;
    Answer solve(double *z) override;

  private:
    Stages kept_;
    riccati_problem problem_;
    int max_iterations_;
    double tolerance_;
    std::unique_ptr<char[]> memory_;
    void *work_; // in it, aligned
    decltype(&riccati_update) update_;
    decltype(&riccati_solve) solve_;
};
