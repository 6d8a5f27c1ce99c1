// A function that CasADi generated, bound to arrays that stay where they are.
#pragma once

struct generated {
    int (*call)(const double **arg, double **res, long long *iw, double *w, int mem);
    const double **arg;
    double **res;
    long long *iw;
    double *w;
};

// Returns 0 if all is well.
static inline int generated_run(const struct generated *g) {
    return g->call(g->arg, g->res, g->iw, g->w, 0);
}
