// What a tick asks of a QP solver. Its data lie in arrays that others fill.
#pragma once

struct Answer {
    int status = 0; // the solver's own
    int iterations = 0;
    bool good = false; // by the status alone: what it is worth others judge
};

class Solver {
  public:
    virtual ~Solver() = default;
    virtual bool update() = 0;           // the matrices are new; false if it cannot take them
    virtual Answer solve(double *z) = 0; // the vectors are new; z: all variables
    virtual void forget() {}             // begins anew: its last answer was no good
};
