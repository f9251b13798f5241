"""Z-TIE, section III, as it is printed: Tables I and II; and how its noise was read."""

from __future__ import annotations

import math

TABLE_I = {
    # iteration: |H_a error| optimisation, ours; |u_a error| optimisation, ours (mean, standard deviation)
    2: ((2.5249, 0.2518), (0.1701, 0.0965), (11.8281, 0.0256), (1.3178, 0.7496)),
    5: ((6.8363, 2.4015), (0.0586, 0.0338), (36.5101, 14.1615), (0.4349, 0.2572)),
    10: ((6.2825, 2.3289), (0.0212, 0.0066), (36.1387, 13.0760), (0.0502, 0.0203)),
    15: ((1.7143, 1.8538), (0.0149, 0.0022), (9.0593, 11.0958), (0.0118, 0.0087)),
    20: ((0.0678, 0.0847), (0.0149, 0.0022), (0.3664, 0.4672), (0.0118, 0.0087)),
    30: ((0.0147, 0.0023), (0.0149, 0.0022), (0.0161, 0.0085), (0.0118, 0.0087)),
    50: ((0.0147, 0.0023), (0.0149, 0.0022), (0.0161, 0.0085), (0.0118, 0.0087)),
}
TABLE_II = {
    # iteration: |H_g error| trust region, ours
    2: ((3.9872, 0.4096), (1.1261, 0.6539)),
    5: ((1.8707, 0.9048), (0.0058, 0.0043)),
    10: ((0.4532, 0.6153), (0.0045, 0.0022)),
    20: ((0.0068, 0.0121), (0.0045, 0.0022)),
    40: ((0.0045, 0.0022), (0.0045, 0.0022)),
    50: ((0.0045, 0.0022), (0.0045, 0.0022)),
}
SIGMA = 1.39
"""count: variance 0.1 read in (m/s^2)^2 is .316 m/s^2 or 13.9 counts, and a pose is the mean of 100 samples or so."""

LITERAL_SIGMA = math.sqrt(0.1)
"""count: variance 0.1 on the raw readings themselves."""

GYRO_SD = 0.05
"""rad/s: the paper's "variance 0.05rad/s" has the unit of a standard deviation."""

LITERAL_GYRO_SD = math.sqrt(0.05)
