// What Python keeps of a generated function: its arrays and its working memory.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <string>
#include <vector>

extern "C" {
#include "generated.h"
}

using Array = nanobind::ndarray<double, nanobind::device::cpu>;

struct Bound {
    Bound(const std::string &library, const std::string &name, std::vector<Array> inputs,
          std::vector<Array> outputs);
    Bound(const Bound &) = delete; // `generated` points into it
    Bound &operator=(const Bound &) = delete;

    std::vector<Array> kept;
    std::vector<const double *> arg;
    std::vector<double *> res;
    std::vector<long long> iw;
    std::vector<double> w;
    struct generated generated;
};
