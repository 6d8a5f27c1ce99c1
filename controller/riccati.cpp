#include "riccati.hpp"

#include <dlfcn.h>

#include <cstdint>
#include <stdexcept>

template <typename F> static F symbol(void *library, const char *name) {
    void *found = dlsym(library, name);
    if (!found)
        throw std::runtime_error(std::string("the compiled solver lacks a function: ") + dlerror());
    return reinterpret_cast<F>(found);
}

Riccati::Riccati(const std::string &path, Stages stages, int max_iterations, double tolerance)
    : kept_(std::move(stages)), max_iterations_(max_iterations), tolerance_(tolerance) {
    const Stages &p = kept_;
    problem_ = {p.a.data(),          p.b0.data(),     p.b1.data(),           p.gradient.data(),
                p.lower.data(),      p.upper.data(),  p.column_scale.data(), p.row_scale.data(),
                p.state.data(),      p.torque.data(), p.step.data(),         p.curvature.data(),
                p.approach_s.data(), p.soft.data(),   p.kept.data(),         p.kept_slope.data()};
    void *library = dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL); // stays: others may use it
    if (!library)
        throw std::runtime_error(std::string("cannot load the compiled solver: ") + dlerror());
    size_t size = symbol<decltype(&riccati_size)>(library, "riccati_size")();
    update_ = symbol<decltype(&riccati_update)>(library, "riccati_update");
    solve_ = symbol<decltype(&riccati_solve)>(library, "riccati_solve");
    memory_.reset(new char[size + 64]());
    auto at = reinterpret_cast<std::uintptr_t>(memory_.get());
    work_ = reinterpret_cast<void *>((at + 63) / 64 * 64);
}

bool Riccati::update() { return update_(work_, &problem_); }

Answer Riccati::solve(double *z) {
    riccati_answer found = solve_(work_, &problem_, z, max_iterations_, tolerance_);
    // At its limit of iterations the residual decides.
    bool good = found.good || found.iterations == max_iterations_;
    return {!found.good, found.iterations, good, found.stationarity, found.complementarity};
}
