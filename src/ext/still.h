// Scatter of a recording in windows around given times: the test of stillness (workflow/segment.py).
#pragma once

#include "kernels.h"
#include "lanes.h"

namespace margcal {
namespace MARGCAL_LEVEL {

// Number of times before centre + shift, for each centre; several are compared at once, without a branch to guess.
inline void rows_before(const double* t, std::size_t n, const double* centres, std::size_t m, double shift,
                        std::size_t* rows) {
    std::size_t k = 0;
    for (std::size_t j = 0; j < m; ++j) {
        const double limit = centres[j] + shift;
        std::size_t found = LANES;
        while (found == LANES && k + LANES <= n) {
            const Mask before = load(t + k) < fill(limit);
            std::int64_t count = 0;
            for (std::size_t i = 0; i < LANES; ++i) count -= before[i];
            found = std::size_t(count);
            k += found;
        }
        while (k + LANES > n && k < n && t[k] < limit) ++k;
        rows[j] = k;
    }
}

// Mean of all rows: it is taken off first, so that sums of squares stay small beside their variance.
inline void mean_row(const double* y, std::size_t n, double mean[3]) {
    double sum[12] = {};
    std::size_t i = 0;
    for (; i + 4 <= n; i += 4)
        for (std::size_t k = 0; k < 12; ++k) sum[k] += y[3 * i + k];
    for (; i < n; ++i)
        for (std::size_t k = 0; k < 3; ++k) sum[k] += y[3 * i + k];
    for (std::size_t k = 0; k < 3; ++k) mean[k] = (sum[k] + sum[k + 3] + sum[k + 6] + sum[k + 9]) / double(n);
}

// x, y, z and their square summed over the rows before some row, in the order of NumPy's cumsum: differences of two of
// them agree with it. The last ones are kept in a ring, as many as the longest window needs.
struct RunningSums {
    const double* y;
    const double* offset;
    std::size_t n;
    double* ring;  // four a row
    std::size_t mask;
    std::size_t filled = 0;

    const double* before(std::size_t row) {
        while (filled < row) {
            const std::size_t stop = filled + SCATTER_BLOCK < n ? filled + SCATTER_BLOCK : n;
            const double* last = ring + 4 * (filled & mask);
            double x = last[0], y_ = last[1], z = last[2], square = last[3];
            while (filled < stop) {
                const double* r = y + 3 * filled;
                const double a = r[0] - offset[0], b = r[1] - offset[1], c = r[2] - offset[2];
                double* place = ring + 4 * (++filled & mask);
                place[0] = x += a;
                place[1] = y_ += b;
                place[2] = z += c;
                place[3] = square += a * a + b * b + c * c;
            }
        }
        return ring + 4 * (row & mask);
    }
};

inline void scatter(const double* y, std::size_t n, const std::size_t* lo, const std::size_t* hi, std::size_t m,
                    double expected, double* ring, std::size_t mask, double* sd, double* mean) {
    double offset[3];
    mean_row(y, n, offset);
    RunningSums sums{y, offset, n, ring, mask};
    for (std::size_t j = 0; j < m; ++j) {
        const double *upto = sums.before(hi[j]), *before = sums.before(lo[j]);
        const double rows = double(hi[j] - lo[j]), count = rows > 1 ? rows : 1.0;
        const double a = (upto[0] - before[0]) / count, b = (upto[1] - before[1]) / count;
        const double c = (upto[2] - before[2]) / count, square = (upto[3] - before[3]) / count;
        mean[3 * j] = a;
        mean[3 * j + 1] = b;
        mean[3 * j + 2] = c;
        const double variance = square - (a * a + b * b + c * c);
        const double positive = variance < 0.0 ? 0.0 : variance;  // written so that NaN stays NaN
        const bool few = rows < 4 || rows < 0.5 * expected;
        sd[j] = few ? __builtin_nan("") : std::sqrt(positive * count / (count > 2 ? count - 1 : 1.0));
    }
}

}  // namespace MARGCAL_LEVEL
}  // namespace margcal
