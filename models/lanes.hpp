// A number that is as many as the processor's vectors hold. Functions that CasADi generates compute
// with it as they do with one, and are worked out for several nodes at once (codegen.py).
#pragma once

#include <math.h>

#ifndef WIDTH // of vectors, in bytes
#ifdef __AVX512F__
#define WIDTH 64
#else
#define WIDTH 32
#endif
#endif
enum { LANES = WIDTH / 8 };

struct Lanes {
    typedef double Vector __attribute__((vector_size(WIDTH)));
    Vector v;

    Lanes() = default;
    Lanes(double of_all) : v(of_all - Vector{}) {}
    Lanes(Vector of_each) : v(of_each) {}
    void operator+=(Lanes b) { v += b.v; }
    void operator-=(Lanes b) { v -= b.v; }
    void operator*=(Lanes b) { v *= b.v; }
    void operator/=(Lanes b) { v /= b.v; }
    friend Lanes operator+(Lanes a, Lanes b) { return a.v + b.v; }
    friend Lanes operator-(Lanes a, Lanes b) { return a.v - b.v; }
    friend Lanes operator*(Lanes a, Lanes b) { return a.v * b.v; }
    friend Lanes operator/(Lanes a, Lanes b) { return a.v / b.v; }
    friend Lanes operator-(Lanes a) { return -a.v; }
};

template <double (*f)(double)> static inline Lanes of_each(Lanes a) {
    for (int i = 0; i < LANES; ++i)
        a.v[i] = f(a.v[i]);
    return a;
}

static inline Lanes sin(Lanes a) { return of_each<sin>(a); }
static inline Lanes cos(Lanes a) { return of_each<cos>(a); }
static inline Lanes tanh(Lanes a) { return of_each<tanh>(a); }
static inline Lanes sqrt(Lanes a) { return of_each<sqrt>(a); }
