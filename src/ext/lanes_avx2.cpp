// The lane kernels for avx2; see lanes.h.
#define MARGCAL_LEVEL avx2
#include "lanes_table.h"
