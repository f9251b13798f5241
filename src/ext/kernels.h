// What the kernels offer. Arrays are C-contiguous doubles, samples first, components last; the caller (module.cpp) has
// checked every size. No kernel touches Python, so all of them run without the interpreter's lock.
#pragma once

#include <cstddef>
#include <cstdint>

namespace margcal {

// Median of the n - 1 steps of t, NaN unless times are finite and do not run backwards; work holds n + MOST_LANES
// doubles.
double median_step(const double* t, std::size_t n, double* work);

// One turn and the hypotheses to integrate it with.
struct TurnView {
    const double* y;   // (n, 3) raw readings
    const double* dt;  // (n,) s
    std::size_t n;
};
struct SensorView {
    const double* H;  // (3, 3)
    const double* B;  // (3,)
};

constexpr std::size_t MOST_LANES = 8;

// Doubles of scratch that `pack` needs for a turn of n samples.
constexpr std::size_t packed_size(std::size_t n) { return 4 * (n + MOST_LANES); }

// Rotation of a turn and what it does when H, B or the readings change a little (see preintegration.py).
struct Rotation {
    double dR[9], J_H[27], J_B[9], C[9];
};

// Nodes side by side through an orientation filter; arrays start with the node, then the sample. `state` is what the
// filter remembers, before and after; `one_by_one` leaves the lanes out.
struct FilterJob {
    std::size_t nodes, samples;
    const double* params;
    double* state;
    const double *dt, *gyr, *acc, *mag;
    double *q, *variance;
    std::uint8_t* flags;
    bool one_by_one;
};

constexpr std::size_t SCATTER_BLOCK = 256;

// Windows of a recording, rows lo[j] to hi[j] of y (n, 3), of which each needs at least `enough` rows.
struct ScatterJob {
    const double* y;
    std::size_t n;
    const std::size_t *lo, *hi;
    std::size_t m;
    double enough;
};

// How many steps of a clock are less than a bracket's lower value, not more, inside (both values left out), more than
// the upper one; and how many do not run backwards.
struct StepCounts {
    std::size_t below, upto_low, inside, above, forward;
};

// Kernels that exist once for every set of vector instructions.
struct LaneKernels {
    const char* name;
    // u = H (y - B) for n rows of three; u may be y itself
    void (*apply)(const double* y, std::size_t n, const double* H, const double* B, double* u);
    // Steps inside the bracket are set apart in `inside`, which holds MOST_LANES more than there are steps.
    StepCounts (*count_steps)(const double* t, std::size_t steps, double low, double high, double* inside);
    // lo[j], hi[j]: the rows whose (ascending) times lie from centres[j] - half to centres[j] + half, which ascend too;
    // returns the most rows of one window
    std::size_t (*window_rows)(const double* t, std::size_t n, const double* centres, std::size_t m, double half,
                               std::size_t* lo, std::size_t* hi);
    // Scatter of each window (norm over the axes), NaN where it has too few rows. `offset` (3,) is a value near the
    // readings. The ring is scratch, mask + 1 times four doubles; mask + 1, a power of two, is more than the rows of the
    // longest window and SCATTER_BLOCK together.
    void (*scatter)(const ScatterJob& job, const double* offset, double* ring, std::size_t mask, double* sd);
    void (*pack)(const TurnView& turn, double* packed);
    void (*integrate)(const double* packed, std::size_t n, const SensorView& sensor, double q[4]);
    void (*preintegrate)(const double* packed, std::size_t n, const SensorView& sensor, const double noise[9],
                         Rotation& out);
    void (*ekf_quest)(const FilterJob& job);
    void (*vector_selection)(const FilterJob& job);
    void (*strapdown)(const FilterJob& job);
};

// The best that this machine can run, or the one of that name (nullptr if it has none such).
const LaneKernels& lane_kernels();
const LaneKernels* lane_kernels(const char* name);
// Choose one for the rest of the process; false if this machine has none of that name.
bool choose_lanes(const char* name);

}  // namespace margcal
