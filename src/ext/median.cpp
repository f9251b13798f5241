// The usual step of a clock.
#include "kernels.h"

#include <algorithm>
#include <limits>

namespace margcal {

// Two values of a sample between which the median of all steps lies, most likely.
static void bracket(const double* t, std::size_t steps, double* low, double* high) {
    constexpr std::size_t SAMPLE = 512, MARGIN = 48;  // four standard deviations of the sample's median
    double some[SAMPLE];
    for (std::size_t i = 0; i < SAMPLE; ++i) {
        const std::size_t k = i * (steps - 1) / (SAMPLE - 1);
        some[i] = t[k + 1] - t[k];
    }
    std::sort(some, some + SAMPLE);
    *low = some[SAMPLE / 2 - MARGIN];
    *high = some[SAMPLE / 2 + MARGIN];
}

double median_step(const double* t, std::size_t n, double* work) {
    const std::size_t steps = n - 1, first = (steps - 1) / 2, second = steps / 2;  // ranks of the middle
    std::size_t below = 0, kept = 0;
    double low = 0, high = std::numeric_limits<double>::infinity();  // steps are never negative
    if (steps > 4096) bracket(t, steps, &low, &high);
    for (int attempt = 0; attempt < 2; ++attempt) {
        below = kept = 0;
        for (std::size_t i = 0; i < steps; ++i) {
            const double step = t[i + 1] - t[i];
            work[kept] = step;
            kept += (step >= low) & (step <= high);
            below += step < low;
        }
        if (below <= first && second < below + kept) break;
        low = 0;
        high = std::numeric_limits<double>::infinity();
    }
    if (below > first || second >= below + kept) return std::numeric_limits<double>::quiet_NaN();
    double* middle = work + (second - below);
    std::nth_element(work, middle, work + kept);
    if (first == second) return *middle;
    return 0.5 * (*std::max_element(work, middle) + *middle);
}

}  // namespace margcal
