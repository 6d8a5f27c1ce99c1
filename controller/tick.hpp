// What a tick computes in one call: generated functions one after the other, and a solver.
#pragma once

#include <cmath>
#include <vector>

#include "bound.hpp"
#include "solver.hpp"

// From a motion to tracks. Where the servos' feedback adds up to more torque than there is, the
// torque track gives way by as much, round by round.
struct Encoding {
    Bound &encode, &rollout, &relieve;
    Array relief, next; // what is taken off the torque track, and what should be
    Array over;         // torque beyond the limits, at most [Nm]; 0 and less: none

    void run() const;
};

struct Feedback {
    Answer answer;
    double residual = INFINITY; // largest violation of a constraint, in parts of its tolerance
    bool accepted = false;
    double solve_us = 0; // wall clock, for the record only
};

struct Tick {
    std::vector<Bound *> before; // what can be done before the estimate is known
    Solver &solver;
    Bound &vectors;     // fills in what the estimate decides
    Array z;            // the solver's answer
    Bound &judge;       // of the answer: its residual, and the motion that it is
    Array residual;     // and a sum of all that it was judged by
    Encoding *encoding; // none: nobody wants tracks
    // Of sequential quadratic programming: so many programs a tick, each around the last one's answer.
    struct {
        int iterations;
        std::vector<int> driven;        // axes with a motor, whose torques are in z
        Array scale;                    // of z, in SI: states x, then torques u
        Array x, u, assumed, around, d; // the guess and what it is for; see ocp.py
    } sqp;
    bool ready = false; // the solver has taken the matrices

    void prepare();
    Feedback feedback();

  private:
    void solve(Feedback &f);
    void step();
};
