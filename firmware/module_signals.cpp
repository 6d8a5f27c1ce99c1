// Python's view of signals: payloads of SIGNALS and LOGIC made, of READINGS read, kernels for tests.
#include <nanobind/nanobind.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>
#include <stdexcept>

extern "C" {
#include "frame.h"
#include "signals.h"
}

namespace nb = nanobind;
using namespace nb::literals;

using Piece = std::tuple<std::optional<int64_t>, int64_t, std::optional<int32_t>, int32_t>;
using Node = std::tuple<uint8_t, uint8_t, uint8_t, int32_t, int32_t>;
using Trigger = std::tuple<uint8_t, uint8_t, uint8_t, uint16_t>;
using Feed = std::tuple<uint8_t, uint8_t, uint16_t, uint16_t, uint16_t>;
using Fed = std::tuple<uint8_t, uint16_t>;

static const char *const results[] = {"good", "kind", "missing", "cycle", "limits"};
static const char *const piece_results[] = {"taken", "gap", "late", "order", "full"};

static wanted_piece wanted_of(const Piece &piece) {
    auto [start, end, from, to] = piece;
    return {start.has_value(), from.has_value(), start.value_or(0), end, from.value_or(0), to};
}

static nb::bytes encode_batch(int64_t base_us, uint32_t seen,
                              std::vector<std::tuple<uint8_t, uint32_t, Piece>> pieces) {
    batch b{};
    uint8_t payload[1000];
    if (pieces.size() > BATCH_PIECES)
        throw std::invalid_argument("more pieces than a frame holds");
    b.base_us = base_us;
    b.seen = seen;
    b.count = (uint8_t)pieces.size();
    for (size_t i = 0; i < pieces.size(); i++) {
        b.pieces[i].track = std::get<0>(pieces[i]);
        b.pieces[i].number = std::get<1>(pieces[i]);
        b.pieces[i].piece = wanted_of(std::get<2>(pieces[i]));
    }
    int32_t size = batch_encode(&b, payload, sizeof payload);
    if (size < 0)
        throw std::invalid_argument(
            "a track, a time or a value out of range, or too much for a frame");
    return nb::bytes((const char *)payload, (size_t)size);
}

static logic logic_of(uint32_t number, const std::vector<Node> &nodes,
                      const std::vector<uint8_t> &digital, const std::vector<uint8_t> &pwm,
                      const std::vector<Trigger> &triggers, const std::vector<Feed> &feeds,
                      const std::vector<Fed> &fed) {
    logic l{};
    if (nodes.size() > GRAPH_NODES || digital.size() > BOARD_DIGITAL || pwm.size() > BOARD_PWM ||
        triggers.size() > LOGIC_TRIGGERS || feeds.size() > LOGIC_FEEDS || fed.size() > LOGIC_FEEDS)
        throw std::invalid_argument("more nodes, outputs, triggers or feeds than a device has");
    l.number = number;
    l.nodes = (uint8_t)nodes.size();
    l.triggers = (uint8_t)triggers.size();
    for (size_t i = 0; i < nodes.size(); i++) {
        auto [kind, a, b, low, high] = nodes[i];
        l.node[i] = {kind, a, b, low, high};
    }
    for (size_t i = 0; i < BOARD_DIGITAL; i++)
        l.digital[i] = i < digital.size() ? digital[i] : (uint8_t)SOURCE_UNUSED;
    for (size_t i = 0; i < BOARD_PWM; i++)
        l.pwm[i] = i < pwm.size() ? pwm[i] : (uint8_t)SOURCE_UNUSED;
    for (size_t i = 0; i < triggers.size(); i++) {
        auto [kind, source, condition, every] = triggers[i];
        l.trigger[i] = {kind, source, condition, every};
    }
    l.feeds = (uint8_t)feeds.size();
    l.feds = (uint8_t)fed.size();
    for (size_t i = 0; i < feeds.size(); i++) {
        auto [kind, source, number, every, after_us] = feeds[i];
        l.feed[i] = {kind, source, number, every, after_us};
    }
    for (size_t i = 0; i < fed.size(); i++)
        l.fed[i] = {std::get<0>(fed[i]), std::get<1>(fed[i])};
    return l;
}

