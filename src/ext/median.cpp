// The usual step of a clock.
#include "kernels.h"

#include <algorithm>
#include <cmath>
#include <limits>

namespace margcal {
namespace {

constexpr std::size_t SAMPLE = 4096, MARGIN = 128;  // four standard deviations of the rank of the sample's median

// Two values of a sample between which the median of all steps lies, most likely.
void bracket(const double* t, std::size_t steps, double* low, double* high) {
    double some[SAMPLE];
    for (std::size_t i = 0; i < SAMPLE; ++i) {
        const std::size_t k = i * (steps - 1) / (SAMPLE - 1);
        const double step = t[k + 1] - t[k];
        some[i] = step >= 0 ? step : 0;  // NaN has no place in an order
    }
    std::nth_element(some, some + SAMPLE / 2 + MARGIN, some + SAMPLE);
    *high = some[SAMPLE / 2 + MARGIN];
    std::nth_element(some, some + SAMPLE / 2 - MARGIN, some + SAMPLE / 2 + MARGIN);
    *low = some[SAMPLE / 2 - MARGIN];
}

bool holds(const StepCounts& counts, std::size_t steps, std::size_t rank) {
    return counts.below <= rank && rank < steps - counts.above;
}

}  // namespace

double median_step(const double* t, std::size_t n, double* work) {
    const double nan = std::numeric_limits<double>::quiet_NaN();
    const std::size_t steps = n - 1, first = (steps - 1) / 2, second = steps / 2;  // ranks of the middle
    double low = -1.0, high = std::numeric_limits<double>::infinity();
    if (!std::isfinite(t[0]) || !std::isfinite(t[n - 1])) return nan;
    if (steps > 2 * SAMPLE) bracket(t, steps, &low, &high);
    StepCounts counts = lane_kernels().count_steps(t, steps, low, high, work);
    if (counts.forward != steps) return nan;
    if (!holds(counts, steps, first) || !holds(counts, steps, second)) {
        low = -1.0;
        high = std::numeric_limits<double>::infinity();
        counts = lane_kernels().count_steps(t, steps, low, high, work);
    }
    const auto ranked = [&](std::size_t rank) {
        if (rank < counts.upto_low) return low;
        if (rank >= counts.upto_low + counts.inside) return high;
        double* const middle = work + (rank - counts.upto_low);
        std::nth_element(work, middle, work + counts.inside);
        return *middle;
    };
    const double upper = ranked(second);
    if (first == second) return upper;
    // below the one of the upper rank nth_element has left the smaller ones
    const bool beside = first >= counts.upto_low && second < counts.upto_low + counts.inside;
    const double lower = beside ? *std::max_element(work, work + (second - counts.upto_low)) : ranked(first);
    return 0.5 * (lower + upper);
}

}  // namespace margcal
