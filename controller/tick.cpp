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

// The answer is used if the solver says so, all its numbers are finite and those of the motion of sane
// size (slacks may be what a task makes of them), and the residual as we compute it is small. Otherwise
// the solver is to begin anew.
void Tick::solve(Feedback &f) {
    f.accepted = false;
    f.answer = {}; // what the last program's was says nothing of this one
    f.residual = INFINITY;
    generated_run(&vectors.generated);
    try {
        if (ready)
            f.answer = solver.solve(z.data());
    } catch (const std::exception &) { // no answer
    }
    const double *begin = z.data(), *end = begin + z.size();
    const double *slacks = begin + sqp.x.size() + sqp.u.size() / sqp.d.size() * sqp.driven.size();
    bool sane = std::all_of(begin, slacks, [](double v) { return std::abs(v) < SANE_MAX; }) &&
                std::all_of(slacks, end, [](double v) { return std::isfinite(v); });
    if (f.answer.good && sane) {
        generated_run(&judge.generated);
        const double *judged = residual.data();
        f.residual = std::isfinite(judged[1]) ? judged[0] : INFINITY;
        f.accepted = f.residual <= 1;
    }
    if (!f.accepted)
        solver.forget();
}

// The answer is the guess of the next program.
void Tick::step() {
    const double *z_x = z.data(), *z_u = z_x + sqp.x.size();
    const double *scale_x = sqp.scale.data(), *scale_u = scale_x + sqp.x.size();
    for (size_t i = 0; i < sqp.x.size(); ++i)
        sqp.x.data()[i] += scale_x[i] * z_x[i];
    std::copy_n(sqp.around.data(), sqp.u.size(), sqp.u.data());
    size_t n = sqp.d.size(), w = sqp.driven.size(), nodes = sqp.u.size() / n;
    for (size_t i = 0; i < nodes; ++i)
        for (size_t j = 0; j < w; ++j)
            sqp.u.data()[i * n + (size_t)sqp.driven[j]] += scale_u[i * w + j] * z_u[i * w + j];
    std::copy_n(sqp.d.data(), sqp.d.size(), sqp.assumed.data());
    prepare();
}

Feedback Tick::feedback() {
    Feedback f;
    double began = now_us();
    solve(f);
    for (int i = 1; f.accepted && i < sqp.iterations; ++i) {
        step();
        int before = f.answer.iterations;
        solve(f);
        f.answer.iterations += before;
    }
    f.solve_us = now_us() - began;
    if (f.accepted && encoding)
        encoding->run();
    return f;
}