void bind_signals(nb::module_ &m) {
    m.attr("FRAME_SIGNALS") = (int)FRAME_SIGNALS;
    m.attr("FRAME_LOGIC") = (int)FRAME_LOGIC;
    m.attr("FRAME_READINGS") = (int)FRAME_READINGS;
    m.attr("PIECES") = PIECES;
    m.attr("PIECE_LONGEST_US") = PIECE_LONGEST_US;
    m.attr("BATCH_PIECES") = BATCH_PIECES;
    m.attr("GRAPH_NODES") = GRAPH_NODES;
    m.attr("READINGS") = READINGS;
    m.attr("SOURCE_OF_PIECES") = (int)SOURCE_OF_PIECES;
    m.attr("SOURCE_OF_INPUTS") = (int)SOURCE_OF_INPUTS;
    m.attr("SOURCE_OF_NODES") = (int)SOURCE_OF_NODES;
    m.attr("SOURCE_UNUSED") = (int)SOURCE_UNUSED;
    m.attr("INPUTS") =
        std::vector<std::string>{"position", "error",    "torque",   "supply",   "state",
                                 "digital0", "digital1", "digital2", "digital3", "lag"};
    m.attr("NODE_KINDS") =
        std::vector<std::string>{"add", "multiply", "compare", "window", "gate", "edge", "past"};
    m.attr("FEED_KINDS") = std::vector<std::string>{"ramp", "step"};
    m.attr("LOGIC_FEEDS") = LOGIC_FEEDS;
    m.attr("FEED_UNKNOWN_MS") = FEED_UNKNOWN_MS;
    m.attr("FRAME_FEED") = (int)FRAME_FEED;
    m.attr("TRIGGER_KINDS") = std::vector<std::string>{"interval", "edge", "window"};
    m.def("batch_encode", &encode_batch, "base_us"_a, "seen"_a, "pieces"_a);
    m.def(
        "logic_encode",
        [](uint32_t number, const std::vector<Node> &nodes, const std::vector<uint8_t> &digital,
           const std::vector<uint8_t> &pwm, const std::vector<Trigger> &triggers,
           const std::vector<Feed> &feeds, const std::vector<Fed> &fed) {
            logic l = logic_of(number, nodes, digital, pwm, triggers, feeds, fed);
            uint8_t payload[1000];
            return nb::bytes((const char *)payload,
                             (size_t)logic_encode(&l, payload, sizeof payload));
        },
        "number"_a, "nodes"_a, "digital"_a, "pwm"_a, "triggers"_a, "feeds"_a = std::vector<Feed>(),
        "fed"_a = std::vector<Fed>());
    m.def(
        "logic_check",
        [](const std::vector<Node> &nodes, const std::vector<uint8_t> &digital,
           const std::vector<uint8_t> &pwm, const std::vector<Trigger> &triggers,
           const std::vector<Feed> &feeds, const std::vector<Fed> &fed, int32_t knot_shift) {
            logic l = logic_of(1, nodes, digital, pwm, triggers, feeds, fed);
            int32_t wrong;
            if (knot_shift < 9 || knot_shift > 15)
                throw std::invalid_argument("a knot shift is from 9 to 15");
            std::string result = results[logic_check(&l, knot_shift, &wrong)];
            return std::make_tuple(result, wrong);
        },
        "nodes"_a, "digital"_a, "pwm"_a, "triggers"_a, "feeds"_a = std::vector<Feed>(),
        "fed"_a = std::vector<Fed>(), "knot_shift"_a = 15);
    nb::class_<report>(m, "Report")
        .def_ro("logic", &report::logic)
        .def_prop_ro("result", [](const report &r) { return std::string(results[r.result % 5]); })
        .def_ro("wrong", &report::wrong)
        .def_prop_ro(
            "next",
            [](const report &r) { return std::vector<uint32_t>(r.next, r.next + REPORT_TRACKS); })
        .def_ro("refused", &report::refused)
        .def_ro("late", &report::late)
        .def_ro("gaps", &report::gaps)
        .def_ro("kept", &report::kept)
        .def_ro("first", &report::first)
        .def_prop_ro("readings", [](const report &r) {
            std::vector<std::tuple<int64_t, int32_t, int>> found;
            for (int32_t i = 0; i < r.count; i++)
                found.emplace_back(r.readings[i].time_us, r.readings[i].value,
                                   r.readings[i].trigger);
            return found;
        });
    m.def("report_decode", [](nb::bytes payload) -> nb::object {
        report r{};
        if (!report_decode((const uint8_t *)payload.c_str(), (int32_t)payload.size(), &r))
            return nb::none();
        return nb::cast(r);
    });
    nb::class_<pieces>(m, "Pieces")
        .def(nb::init<>())
        .def_ro("next", &pieces::next)
        .def(
            "take",
            [](pieces &p, uint32_t number, const Piece &piece, int64_t now_us) {
                wanted_piece wanted = wanted_of(piece);
                return std::string(piece_results[pieces_take(&p, number, &wanted, now_us)]);
            },
            "number"_a, "piece"_a, "now_us"_a)
        .def(
            "at", [](const pieces &p, int64_t time_us) { return pieces_at(&p, time_us); },
            "time_us"_a)
        .def(
            "past",
            [](const pieces &p, int64_t time_us) -> std::optional<int32_t> {
                int32_t value;
                return pieces_past(&p, time_us, &value) ? std::optional(value) : std::nullopt;
            },
            "time_us"_a)
        .def("now", &pieces_now, "time_us"_a);
    nb::class_<graph>(m, "Graph")
        .def(
            "__init__",
            [](graph *g, const std::vector<Node> &nodes) {
                logic l = logic_of(1, nodes, {}, {}, {}, {}, {});
                int32_t wrong;
                if (logic_check(&l, 15, &wrong) != GRAPH_GOOD)
                    throw std::invalid_argument("a node is wrong: ask logic_check");
                new (g) graph{};
                g->count = l.nodes;
                for (int32_t i = 0; i < l.nodes; i++)
                    g->nodes[i] = l.node[i];
            },
            "nodes"_a)
        .def(
            "step",
            [](graph &g, const std::vector<int32_t> &given) {
                int32_t values[GRAPH_VALUES] = {0};
                for (size_t i = 0; i < given.size() && i < SOURCE_OF_NODES; i++)
                    values[i] = given[i];
                graph_step(&g, values);
                return std::vector<int32_t>(values + SOURCE_OF_NODES,
                                            values + SOURCE_OF_NODES + g.count);
            },
            "values"_a);
}
