"""On what the settings of our orientation filters were chosen: four motions of a phone before Qualisys (tyrex).

    python benchmarks/studies/filter_settings.py

The phone's magnetometer is calibrated with the figures of the data's README, its accelerometer with what `margcal
calibrate` makes of the session beside it; the gyroscope's bias is its mean against the optics, whose frame is turned to
magnetic north. Error: inclination RMS and standard deviation of the heading together, mean over the motions, degrees.
BROAD is not read here; `orientation.py` says what part it had. Needs the recordings (MARGCAL_DATA) and the compiled
filters (else it takes long).
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from margcal.core import so3
from margcal.core.types import Array, Stream
from margcal.core.units import STANDARD_GRAVITY
from margcal.files.tables import read
from margcal.methods import ekf_quest, vector_selection
from margcal.methods.wahba import triad

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results"
DATA = Path(os.environ.get("MARGCAL_DATA", HERE.parents[1] / ".." / "shared" / "data")) / "tyrex"

MOTIONS = (
    "Jakob_Nexus5_Dist_AR",
    "Jakob_Nexus5_NoDist_AR",
    "Thibaud_Nexus5_NoDist_AR",
    "Thibaud_Nexus5_NoDist_Swinging",
)
MAG_H = np.array([[1.002, 0.027, -0.026], [0.027, 0.976, 0.013], [-0.026, 0.013, 1.024]])
MAG_B = np.array([58.1, -73.5, 411.6])
ACC_SCALE, ACC_B = np.array([1.00268, 1.00507, 1.00026]), np.array([0.0215, 0.1436, -0.1588])
MARKER = so3.quat_exp(np.radians([-1.0, 1.1, -0.2]))  # node to marker body
LAG_S, STEP_S = 0.025, 0.01

TRIED: dict[str, tuple[Any, dict[str, tuple[float, ...]]]] = {
    "vector-selection": (
        vector_selection,
        {
            "acc_gate": (0.05, 0.1, 0.2, 0.5, 3.0, 10.0),
            "mag_gate": (0.05, 0.1, 0.2),
            "dip_gate": (0.05, 0.1, 0.2),
            "acc_noise": (0.0075, 0.015, 0.03),
            "mag_noise": (0.03, 0.06, 0.12),
        },
    ),
    "ekf-quest": (
        ekf_quest,
        {"quest_noise": (0.03, 0.06, 0.1, 0.15), "mag_weight": (1.0, 3.0, 10.0), "mag_gate": (0.05, 0.1, 0.2, 1e9)},
    ),
}


@dataclass(frozen=True)
class Motion:
    """Readings (N, 3) and reference (N, 4) every `STEP_S`; first attitude and field as the filters take them."""

    gyr: Array
    acc: Array
    mag: Array
    q: Array
    first: Array
    field: float
    dip: float


def motion(name: str) -> Motion:
    recording = read(DATA / name)
    gyr, acc, mag, ref = recording.gyr, recording.acc, recording.mag, recording.reference
    assert gyr is not None and acc is not None and mag is not None and ref is not None
    begin, end = max(s.t[0] for s in (gyr, acc, mag, ref)), min(s.t[-1] for s in (gyr, acc, mag, ref)) - 0.1
    t = np.arange(begin + 2 * LAG_S, end, STEP_S)
    angle = np.zeros(gyr.y.shape)
    angle[1:] = np.cumsum((gyr.y[1:] + gyr.y[:-1]) / 2 * np.diff(gyr.t)[:, None], axis=0)
    w = (columns(t, gyr.t, angle) - columns(t - STEP_S, gyr.t, angle)) / STEP_S
    a = (at(t, acc) - ACC_B) * ACC_SCALE
    m = (at(t, mag) - MAG_B) @ MAG_H.T
    q = so3.quat_multiply(reference_at(t - LAG_S, ref.t, ref.q), MARKER)
    turned = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(q[:-1]), q[1:])) / STEP_S
    seen = np.linalg.norm(turned, axis=1) < 8  # False for NaN
    w -= np.mean((w[1:] - turned)[seen], axis=0)
    field = np.nanmedian(np.einsum("nij,nj->ni", so3.matrix_from_quat(q), m), axis=0)
    half = np.arctan2(field[0], field[1]) / 2
    q = so3.quat_multiply([np.cos(half), 0.0, 0.0, np.sin(half)], q)
    level = float(np.hypot(field[0], field[1]))
    begun = triad(np.stack([a[:10].mean(axis=0), m[:10].mean(axis=0)]), np.array([[0, 0, 1.0], [0, level, field[2]]]))
    return Motion(w, a, m, q, begun.q, float(np.linalg.norm(field)), float(np.arctan2(-field[2], level)))


def columns(t: Array, clock: Array, y: Array) -> Array:
    return np.column_stack([np.interp(t, clock, y[:, k]) for k in range(y.shape[1])])


def at(t: Array, stream: Stream) -> Array:
    return columns(t, stream.t, stream.y)


def reference_at(t: Array, clock: Array, q: Array) -> Array:
    """The reference between its frames (60 Hz), NaN where one is missing."""
    k = np.clip(np.searchsorted(clock, t), 1, len(clock) - 1)
    x = ((t - clock[k - 1]) / (clock[k] - clock[k - 1]))[:, None]
    between = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(q[k - 1]), q[k]))
    return so3.quat_multiply(q[k - 1], so3.quat_exp(x * between))


def error_deg(m: Motion, module: Any, **setting: float) -> float:
    params = module.Params(gravity=STANDARD_GRAVITY, field=m.field, dip=m.dip)._replace(**setting)
    dt = np.full(len(m.gyr), STEP_S)
    q = module.batch(params, module.start(m.first), dt, m.gyr, m.acc, m.mag).q
    use = ~np.isnan(m.q).any(axis=1)
    use[:300] = False
    d = so3.quat_multiply(q[use], so3.quat_conjugate(m.q[use]))
    heading = (2 * np.arctan2(d[:, 3], d[:, 0]) + np.pi) % (2 * np.pi) - np.pi
    inclination = 2 * np.arccos(np.clip(np.hypot(d[:, 0], d[:, 3]), 0, 1))
    return float(np.degrees(np.sqrt(np.mean(inclination**2) + np.var(heading))))


def main() -> None:
    motions = [motion(name) for name in MOTIONS]
    kept: dict[str, Any] = {"motions": MOTIONS, "settings": {}}
    for name, (module, tried) in TRIED.items():
        for setting, values in tried.items():
            for value in values:
                errors = [round(error_deg(m, module, **{setting: value}), 2) for m in motions]
                chosen = "  <- taken" if module.Params._field_defaults[setting] == value else ""
                kept["settings"][f"{name} {setting} {value:g}"] = errors
                print(f"{name:17s} {setting:12s} {value:7g}  mean {np.mean(errors):5.2f}   {errors}{chosen}")
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "filter_settings.json").write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
