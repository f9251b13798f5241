// Steps of a clock on both sides of a bracket: for their median (median.cpp).
#pragma once

#include "kernels.h"
#include "lanes.h"

#if defined(__AVX512F__)
#include <immintrin.h>
#endif

namespace margcal {
namespace MARGCAL_LEVEL {

// Those of the bracket's inside are set apart in `inside`; the place after the last.
MARGCAL_INLINE double* set_apart(const double* t, double low, double high, double* inside) {
#if defined(__AVX512F__)
    const __m512d step = _mm512_sub_pd(_mm512_loadu_pd(t + 1), _mm512_loadu_pd(t));
    const __mmask8 kept = _mm512_mask_cmp_pd_mask(_mm512_cmp_pd_mask(step, _mm512_set1_pd(low), _CMP_GT_OQ), step,
                                                  _mm512_set1_pd(high), _CMP_LT_OQ);
    _mm512_mask_compressstoreu_pd(inside, kept, step);
    return inside + __builtin_popcount(kept);
#else
    for (std::size_t i = 0; i < LANES; ++i) {
        const double step = t[i + 1] - t[i];
        *inside = step;
        inside += (step > low) & (step < high);
    }
    return inside;
#endif
}

inline std::size_t sum(Mask m) {
    std::int64_t all = 0;
    for (std::size_t i = 0; i < LANES; ++i) all -= m[i];
    return std::size_t(all);
}

inline StepCounts count_steps(const double* t, std::size_t steps, double low, double high, double* inside) {
    Mask below{}, upto_low{}, above{}, forward{};  // minus one for each step that is
    double* end = inside;
    std::size_t k = 0;
    for (; k + LANES <= steps; k += LANES) {
        const Lanes step = load(t + k + 1) - load(t + k);
        below += step < fill(low);
        upto_low += step <= fill(low);
        above += step > fill(high);
        forward += step >= fill(0);
        end = set_apart(t + k, low, high, end);
    }
    StepCounts found{sum(below), sum(upto_low), 0, sum(above), sum(forward)};
    for (; k < steps; ++k) {
        const double step = t[k + 1] - t[k];
        found.below += step < low;
        found.upto_low += step <= low;
        found.above += step > high;
        found.forward += step >= 0;
        *end = step;
        end += (step > low) & (step < high);
    }
    found.inside = std::size_t(end - inside);
    return found;
}

}  // namespace MARGCAL_LEVEL
}  // namespace margcal
