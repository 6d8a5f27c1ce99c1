// Generated functions for Python: no argument is looked at in a call, and the GIL is released.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <dlfcn.h>

#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "bound.hpp"

namespace nb = nanobind;
using namespace nb::literals;

template <typename F> static F symbol(void *library, const std::string &name) {
    void *found = dlsym(library, name.c_str());
    if (!found)
        throw std::runtime_error(std::string("a generated function is missing: ") + dlerror());
    return reinterpret_cast<F>(found);
}

using Shape = std::tuple<std::string, size_t, size_t>; // name, rows, columns
using Shapes = std::pair<std::vector<Shape>, std::vector<Shape>>;

static void *open(const std::string &path) {
    void *library = dlopen(path.c_str(), RTLD_NOW | RTLD_LOCAL); // stays: others may be bound to it
    if (!library)
        throw std::runtime_error(std::string("cannot load generated code: ") + dlerror());
    return library;
}

static Shapes shapes(const std::string &path, const std::string &name) {
    void *library = open(path);
    auto side = [&](const char *end) {
        auto count = symbol<long long (*)()>(library, name + "_n" + end)();
        auto of = symbol<const long long *(*)(long long)>(library, name + "_sparsity" + end);
        auto called = symbol<const char *(*)(long long)>(library, name + "_name" + end);
        std::vector<Shape> found;
        for (long long i = 0; i < count; ++i) {
            const long long *shape = of(i);
            if (shape[2] != 1) // CasADi's mark of a dense one
                throw std::invalid_argument(name + " takes or gives a sparse matrix; densify it");
            found.emplace_back(called(i), shape[0], shape[1]);
        }
        return found;
    };
    return {side("_in"), side("_out")};
}

Bound::Bound(const std::string &path, const std::string &name, std::vector<Array> inputs,
             std::vector<Array> outputs)
    : kept(std::move(inputs)) {
    size_t n_in = kept.size();
    kept.insert(kept.end(), outputs.begin(), outputs.end());
    auto [expected, more] = shapes(path, name);
    if (expected.size() != n_in || more.size() != outputs.size())
        throw std::invalid_argument(name + " takes and gives another number of arrays");
    expected.insert(expected.end(), more.begin(), more.end());
    for (size_t i = 0; i < kept.size(); ++i)
        if (std::get<1>(expected[i]) * std::get<2>(expected[i]) != kept[i].size())
            throw std::invalid_argument(name + ": an array is not of its argument's size");
    void *library = open(path);
    long long sizes[4] = {0, 0, 0, 0};
    using Work = int (*)(long long *, long long *, long long *, long long *);
    symbol<Work>(library, name + "_work")(&sizes[0], &sizes[1], &sizes[2], &sizes[3]);
    arg.resize((size_t)sizes[0]);
    res.resize((size_t)sizes[1]);
    iw.resize((size_t)sizes[2]);
    w.resize((size_t)sizes[3]);
    for (size_t i = 0; i < n_in; ++i)
        arg[i] = kept[i].data();
    for (size_t i = n_in; i < kept.size(); ++i)
        res[i - n_in] = kept[i].data();
    generated = {symbol<decltype(generated.call)>(library, name), arg.data(), res.data(), iw.data(),
                 w.data()};
}

NB_MODULE(_generated, m) {
    m.doc() = "Functions that CasADi generated, bound to arrays.";
    m.def("shapes", &shapes, "library"_a, "name"_a,
          "Name, rows and columns of a function's inputs, and of its outputs. Raises ValueError if "
          "one is "
          "sparse, RuntimeError for a library without the function.");
    nb::class_<Bound>(m, "Bound", "A function of a library and its arrays, which it keeps.")
        .def(nb::init<const std::string &, const std::string &, std::vector<Array>,
                      std::vector<Array>>(),
             "library"_a, "name"_a, "inputs"_a, "outputs"_a,
             "Raises ValueError for arrays of other numbers or sizes than the function's, "
             "RuntimeError for a library without it.")
        .def(
            "run",
            [](const Bound &bound) {
                nb::gil_scoped_release free;
                generated_run(&bound.generated);
            },
            "Evaluates: reads the inputs, writes the outputs.");
}
