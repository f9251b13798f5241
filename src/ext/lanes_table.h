// The table of the lane kernels of one level; included at the end of each lanes_*.cpp.
#include "ekf_quest_one.h"
#include "rows.h"
#include "selection.h"
#include "steps.h"
#include "still.h"
#include "strapdown.h"
#include "turns.h"

namespace margcal {
namespace MARGCAL_LEVEL {

#define MARGCAL_TEXT_(x) #x
#define MARGCAL_TEXT(x) MARGCAL_TEXT_(x)
#if defined(__AVX__)
constexpr auto ekf_one = ekf_quest_one;
#else  // too many of its vectors would be split
constexpr auto ekf_one = filter_one<EkfQuest>;
#endif

extern const LaneKernels table;
const LaneKernels table = {MARGCAL_TEXT(MARGCAL_LEVEL), apply, count_steps, window_rows, scatter,
                           pack, integrate, preintegrate, filter_all<EkfQuest, ekf_one>,
                           filter_all<VectorSelection, filter_one<VectorSelection>>,
                           filter_all<Strapdown, filter_one<Strapdown>>};

}  // namespace MARGCAL_LEVEL
}  // namespace margcal
