"""margcal calibrates inertial and magnetic sensor nodes (MARG): raw readings in, SI units in one frame out.

    u = H (y - B)

`y` (3,) is a raw reading in counts or any unit, `B` (3,) the combined bias in raw units, `H` (3, 3) the full
transformation matrix, `u` the calibrated vector in the node's frame, the same for all of its sensors. The other
direction is ``y = H^-1 u + B``; the post-offset form ``u = H y - o`` has ``o = H B``. H splits on demand into
mounting x non-orthogonality x scale; a magnetometer's H also holds the soft iron, its B the hard iron.

Frames
    `h` the node, `n` the earth (ENU: x east, y magnetic north, z up). `R_ab` takes components from b to a:
    ``v_a = R_ab @ v_b``. Which frame h is depends on how the node was put down and is in the file as `frame`:
    `housing`, `marker`, `acc-triangular` or (from `align`) `gyr-symmetric`. Quaternions are scalar first; table
    columns `qw qx qy qz` mean h to earth or laboratory.
Signs
    `acc` is specific force: at rest +g on the axis that points up. Accelerometers have det H > 0 unless a nominal
    H says otherwise; a magnetometer's sign comes from a nominal H, from the dip of a known place, or is assumed
    (det H > 0) and said so in an issue.
Units
    SI inside: m/s^2, rad/s, s. Magnetic field in uT, or `norm` (the local field is 1) where it is unknown. Raw
    columns say their unit: `acc_x_count`, `gyr_x_dps`, `mag_x_uT`. Standard gravity is 9.80665 m/s^2. Names that
    end in `_deg` are in degrees.
Shapes
    Samples first, components last: (N, 3), (J, 3), (J, 3, 3); J rests ("poses"), N samples. NaN means "not
    measured".

In five lines::

    import margcal

    recording = margcal.read("session.parquet")
    calibration = margcal.calibrate(recording)
    margcal.save(calibration, "node7.json")
    calibrated = calibration.apply(recording)  # calibrated.acc.y in m/s^2

Names are loaded when first used: ``import margcal`` itself costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from margcal.core.errors import DataError, InputError, MargcalError, UsageError
    from margcal.core.types import Calibration, Fit, Issue, Recording, SensorModel
    from margcal.files.calfile import load, save
    from margcal.files.poses_table import read_poses
    from margcal.files.tables import read
    from margcal.methods.ellipsoid import ellipsoid
    from margcal.methods.gyro import gauss_newton
    from margcal.methods.gyro_paper import ukf
    from margcal.methods.one_step import one_step
    from margcal.methods.triangular import triangular
    from margcal.workflow.align import align
    from margcal.workflow.calibrate import calibrate
    from margcal.workflow.evaluate import evaluate
    from margcal.workflow.export import export
    from margcal.workflow.importing import import_calibration
    from margcal.workflow.orient import orient
    from margcal.workflow.segment import find_poses
    from margcal.workflow.simulate import simulate
    from margcal.workflow.verify import verify

    __version__: str

__all__ = [
    "read",
    "Recording",
    "find_poses",
    "calibrate",
    "align",
    "Calibration",
    "load",
    "save",
    "read_poses",
    "SensorModel",
    "Fit",
    "Issue",
    "one_step",
    "ellipsoid",
    "triangular",
    "gauss_newton",
    "ukf",
    "evaluate",
    "verify",
    "simulate",
    "orient",
    "export",
    "import_calibration",
    "MargcalError",
    "InputError",
    "UsageError",
    "DataError",
    "__version__",
]

_HOME = {
    "read": "files.tables",
    "Recording": "core.types",
    "find_poses": "workflow.segment",
    "calibrate": "workflow.calibrate",
    "align": "workflow.align",
    "Calibration": "core.types",
    "load": "files.calfile",
    "save": "files.calfile",
    "read_poses": "files.poses_table",
    "SensorModel": "core.types",
    "Fit": "core.types",
    "Issue": "core.types",
    "one_step": "methods.one_step",
    "ellipsoid": "methods.ellipsoid",
    "triangular": "methods.triangular",
    "gauss_newton": "methods.gyro",
    "ukf": "methods.gyro_paper",
    "evaluate": "workflow.evaluate",
    "verify": "workflow.verify",
    "simulate": "workflow.simulate",
    "orient": "workflow.orient",
    "export": "workflow.export",
    "import_calibration": "workflow.importing",
    "MargcalError": "core.errors",
    "InputError": "core.errors",
    "UsageError": "core.errors",
    "DataError": "core.errors",
}
"""The module that each public name lives in."""


def __getattr__(name: str) -> Any:
    """A public name, imported when it is first asked for (PEP 562)."""
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("margcal")
    elif name in _HOME:
        from importlib import import_module

        value = getattr(import_module(f"margcal.{_HOME[name]}"), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
