"""Constants and the unit table. Units are converted at the doors only; inside everything is SI (field: uT).

A column is named `acc_x_mps2`: sensor, axis, unit. `UNITS` maps the unit's spelling in a column name to the
sensor kinds that may carry it and the factor to the SI unit of `SI_UNIT`. A factor of None marks a raw unit
(`count`) whose scale only the calibration knows.
"""

from __future__ import annotations

import math
from typing import Literal

STANDARD_GRAVITY = 9.80665
"""One standard gravity, m/s^2 (exact by definition), the default of ``--gravity``."""

Kind = Literal["acc", "gyr", "mag"]
KINDS: tuple[Kind, ...] = ("acc", "gyr", "mag")
"""The sensors of a node in the order in which they are always listed."""

SI_UNIT = {"acc": "m/s^2", "gyr": "rad/s", "mag": "uT"}
"""The unit of calibrated readings by sensor kind (a magnetometer may be in `norm`: local field = 1)."""

SI_COLUMN = {"m/s^2": "mps2", "rad/s": "radps", "uT": "uT", "norm": "norm"}
"""The spelling of each calibrated unit in a column name."""

UNITS: dict[str, dict[str, float | None]] = {
    "acc": {"mps2": 1.0, "g": STANDARD_GRAVITY, "mg": STANDARD_GRAVITY * 1e-3, "count": None},
    "gyr": {"radps": 1.0, "dps": math.radians(1.0), "mdps": math.radians(1e-3), "count": None},
    "mag": {"uT": 1.0, "nT": 1e-3, "gauss": 100.0, "mgauss": 0.1, "norm": None, "count": None},
}
"""kind -> spelling in a column name -> factor to SI; None where there is no factor (`count`, `norm`)."""
