// Several doubles worked on at once, as many as the machine has in a register: eight with AVX-512, four with AVX, two
// with SSE2 or NEON. Plain gcc/clang vector types, so one source serves every machine.
//
// This header and those built on it are compiled several times, each time in a namespace of its own (MARGCAL_LEVEL):
// otherwise the linker could keep the AVX-512 copy of a function for a machine that has no AVX-512. For the same reason
// nothing here uses containers or other templates of the standard library.
#pragma once

#include "kernels.h"

#include <cmath>
#include <cstddef>
#include <cstdint>

#ifndef MARGCAL_LEVEL
#define MARGCAL_LEVEL baseline
#endif

namespace margcal {
namespace MARGCAL_LEVEL {

#if defined(__AVX512F__)
constexpr std::size_t LANES = 8;
#elif defined(__AVX__)
constexpr std::size_t LANES = 4;
#else
constexpr std::size_t LANES = 2;
#endif
static_assert(LANES <= MOST_LANES, "the scratch of the kernels is too small");

typedef double Lanes __attribute__((vector_size(sizeof(double) * LANES)));
typedef decltype(Lanes{} < Lanes{}) Mask;

#define MARGCAL_INLINE inline __attribute__((always_inline))

// Before a loop over rows or columns of small matrices: without it their places are worked out again and again.
#if defined(__clang__)
#define MARGCAL_UNROLL _Pragma("unroll")
#else
#define MARGCAL_UNROLL _Pragma("GCC unroll 8")
#endif

MARGCAL_INLINE Lanes fill(double x) { return Lanes{} + x; }

MARGCAL_INLINE Lanes load(const double* p) {
    Lanes v;
    __builtin_memcpy(&v, p, sizeof v);
    return v;
}

MARGCAL_INLINE void store(double* p, Lanes v) { __builtin_memcpy(p, &v, sizeof v); }

// One value a lane where the mask is set, the other elsewhere. The same names work on plain doubles, so that a filter is
// written once for one node and for eight.
MARGCAL_INLINE Lanes select(Mask mask, Lanes a, Lanes b) { return (Lanes)((mask & (Mask)a) | (~mask & (Mask)b)); }
MARGCAL_INLINE double select(bool mask, double a, double b) { return mask ? a : b; }

MARGCAL_INLINE Lanes square_root(Lanes v) {
    for (std::size_t i = 0; i < LANES; ++i) v[i] = std::sqrt(v[i]);
    return v;
}
MARGCAL_INLINE double square_root(double v) { return std::sqrt(v); }

MARGCAL_INLINE bool any(Mask m) {
    std::int64_t all = 0;
    for (std::size_t i = 0; i < LANES; ++i) all |= m[i];
    return all != 0;
}
MARGCAL_INLINE bool any(bool m) { return m; }
MARGCAL_INLINE Mask no(Mask m) { return ~m; }
MARGCAL_INLINE bool no(bool m) { return !m; }

template <class Real> using Bool = decltype(Real{} < Real{});

// A number in every lane, for either type.
template <class Real> MARGCAL_INLINE Real splat(double x);
template <> MARGCAL_INLINE double splat<double>(double x) { return x; }
template <> MARGCAL_INLINE Lanes splat<Lanes>(double x) { return fill(x); }

// A function of the mathematical library, lane by lane: for what is rare.
template <class Function> MARGCAL_INLINE double each(double a, Function f) { return f(a); }
template <class Function> MARGCAL_INLINE Lanes each(Lanes a, Function f) {
    for (std::size_t i = 0; i < LANES; ++i) a[i] = f(a[i]);
    return a;
}
template <class Function> MARGCAL_INLINE double each(double a, double b, Function f) { return f(a, b); }
template <class Function> MARGCAL_INLINE Lanes each(Lanes a, Lanes b, Function f) {
    for (std::size_t i = 0; i < LANES; ++i) a[i] = f(a[i], b[i]);
    return a;
}

template <class Real> MARGCAL_INLINE Real least(Real a, Real b) { return select(a < b, a, b); }
template <class Real> MARGCAL_INLINE Real greatest(Real a, Real b) { return select(a > b, a, b); }
template <class Real> MARGCAL_INLINE Real absolute(Real a) { return select(a < splat<Real>(0), -a, a); }

}  // namespace MARGCAL_LEVEL
}  // namespace margcal
