// The lane kernels for baseline; see lanes.h.
#define MARGCAL_LEVEL baseline
#include "lanes_table.h"
