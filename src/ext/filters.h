// What the filters have in common (methods/tracking.py): one sample of one node or of several, its flags, and the loop
// over a recording.
#pragma once

#include "kernels.h"
#include "quaternion.h"

namespace margcal {
namespace MARGCAL_LEVEL {

constexpr double FLAG_ACC = 1, FLAG_MAG = 2, FLAG_NO_GYR = 4, FLAG_GAP = 8;
constexpr double LONGEST_STEP = 10.0, SHORTEST_STEP = 1e-9, FASTEST = 1000.0;

template <class Real> struct Reading {
    Real dt, gyr[3], acc[3], mag[3];
};

template <class Real> MARGCAL_INLINE Real when(Bool<Real> mask, double x) {
    return select(mask, splat<Real>(x), splat<Real>(0));
}

// Seconds since the sample before, between nothing and LONGEST_STEP; NaN is nothing.
template <class Real> MARGCAL_INLINE Real usable_step(Real dt) {
    const Real positive = select(dt > splat<Real>(0), dt, splat<Real>(0));
    return least(positive, splat<Real>(LONGEST_STEP));
}

template <class Real> MARGCAL_INLINE Bool<Real> is_finite(Real x) { return absolute(x) < splat<Real>(__builtin_inf()); }

// Whether a reading of the gyroscope is a rate (not NaN, nor faster than any node turns).
template <class Real> MARGCAL_INLINE Bool<Real> measured_rate(const Real v[3]) {
    const Real limit = splat<Real>(FASTEST);
    return (absolute(v[0]) < limit) & (absolute(v[1]) < limit) & (absolute(v[2]) < limit);
}

// Lane i of a value of either type.
MARGCAL_INLINE double lane(const double& x, std::size_t) { return x; }
MARGCAL_INLINE double lane(const Lanes& x, std::size_t i) { return x[i]; }
MARGCAL_INLINE void set_lane(double& x, std::size_t, double value) { x = value; }
MARGCAL_INLINE void set_lane(Lanes& x, std::size_t i, double value) { x[i] = value; }

// One array of several nodes: where each node's part begins.
template <class T, std::size_t COUNT> struct Parts {
    T* begin[COUNT];

    Parts(T* base, const std::size_t* node, std::size_t stride) {
        for (std::size_t i = 0; i < COUNT; ++i) begin[i] = base + node[i] * stride;
    }
    template <class Real> MARGCAL_INLINE Real get(std::size_t place) const {
        Real v = splat<Real>(0);
        for (std::size_t i = 0; i < COUNT; ++i) set_lane(v, i, begin[i][place]);
        return v;
    }
    template <class Real> MARGCAL_INLINE void put(std::size_t place, const Real& v) const {
        for (std::size_t i = 0; i < COUNT; ++i) begin[i][place] = T(lane(v, i));
    }
};

// All samples of as many nodes as Real has lanes; a node that is named twice is worked out, and written, twice.
template <class Filter, class Real> inline void filter_nodes(const FilterJob& job, const std::size_t* node) {
    constexpr std::size_t COUNT = sizeof(Real) / sizeof(double);
    using In = Parts<const double, COUNT>;
    using Out = Parts<double, COUNT>;
    const std::size_t n = job.samples;
    const In dt(job.dt, node, n), gyr(job.gyr, node, 3 * n), acc(job.acc, node, 3 * n), mag(job.mag, node, 3 * n);
    const Out q(job.q, node, 4 * n), variance(job.variance, node, 3 * n), memory(job.state, node, Filter::STATE);
    const In numbers(job.params, node, Filter::PARAMS);
    const Parts<std::uint8_t, COUNT> flags(job.flags, node, n);

    Filter filter;
    Real params[Filter::PARAMS], state[Filter::STATE];
    for (std::size_t i = 0; i < Filter::PARAMS; ++i) params[i] = numbers.template get<Real>(i);
    for (std::size_t i = 0; i < Filter::STATE; ++i) state[i] = memory.template get<Real>(i);
    filter.begin(params, state);
    for (std::size_t k = 0; k < n; ++k) {
        Reading<Real> reading;
        reading.dt = dt.template get<Real>(k);
        for (std::size_t c = 0; c < 3; ++c) {
            reading.gyr[c] = gyr.template get<Real>(3 * k + c);
            reading.acc[c] = acc.template get<Real>(3 * k + c);
            reading.mag[c] = mag.template get<Real>(3 * k + c);
        }
        flags.put(k, filter.step(reading));
        const Quaternion<Real> attitude = filter.attitude();
        q.put(4 * k, attitude.w);
        q.put(4 * k + 1, attitude.x);
        q.put(4 * k + 2, attitude.y);
        q.put(4 * k + 3, attitude.z);
        Real spread[3];
        filter.variance(spread);
        for (std::size_t c = 0; c < 3; ++c) variance.put(3 * k + c, spread[c]);
    }
    filter.end(state);
    for (std::size_t i = 0; i < Filter::STATE; ++i) memory.put(i, state[i]);
}

// As many nodes at a time as there are lanes; a few that are left over one by one, by ONE.
template <template <class> class Filter, void (*ONE)(const FilterJob&, std::size_t)>
inline void filter_all(const FilterJob& job) {
    std::size_t node[LANES];
    for (std::size_t first = 0; first < job.nodes;) {
        const std::size_t left = job.nodes - first, lanes = left < LANES ? left : LANES;
        for (std::size_t i = 0; i < LANES; ++i) node[i] = first + (i < lanes ? i : lanes - 1);
        if (2 * lanes <= LANES || job.one_by_one) {
            ONE(job, first);
            first += 1;
        } else {
            filter_nodes<Filter<Lanes>, Lanes>(job, node);
            first += lanes;
        }
    }
}

template <template <class> class Filter> inline void filter_one(const FilterJob& job, std::size_t node) {
    filter_nodes<Filter<double>, double>(job, &node);
}

}  // namespace MARGCAL_LEVEL
}  // namespace margcal
