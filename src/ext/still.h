// Scatter of a recording in windows around given times: the test of stillness (workflow/segment.py).
#pragma once

#include "kernels.h"
#include "lanes.h"

#if defined(__AVX__)
#include <immintrin.h>
#endif

namespace margcal {
namespace MARGCAL_LEVEL {

constexpr std::size_t GLANCE = 8;  // times that are compared at once

// How many of GLANCE ascending times lie before the limit; without a branch to guess.
MARGCAL_INLINE std::size_t before(const double* t, double limit) {
#if defined(__AVX512F__)
    return std::size_t(__builtin_popcount(_mm512_cmp_pd_mask(_mm512_loadu_pd(t), _mm512_set1_pd(limit), _CMP_LT_OQ)));
#else
    std::size_t count = 0;
#if defined(__AVX__)
    const __m256d wide = _mm256_set1_pd(limit);
    for (std::size_t i = 0; i < GLANCE; i += 4)
        count += std::size_t(__builtin_popcount(
            unsigned(_mm256_movemask_pd(_mm256_cmp_pd(_mm256_loadu_pd(t + i), wide, _CMP_LT_OQ)))));
#else
    for (std::size_t i = 0; i < GLANCE; ++i) count += t[i] < limit;
#endif
    return count;
#endif
}

// The row from `row` on that is the first not before the limit.
MARGCAL_INLINE std::size_t walk(const double* t, std::size_t n, std::size_t row, double limit) {
    while (row + GLANCE <= n) {
        const std::size_t found = before(t + row, limit);
        row += found;
        if (found < GLANCE) return row;
    }
    while (row < n && t[row] < limit) ++row;
    return row;
}

// Rows of the window of each centre, lo[j] to hi[j]; the most that one has.
inline std::size_t window_rows(const double* t, std::size_t n, const double* centres, std::size_t m, double half,
                               std::size_t* lo, std::size_t* hi) {
    std::size_t first = 0, last = 0, longest = 0;
    for (std::size_t j = 0; j < m; ++j) {
        lo[j] = first = walk(t, n, first, centres[j] - half);
        hi[j] = last = walk(t, n, last, centres[j] + half);
        longest = last - first > longest ? last - first : longest;
    }
    return longest;
}

// x, y, z and their square summed over the rows before some row, in the order of NumPy's cumsum: differences of two of
// them agree with it. The last ones are kept in a ring of whole blocks, as many as the longest window needs.
class RunningSums {
public:
    RunningSums(const double* y, std::size_t n, const double* offset, double* ring, std::size_t mask)
        : y_(y), n_(n), ring_(ring), mask_(mask), offset_{offset[0], offset[1], offset[2]}, sum_{0, 0, 0, 0} {
        for (std::size_t i = 0; i < 4; ++i) place(0)[i] = 0;
    }

    MARGCAL_INLINE const double* before(std::size_t row) {
        while (filled_ < row) add_block();
        return place(row);
    }

private:
    static constexpr std::size_t AHEAD = 192;  // numbers; without it the sums wait for memory half of their time
    const double* y_;
    std::size_t n_;
    double* ring_;  // four a row
    std::size_t mask_, filled_ = 0;
    double offset_[3], sum_[4];

    // The sums before row 1 come first in the ring, those before row 0 last: so a block does not reach over its end.
    MARGCAL_INLINE double* place(std::size_t row) const { return ring_ + 4 * ((row - 1) & mask_); }

    void add_block() {
        const std::size_t stop = filled_ + SCATTER_BLOCK < n_ ? filled_ + SCATTER_BLOCK : n_;
        const double *row = y_ + 3 * filled_, *const end = y_ + 3 * stop;
        double* out = place(filled_ + 1);
        filled_ = stop;
#if defined(__AVX__)
        const __m256i three = _mm256_set_epi64x(0, -1, -1, -1);
        const __m256d offset = _mm256_maskload_pd(offset_, three);
        __m256d sum = _mm256_loadu_pd(sum_);
        for (; row < end; row += 3, out += 4) {
            __builtin_prefetch(row + AHEAD);
            const __m256d a = _mm256_sub_pd(_mm256_maskload_pd(row, three), offset), square = _mm256_mul_pd(a, a);
            const __m256d pairs = _mm256_add_pd(square, _mm256_permute_pd(square, 0b0101));
            const __m256d all = _mm256_add_pd(pairs, _mm256_permute2f128_pd(pairs, pairs, 1));
            sum = _mm256_add_pd(sum, _mm256_blend_pd(a, all, 0b1000));
            _mm256_storeu_pd(out, sum);
        }
        _mm256_storeu_pd(sum_, sum);
#else
        const double ox = offset_[0], oy = offset_[1], oz = offset_[2];
        double x = sum_[0], y = sum_[1], z = sum_[2], square = sum_[3];
        for (; row < end; row += 3, out += 4) {
            __builtin_prefetch(row + AHEAD);
            const double a = row[0] - ox, b = row[1] - oy, c = row[2] - oz;
            out[0] = x += a;
            out[1] = y += b;
            out[2] = z += c;
            out[3] = square += a * a + b * b + c * c;
        }
        sum_[0] = x, sum_[1] = y, sum_[2] = z, sum_[3] = square;
#endif
    }
};

// Windows of which the sums are known, before their scatter: quotients and roots of several at once.
struct Windows {
    static constexpr std::size_t SIZE = 64;
    double rows[SIZE], square[SIZE], sum[SIZE];  // number of rows, sum of squares, square of the sum

    MARGCAL_INLINE void scatter(std::size_t count, double enough, double* sd) const {
        for (std::size_t i = 0; i < count; ++i) {
            const double n = rows[i] > 1.0 ? rows[i] : 1.0;
            const double within = square[i] - sum[i] / n;
            const double positive = within < 0.0 ? 0.0 : within;  // written so that NaN stays NaN
            const double found = std::sqrt(positive / (n > 2.0 ? n - 1.0 : 1.0));
            sd[i] = rows[i] < enough ? __builtin_nan("") : found;
        }
    }
};

inline void scatter(const ScatterJob& job, const double* offset, double* ring, std::size_t mask, double* sd) {
    RunningSums sums(job.y, job.n, offset, ring, mask);
    Windows windows;
    for (std::size_t j = 0; j < job.m; j += Windows::SIZE) {
        const std::size_t count = job.m - j < Windows::SIZE ? job.m - j : Windows::SIZE;
        for (std::size_t i = 0; i < count; ++i) {
            const std::size_t lo = job.lo[j + i], hi = job.hi[j + i];
            const double *upto = sums.before(hi), *from = sums.before(lo);
            const double a = upto[0] - from[0], b = upto[1] - from[1], c = upto[2] - from[2];
            windows.rows[i] = double(std::int64_t(hi - lo));
            windows.square[i] = upto[3] - from[3];
            windows.sum[i] = a * a + b * b + c * c;
        }
        windows.scatter(count, job.enough, sd + j);
    }
}

}  // namespace MARGCAL_LEVEL
}  // namespace margcal
