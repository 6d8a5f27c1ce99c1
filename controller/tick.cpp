#include "tick.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>
#include <exception>

static constexpr int ROUNDS = 8;
static constexpr double SANE_MAX = 1e6; // OSQP marks failure with 2143289344.0, which is finite

static double now_us() {
    using namespace std::chrono;
    return duration<double, std::micro>(steady_clock::now().time_since_epoch()).count();
}

void Encoding::run() const {
    std::fill_n(relief.data(), relief.size(), 0.0);
    for (int round = 1;; ++round) {
        generated_run(&encode.generated);
        generated_run(&rollout.generated);
        generated_run(&relieve.generated);
        if (!(over.data()[0] > 0) || round == ROUNDS)
            return;
        std::copy_n(next.data(), next.size(), relief.data());
    }
}

void Tick::prepare() {
    for (Bound *each : before)
        generated_run(&each->generated);
    ready = solver.update();
}

// The answer is used if the solver says so, all its numbers are finite and of sane size, and the
// residual as we compute it is small. Otherwise the solver is to begin anew.
Feedback Tick::feedback() const {
    Feedback f;
    double began = now_us();
    generated_run(&vectors.generated);
    try {
        if (ready)
            f.answer = solver.solve(z.data());
    } catch (const std::exception &) {
        f.answer = {}; // no good
    }
    bool sane = std::all_of(z.data(), z.data() + z.size(), [](double v) {
        return std::abs(v) < SANE_MAX; // not for one that is not a number
    });
    if (f.answer.good && sane) {
        generated_run(&judge.generated);
        const double *judged = residual.data();
        f.residual = std::isfinite(judged[1]) ? judged[0] : INFINITY;
        f.accepted = f.residual <= 1;
    }
    if (!f.accepted)
        solver.forget();
    f.solve_us = now_us() - began;
    if (f.accepted)
        encoding.run();
    return f;
}
