"""Every kind of file that margcal writes for others and reads from them."""

from __future__ import annotations

from difflib import get_close_matches

from margcal.core.errors import UsageError
from margcal.files.exchange import (
    autopilots,
    basalt,
    betaflight,
    c_code,
    c_fixed,
    coefficients,
    fusion,
    imu_tk,
    imucal_file,
    kalibr,
    magneto,
    matlab,
    ros_imu_calib,
)
from margcal.files.exchange.target import Target

TARGETS: dict[str, Target] = {
    t.name: t
    for t in (
        c_code.HEADER,
        c_fixed.Q15,
        c_fixed.Q31,
        c_code.SKETCH,
        fusion.C,
        fusion.PYTHON,
        matlab.MAT,
        matlab.SCRIPT,
        imucal_file.JSON,
        imucal_file.HDF5,
        imu_tk.IMU_TK,
        kalibr.KALIBR,
        kalibr.OPENVINS,
        basalt.BASALT,
        ros_imu_calib.ROS_IMU_CALIB,
        autopilots.ARDUPILOT,
        autopilots.PX4,
        betaflight.BETAFLIGHT,
        magneto.MOTIONCAL,
        magneto.MAGNETO,
        coefficients.QMT,
        coefficients.GGIR,
        coefficients.ACTIPY,
    )
}
"""By name, in the order in which they are listed."""


def find(name: str) -> Target:
    """The target `name`.

    Raises
    ------
    UsageError
        There is none of that name; the nearest are named.
    """
    if name in TARGETS:
        return TARGETS[name]
    near = get_close_matches(name.lower(), TARGETS, n=3, cutoff=0.4)
    hint = f"; did you mean {' or '.join(near)}?" if near else ""
    raise UsageError(f"{name[:40]!r} is no target{hint} (margcal export --list shows all)")
