"""The numbers in place: a few lines of Python and of C that do what `SensorModel.apply` does."""

from __future__ import annotations

import re

import numpy as np

from margcal.core.types import Calibration, SensorModel


def _comment(text: str) -> str:
    """`text` fit for a comment in any language: nothing that could end it."""
    return re.sub(r"[^\w/^ .%°µ-]", "?", text)[:40]


def python_code(calibration: Calibration) -> str:
    """Three lines a sensor; the names `acc_raw`, `gyr_raw`, `mag_raw` are the readings, (3,) or (N, 3)."""
    return "\n".join(["import numpy as np", *("\n" + _python(m) for m in calibration.models.values())]) + "\n"


def _python(model: SensorModel) -> str:
    k, name = model.kind.upper(), model.kind
    raw, unit = _comment(model.raw_unit), _comment(model.unit)
    rows = ",\n".join(f"    {row!r}" for row in model.H.tolist())
    return (
        f"{k}_H = np.array([  # {unit} per {raw}\n{rows}])\n"
        f"{k}_B = np.array({model.B.tolist()!r})  # {raw}\n"
        f"{name} = ({name}_raw - {k}_B) @ {k}_H.T  # {name}_raw: (3,) or (N, 3) in {raw}; {name}: {unit}"
    )


def c_code(calibration: Calibration) -> str:
    """``static const float ACC_H[9], ACC_B[3]`` and ``margcal_acc(y, u)`` for each sensor; `u` may be `y`."""
    return "\n".join(_c(m) for m in calibration.models.values())


def _floats(values: np.ndarray) -> str:
    """Numbers of C, a row of a matrix to the line."""
    return ",\n".join("    " + ", ".join(f"{np.float32(v)!s}f" for v in row) for row in np.atleast_2d(values))


def _c(model: SensorModel) -> str:
    k, name = model.kind.upper(), model.kind
    return (
        f"// {_comment(model.unit)} from {_comment(model.raw_unit)}, H row by row\n"
        f"static const float {k}_H[9] = {{\n{_floats(model.H)}}};\n"
        f"static const float {k}_B[3] = {{{_floats(model.B).strip()}}};\n"
        f"static inline void margcal_{name}(const float y[3], float u[3]) {{\n"
        f"    const float d[3] = {{y[0] - {k}_B[0], y[1] - {k}_B[1], y[2] - {k}_B[2]}};\n"
        f"    for (int i = 0; i < 3; i++) u[i] = {k}_H[3*i]*d[0] + {k}_H[3*i+1]*d[1] + {k}_H[3*i+2]*d[2];\n"
        "}\n"
    )
