// A generated function of Lanes as one of numbers, for COUNT columns of its arguments: what CasADi's
// `map` makes, as many at a time as there are lanes. It stands behind the function's code, and
// definitions of ONE and MAPPED, their names, and SHARED: for each argument, whether all columns have
// the same.
#include <stdint.h>

#define JOINED(a, b) a##b
#define NAMED(a, b) JOINED(a, b)
#define OF_ONE(what) NAMED(ONE, what)
#define OF_MAPPED(what) NAMED(MAPPED, what)

static const bool shared[] = SHARED;

static long long size(const long long *shape) { return shape[0] * shape[1]; }

static const long long *repeated(const long long *shape, bool once, long long *made) {
    made[0] = shape[0];
    made[1] = shape[1] * (once ? 1 : COUNT);
    made[2] = shape[2]; // CasADi's mark of a dense one, if it is
    return made;
}

extern "C" {

long long OF_MAPPED(_n_in)(void) { return OF_ONE(_n_in)(); }

long long OF_MAPPED(_n_out)(void) { return OF_ONE(_n_out)(); }

const char *OF_MAPPED(_name_in)(long long i) { return OF_ONE(_name_in)(i); }

const char *OF_MAPPED(_name_out)(long long i) { return OF_ONE(_name_out)(i); }

const long long *OF_MAPPED(_sparsity_in)(long long i) {
    static long long made[sizeof shared][3];
    return repeated(OF_ONE(_sparsity_in)(i), shared[i], made[i]);
}

const long long *OF_MAPPED(_sparsity_out)(long long i) {
    static long long made[OUTPUTS][3];
    return repeated(OF_ONE(_sparsity_out)(i), false, made[i]);
}

int OF_MAPPED(_work)(long long *arguments, long long *results, long long *iw, long long *w) {
    OF_ONE(_work)(arguments, results, iw, w);
    for (long long i = 0; i < OF_ONE(_n_in)(); ++i)
        *w += size(OF_ONE(_sparsity_in)(i));
    for (long long i = 0; i < OF_ONE(_n_out)(); ++i)
        *w += size(OF_ONE(_sparsity_out)(i));
    *w = (*w + 1) * LANES; // one more to align
    *arguments += OF_ONE(_n_in)();
    *results += OF_ONE(_n_out)();
    return 0;
}

int MAPPED(const double **arg, double **res, long long *iw, double *w, int mem) {
    Lanes *start = (Lanes *)(((uintptr_t)w + WIDTH - 1) / WIDTH * WIDTH);
    long long inputs = OF_ONE(_n_in)(), outputs = OF_ONE(_n_out)();
    const Lanes **in = (const Lanes **)(arg + inputs);
    Lanes **out = (Lanes **)(res + outputs);
    for (int first = 0; first < COUNT; first += LANES) {
        Lanes *at = start;
        for (long long k = 0; k < inputs; ++k) {
            long long rows = size(OF_ONE(_sparsity_in)(k));
            for (int lane = 0; lane < LANES; ++lane) {
                int column = first + lane < COUNT ? first + lane : COUNT - 1;
                const double *of = arg[k] + (shared[k] ? 0 : column * rows);
                for (long long i = 0; i < rows; ++i)
                    at[i].v[lane] = of[i];
            }
            in[k] = at;
            at += rows;
        }
        for (long long k = 0; k < outputs; ++k) {
            out[k] = at;
            at += size(OF_ONE(_sparsity_out)(k));
        }
        if (ONE(in, out, iw, at, mem))
            return 1;
        for (long long k = 0; k < outputs; ++k) {
            long long rows = size(OF_ONE(_sparsity_out)(k));
            for (int lane = 0; lane < LANES && first + lane < COUNT; ++lane)
                for (long long i = 0; i < rows; ++i)
                    res[k][(first + lane) * rows + i] = out[k][i].v[lane];
        }
    }
    return 0;
}
}
