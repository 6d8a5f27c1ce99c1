#include "tick.hpp"

#include <algorithm>
#include <chrono>
#include <cmath>

static constexpr int ROUNDS = 8;
static constexpr double SANE_MAX = 1e6; // OSQP marks failure with 2143289344.0, which is finite

static double now_us() {
    using namespace std::chrono;
    return duration<double, std::micro>(steady_clock::now().time_since_epoch()).count();
}

int Encoding::run() const {
    std::fill_n(relief.data(), relief.size(), 0.0);
    for (int round = 1;; ++round) {
        generated_run(&encode.generated);
        generated_run(&rollout.generated);
        generated_run(&relieve.generated);
        if (!(over.data()[0] > 0) || round == ROUNDS)
            return round;
        std::copy_n(next.data(), next.size(), relief.data());
    }
}

bool Tick::prepare() const {
    for (Bound *each : before)
        generated_run(&each->generated);
    return solver.update();
}

Feedback Tick::feedback() const {
    Feedback f;
    double began = now_us();
    generated_run(&vectors.generated);
    f.answer = solver.solve(z.data());
    f.finite = f.answer.good && std::all_of(z.data(), z.data() + z.size(), [](double v) {
                   return std::abs(v) < SANE_MAX; // not for one that is not a number
               });
    if (f.finite) {
        generated_run(&judge.generated);
        f.residual = residual.data()[0];
        f.accepted = f.residual <= 1;
    }
    f.solve_us = now_us() - began;
    if (f.accepted)
        f.rounds = encoding.run();
    return f;
}
