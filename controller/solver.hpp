// What a tick asks of a QP solver. Its data lie in arrays that others fill.
#pragma once

#include <cmath>

struct Answer {
    int status = 0; // the solver's own
    int iterations = 0;
    bool good = false; // by the status alone: what it is worth others judge
    // How far from optimal, by the solver's own multipliers: the Lagrangian's largest slope, by what
    // a variable is in SI, and the largest product of a constraint's multiplier and its distance.
    double stationarity = NAN, complementarity = NAN;
};

class Solver {
  public:
    virtual ~Solver() = default;
    virtual bool update() = 0;           // the matrices are new; false if it cannot take them
    virtual Answer solve(double *z) = 0; // the vectors are new; z: all variables
    virtual void forget() {}             // begins anew: its last answer was no good
};
