// The lane kernels for avx512; see lanes.h.
#define MARGCAL_LEVEL avx512
#include "lanes_table.h"
