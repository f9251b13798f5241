"""The public recordings that `effect` rests on, and the filters that are run on them."""

from __future__ import annotations

import os
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

from margcal.core.compiled import state
from margcal.core.errors import InputError
from margcal.core.types import Attitude, Calibration, Recording, SensorModel
from margcal.files.tables import read
from margcal.methods.ellipsoid import ellipsoid
from margcal.methods.filters import FILTERS
from margcal.workflow.align import align
from margcal.workflow.calibrate import calibrate
from margcal.workflow.orient import orient


class Filter(Protocol):
    """A recording in SI, or a raw one with its calibration, to attitudes."""

    def __call__(self, recording: Recording, calibration: Calibration | None = None, /) -> Attitude: ...


PHONE = "Nexus5"
SESSIONS = tuple(f"calib_{kind}_{PHONE}_d1" for kind in ("acc", "gyr", "mag"))
MOTIONS = ("Jakob_Nexus5_NoDist_AR", "Thibaud_Nexus5_NoDist_AR", "Thibaud_Nexus5_NoDist_Swinging")
ALIGNED_ON = MOTIONS[0]
PHONE_FIELD = 48.0


def data_folder() -> Path:
    """The folder with the public recordings.

    Raises
    ------
    InputError
        MARGCAL_DATA does not name it.
    """
    given = os.environ.get("MARGCAL_DATA")
    where = (
        "effect needs the eight BROAD trials (github.com/dlaidig/broad, CC BY 4.0) as tables <folder>/broad/*.parquet; "
        "set MARGCAL_DATA to the folder"
    )
    if not given:
        raise InputError(f"MARGCAL_DATA is not set: {where}")
    if not list(Path(given).glob("broad/*.parquet")):
        raise InputError(f"{given}: holds no broad/*.parquet: {where}")
    return Path(given)


def trials(folder: Path) -> dict[str, Path]:
    """BROAD trials by number."""
    return {p.name[:2]: p for p in sorted(folder.glob("broad/*.parquet"))}


# --- phones -------------------------------------------------------------------------------------------


def phone_motions(folder: Path) -> dict[str, Path]:
    """Motions of the phone with optical reference; none where they are not there."""
    there = {m: folder / "tyrex" / m for m in MOTIONS}
    complete = all((folder / "tyrex" / s).is_dir() for s in SESSIONS)
    return {m: p for m, p in there.items() if complete and p.is_dir()}


def phone_calibration(folder: Path) -> tuple[Calibration, dict[str, SensorModel]]:
    """H and B of the phone from its own sessions, and what the length of the sensed vector alone gives."""
    recordings = [read(folder / "tyrex" / s) for s in SESSIONS]
    calibrated = calibrate(*recordings, field=PHONE_FIELD)
    mag = recordings[2].mag
    assert mag is not None
    sphere = ellipsoid(mag.y[::5], PHONE_FIELD, kind="mag", raw_unit="uT").model
    # ten directions carry no ellipsoid of the accelerometer; its H (bias and scale factors) is symmetric as it is
    return calibrated, {"mag": sphere}


def phone_alignment(folder: Path) -> Calibration:
    """H, B and delays of the phone by `align` from one motion, which is then no test of them."""
    return align(read(folder / "tyrex" / ALIGNED_ON), field=PHONE_FIELD, orientation=False, allow_fail=True)


# --- filters ------------------------------------------------------------------------------------------


def filters() -> dict[str, Filter]:
    """The filters that follow gravity and field, by name.

    Those of the package `vqf` only where it is installed; our own only with their compiled kernels (a trial takes
    minutes without).
    """
    ours = state().startswith("yes")
    there = [f.name for f in FILTERS.values() if f.name != "gyro" and (ours or f.own_bias)]
    if find_spec("vqf") is None:
        there = [n for n in there if not FILTERS[n].own_bias]
    if not there:
        raise InputError("neither compiled filters nor the package vqf are installed: pip install 'margcal[vqf]'")
    return {name: partial(_attitude, name) for name in there}


def _attitude(name: str, recording: Recording, calibration: Calibration | None = None) -> Attitude:
    """`calibration`: of a raw recording, with its delays; without one the recording is in SI."""
    return orient(recording, calibration, filter=name).attitude
