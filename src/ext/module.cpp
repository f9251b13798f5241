// margcal.core._ext: the compiled kernels for Python. Results go into arrays that the caller brings; every argument is
// checked, and every loop runs without the interpreter's lock. What they compute is said, and computed a second time, by
// the NumPy functions beside each call (see core/compiled.py).
#include "arrays.h"
#include "kernels.h"

#include <nanobind/stl/string.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <string>
#include <vector>

namespace margcal {
namespace {

void bind_apply(const In& y, const In& H, const In& B, const Out& out) {
    const double* readings = need<const double>(y, "y", {ANY, 3});
    const auto n = std::int64_t(y.shape(0));
    const double *matrix = need<const double>(H, "H", {3, 3}), *bias = need<const double>(B, "B", {3});
    double* u = need<double>(out, "out", {n, 3});
    nb::gil_scoped_release unlocked;
    lane_kernels().apply(readings, std::size_t(n), matrix, bias, u);
}

void need_ascending(const double* t, std::size_t n, const char* name) {
    bool ascending = n == 0 || (std::isfinite(t[0]) && std::isfinite(t[n - 1]));
    for (std::size_t i = 1; i < n; ++i) ascending &= t[i] >= t[i - 1];
    if (!ascending) throw nb::value_error((std::string(name) + ": times must be finite and not run backwards").c_str());
}

// Mean of at most some thousand rows all over the recording.
void mean_row(const double* y, std::size_t n, double mean[3]) {
    const std::size_t step = 1 + n / 1024;
    std::size_t rows = 0;
    mean[0] = mean[1] = mean[2] = 0;
    for (std::size_t i = 0; i < n; i += step, ++rows)
        for (std::size_t k = 0; k < 3; ++k) mean[k] += y[3 * i + k];
    for (std::size_t k = 0; k < 3; ++k) mean[k] /= double(rows);
}

void bind_moving_scatter(const In& t, const In& y, const In& centres, double width, const Out& sd) {
    const double* time = need<const double>(t, "t", {ANY});
    const auto n = std::int64_t(t.shape(0)), m = std::int64_t(centres.size());
    const double* readings = need<const double>(y, "y", {n, 3});
    const double* middle = need<const double>(centres, "centres", {ANY});
    double* scatter = need<double>(sd, "sd", {m});
    if (n < 2) throw nb::value_error("t: at least two samples are needed");
    if (!(width > 0)) throw nb::value_error("width: must be positive");
    nb::gil_scoped_release unlocked;
    const std::unique_ptr<double[]> work(new double[std::size_t(n) + MOST_LANES]);
    const double usual = median_step(time, std::size_t(n), work.get());
    if (usual != usual) throw nb::value_error("t: times must be finite and not run backwards");
    need_ascending(middle, std::size_t(m), "centres");
    const LaneKernels& kernels = lane_kernels();
    const std::unique_ptr<std::size_t[]> rows(new std::size_t[std::size_t(2 * m)]);
    ScatterJob job{readings, std::size_t(n), rows.get(), rows.get() + m, std::size_t(m), 0};
    const std::size_t longest =
        kernels.window_rows(time, job.n, middle, job.m, width / 2, rows.get(), rows.get() + m);
    std::size_t size = 1;
    while (size < longest + SCATTER_BLOCK + 1) size *= 2;
    const std::unique_ptr<double[]> ring(new double[4 * size]);
    const double half_of_usual = 0.5 * (width / usual);
    job.enough = half_of_usual > 4 ? half_of_usual : 4;
    double offset[3];
    mean_row(readings, job.n, offset);
    kernels.scatter(job, offset, ring.get(), size - 1, scatter);
}

// Samples of a turn without the padding (no interval) at its end.
std::size_t true_length(const double* dt, std::size_t n) {
    while (n > 1 && dt[n - 1] == 0) --n;
    return n;
}

void bind_integrate(const In& y, const In& dt, const In& H, const In& B, const In& turn, const In& sensor, const Out& out) {
    const double* interval = need<const double>(dt, "dt", {ANY, ANY});
    const auto turns = std::int64_t(dt.shape(0)), n = std::int64_t(dt.shape(1));
    const double* readings = need<const double>(y, "y", {turns, n, 3});
    const double* matrix = need<const double>(H, "H", {ANY, 3, 3});
    const auto sensors = std::int64_t(H.shape(0));
    const double* bias = need<const double>(B, "B", {sensors, 3});
    const std::int64_t* of_turn = need<const std::int64_t>(turn, "turn", {ANY});
    const auto wanted = std::int64_t(turn.shape(0));
    const std::int64_t* of_sensor = need<const std::int64_t>(sensor, "sensor", {wanted});
    double* q = need<double>(out, "out", {wanted, 4});
    if (n < 1) throw nb::value_error("y: a turn needs at least one sample");
    std::vector<std::int64_t> start(std::size_t(turns + 1), 0), order(static_cast<std::size_t>(wanted));
    for (std::int64_t k = 0; k < wanted; ++k) {
        if (of_turn[k] < 0 || of_turn[k] >= turns) throw nb::index_error("turn: there is no turn of that index");
        if (of_sensor[k] < 0 || of_sensor[k] >= sensors) throw nb::index_error("sensor: there is no H of that index");
        ++start[std::size_t(of_turn[k]) + 1];
    }
    nb::gil_scoped_release unlocked;
    // what is asked of one turn comes together: its samples are laid out once
    for (std::int64_t j = 0; j < turns; ++j) start[std::size_t(j) + 1] += start[std::size_t(j)];
    std::vector<std::int64_t> place(start);
    for (std::int64_t k = 0; k < wanted; ++k) order[std::size_t(place[std::size_t(of_turn[k])]++)] = k;
    const LaneKernels& kernels = lane_kernels();
    std::vector<double> packed(packed_size(std::size_t(n)));
    for (std::int64_t j = 0; j < turns; ++j) {
        if (start[std::size_t(j)] == start[std::size_t(j) + 1]) continue;
        const std::size_t length = true_length(interval + j * n, std::size_t(n));
        kernels.pack({readings + 3 * j * n, interval + j * n, length}, packed.data());
        for (auto i = start[std::size_t(j)]; i < start[std::size_t(j) + 1]; ++i) {
            const std::int64_t k = order[std::size_t(i)];
            kernels.integrate(packed.data(), length, {matrix + 9 * of_sensor[k], bias + 3 * of_sensor[k]}, q + 4 * k);
        }
    }
}

void bind_preintegrate(const In& y, const In& dt, const In& H, const In& B, const In& noise, const Out& dR, const Out& J_H,
                       const Out& J_B, const Out& C) {
    const double* interval = need<const double>(dt, "dt", {ANY, ANY});
    const auto turns = std::int64_t(dt.shape(0)), n = std::int64_t(dt.shape(1));
    const double* readings = need<const double>(y, "y", {turns, n, 3});
    const SensorView sensor{need<const double>(H, "H", {3, 3}), need<const double>(B, "B", {3})};
    const double* covariance = need<const double>(noise, "noise", {3, 3});
    double *rotation = need<double>(dR, "dR", {turns, 3, 3}), *by_H = need<double>(J_H, "J_H", {turns, 3, 9});
    double *by_B = need<double>(J_B, "J_B", {turns, 3, 3}), *spread = need<double>(C, "C", {turns, 3, 3});
    if (n < 1) throw nb::value_error("y: a turn needs at least one sample");
    nb::gil_scoped_release unlocked;
    const LaneKernels& kernels = lane_kernels();
    std::vector<double> packed(packed_size(std::size_t(n)));
    for (std::int64_t j = 0; j < turns; ++j) {
        const std::size_t length = true_length(interval + j * n, std::size_t(n));
        Rotation found;
        kernels.pack({readings + 3 * j * n, interval + j * n, length}, packed.data());
        kernels.preintegrate(packed.data(), length, sensor, covariance, found);
        std::copy(found.dR, found.dR + 9, rotation + 9 * j);
        std::copy(found.J_H, found.J_H + 27, by_H + 27 * j);
        std::copy(found.J_B, found.J_B + 9, by_B + 9 * j);
        std::copy(found.C, found.C + 9, spread + 9 * j);
    }
}

// A filter's batch: NUMBERS parameters and MEMORY doubles of state a node.
template <void (*LaneKernels::*FILTER)(const FilterJob&), std::int64_t NUMBERS, std::int64_t MEMORY>
void bind_filter(const In& params, const Out& state, const In& dt, const In& gyr, const In& acc, const In& mag,
                 const Out& q, const Out& variance, const Out& flags, bool one_by_one) {
    FilterJob job;
    job.dt = need<const double>(dt, "dt", {ANY, ANY});
    const auto nodes = std::int64_t(dt.shape(0)), n = std::int64_t(dt.shape(1));
    job.nodes = std::size_t(nodes);
    job.samples = std::size_t(n);
    job.params = need<const double>(params, "params", {nodes, NUMBERS});
    job.state = need<double>(state, "state", {nodes, MEMORY});
    job.gyr = need<const double>(gyr, "gyr", {nodes, n, 3});
    job.acc = need<const double>(acc, "acc", {nodes, n, 3});
    job.mag = need<const double>(mag, "mag", {nodes, n, 3});
    job.q = need<double>(q, "q", {nodes, n, 4});
    job.variance = need<double>(variance, "variance", {nodes, n, 3});
    job.flags = need<std::uint8_t>(flags, "flags", {nodes, n});
    job.one_by_one = one_by_one;
    nb::gil_scoped_release unlocked;
    (lane_kernels().*FILTER)(job);
}

template <class Function> void define_filter(nb::module_& m, const char* name, Function function) {
    using namespace nb::literals;
    m.def(name, function, "params"_a, "state"_a, "dt"_a, "gyr"_a, "acc"_a, "mag"_a, "q"_a, "variance"_a, "flags"_a,
          "one_by_one"_a = false);
}

void bind_use_lanes(const std::string& name) {
    if (!choose_lanes(name.c_str()))
        throw nb::value_error(("this machine has no lanes called " + name).c_str());
}

}  // namespace
}  // namespace margcal

NB_MODULE(_ext, m) {
    using namespace nb::literals;
    using namespace margcal;
    m.doc() = "Compiled kernels of margcal; reach them through margcal.core.compiled.";
    m.def("apply", &bind_apply, "y"_a, "H"_a, "B"_a, "out"_a);
    m.def("moving_scatter", &bind_moving_scatter, "t"_a, "y"_a, "centres"_a, "width"_a, "sd"_a);
    m.def("integrate", &bind_integrate, "y"_a, "dt"_a, "H"_a, "B"_a, "turn"_a, "sensor"_a, "out"_a);
    m.def("preintegrate", &bind_preintegrate, "y"_a, "dt"_a, "H"_a, "B"_a, "noise"_a, "dR"_a, "J_H"_a, "J_B"_a, "C"_a);
    define_filter(m, "ekf_quest", &bind_filter<&LaneKernels::ekf_quest, 10, 56>);
    define_filter(m, "vector_selection", &bind_filter<&LaneKernels::vector_selection, 11, 13>);
    define_filter(m, "strapdown", &bind_filter<&LaneKernels::strapdown, 3, 7>);
    m.def("lanes", [] { return lane_kernels().name; });
    m.def("use_lanes", &bind_use_lanes, "name"_a);
}
