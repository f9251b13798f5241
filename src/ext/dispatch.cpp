// Which set of vector instructions the lane kernels use: the best that this machine has, found out once.
#include "kernels.h"

#include <cstring>
#include <initializer_list>

namespace margcal {

namespace baseline {
extern const LaneKernels table;
}
#if defined(MARGCAL_X86_LANES)
namespace avx2 {
extern const LaneKernels table;
}
namespace avx512 {
extern const LaneKernels table;
}
#endif

const LaneKernels* lane_kernels(const char* name) {
    if (!std::strcmp(name, "baseline")) return &baseline::table;
#if defined(MARGCAL_X86_LANES)
    __builtin_cpu_init();
    if (!std::strcmp(name, "avx2") && __builtin_cpu_supports("avx2")) return &avx2::table;
    if (!std::strcmp(name, "avx512") && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512vl"))
        return &avx512::table;
#endif
    return nullptr;
}

namespace {

const LaneKernels* best() {
    for (const char* name : {"avx512", "avx2"})
        if (const LaneKernels* found = lane_kernels(name)) return found;
    return &baseline::table;
}

const LaneKernels*& chosen() {
    static const LaneKernels* kernels = best();
    return kernels;
}

}  // namespace

const LaneKernels& lane_kernels() { return *chosen(); }

bool choose_lanes(const char* name) {
    const LaneKernels* found = lane_kernels(name);
    if (found) chosen() = found;
    return found != nullptr;
}

}  // namespace margcal
