// What the compiled solver of riccati.c and its caller share.
#ifndef RICCATI_H
#define RICCATI_H

#include <stddef.h>

// Column by column, in the scaled variables of ocp.py but where it says otherwise; n axes, w motors.
struct riccati_problem {
    const double *a, *b0, *b1;   // the intervals' dynamics, unscaled: 2n x 2n, 2n x n, 2n x n each
    const double *gradient;      // of states (2n, N+1), then of torques (w, N+1)
    const double *lower, *upper; // in the order of rows of ocp.py
    const double *column_scale, *row_scale;
    const double *state, *torque;    // the Hessian's diagonals (2n, N+1) and (w, N+1), ...
    const double *step;              // ... its torque steps (w, N), which are in neither
    const double *curvature;         // (2n, 2n(N+1)), unscaled, on top of `state`; or NULL
    const double *approach_s, *soft; // (n,): T of the soft limits, and their weight
    // Rows of the task's own after the first node, unscaled: values (r, N) and slopes (r, 2nN).
    const double *kept, *kept_slope;
};

struct riccati_answer {
    int good;       // converged
    int iterations; // 0: no limit is active
    // Of the Lagrangian by torque, in SI; largest product of a multiplier and its distance.
    double stationarity, complementarity;
};

size_t riccati_size(void); // of the memory that it works in: zeros at first, aligned to 64 bytes
int riccati_update(void *memory, const struct riccati_problem *p); // new matrices; 0 if it cannot
struct riccati_answer riccati_solve(void *memory, const struct riccati_problem *p, double *z,
                                    int max_iterations, double tolerance);

#endif
