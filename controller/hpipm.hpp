// HPIPM, an interior-point method on the problem's stages: Frison, Diehl, IFAC-PapersOnLine 53, 2020.
#pragma once

#include <memory>
#include <vector>

#include "solver.hpp"
#include "stages.hpp"

extern "C" {
#include "hpipm_d_ocp_qp.h"
#include "hpipm_d_ocp_qp_dim.h"
#include "hpipm_d_ocp_qp_ipm.h"
#include "hpipm_d_ocp_qp_sol.h"
}

class Hpipm : public Solver {
  public:
    // The arrays stay where they are and are read again.
    Hpipm(Stages stages, int max_iterations, double tolerance);
    Hpipm(const Hpipm &) = delete;
    bool update() override;
    Answer solve(double *z) override;
    void forget() override;

  private:
    void set_constant();
    void set_states();
    void set_soft(int i, int first);
    void set_vectors();
    void measure(Answer &answer) const;

    Stages p_;
    int between_;                                 // rows of a stage's cubic
    int soft_;                                    // its rows with slacks: the last of them ...
    int kept_;                                    // ... are the task's own
    std::vector<std::unique_ptr<char[]>> memory_; // what HPIPM works in
    d_ocp_qp_dim dim_{};
    d_ocp_qp qp_{};
    d_ocp_qp_sol sol_{};
    d_ocp_qp_ipm_arg arg_{};
    d_ocp_qp_ipm_ws work_{};
    void *work_memory_;
    std::vector<double> buffer_; // for one block at a time
    std::vector<double> offset_; // of each stage's cubic, which the dynamics fix
};
