"""Nodes for the tests of export and import, and the table of docs/exports.md, which they make.

``python tests/exchange_table.py`` writes the table into the page anew.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from margcal.apps.exporting import carries
from margcal.core.types import Array, Calibration, SensorModel
from margcal.core.units import KINDS, SI_COLUMN, SI_UNIT, STANDARD_GRAVITY, UNITS, Kind
from margcal.files.exchange.registry import TARGETS
from margcal.files.exchange.target import Target
from margcal.workflow.export import Export, export
from margcal.workflow.importing import import_calibration
from margcal.workflow.simulated_node import NOMINAL_SCALE, NodeErrors, triad

PAGE = Path(__file__).resolve().parents[1] / "docs" / "exports.md"
BEGIN, END = "<!-- table: python tests/exchange_table.py -->", "<!-- end of table -->"
NODES = 11
MOUNTING_DEG = 3.0

SCALE: dict[Kind, float] = {k: 1 / v for k, v in NOMINAL_SCALE.items()}
"""SI units a count by the data sheet: what a driver multiplies raw counts by."""

VECTORS: dict[Kind, Array | None] = {
    "acc": np.array([0.0, 0.0, STANDARD_GRAVITY]),
    "gyr": None,
    "mag": np.array([0.0, 18.5, -45.6]),
}


def node(
    seed: int, errors: NodeErrors | None = None, kinds: tuple[Kind, ...] = KINDS, device: str = "n7"
) -> Calibration:
    """The true calibration of a simulated node, from raw counts."""
    errors = errors or NodeErrors(scale_error=0.03, mounting_deg=MOUNTING_DEG)
    models: dict[str, SensorModel] = {}
    for kind, rng in zip(KINDS, np.random.default_rng([seed, 7]).spawn(3)):
        if kind in kinds:
            H, B = triad(kind, errors, rng)
            models[kind] = SensorModel(kind, H, B, reference_vector=VECTORS[kind])
    return Calibration(**models, device=device)  # type: ignore[arg-type]


def kinds_for(target: Target) -> tuple[Kind, ...]:
    """The sensors of one file of `target`."""
    kinds = tuple(k for k in KINDS if k in target.forms)
    return kinds[-1:] if target.single and "mag" in kinds else kinds[:1] if target.single else kinds


def scale_for(target: Target, kinds: tuple[Kind, ...]) -> dict[str, float]:
    """The scales that an export of counts to `target` needs."""
    return {k: SCALE[k] for k in kinds if target.forms[k].raw not in ((), ("count",))}


def exported(calibration: Calibration, target: Target, **options: object) -> Export:
    kinds = kinds_for(target)
    return export(
        calibration,
        target,
        sensors=kinds,
        scale=scale_for(target, kinds),
        **{"allow_lossy": True, **options},  # type: ignore[arg-type]
    )


def imported(data: bytes, target: Target) -> Calibration:
    """The way back, told what the file does not say."""
    kinds = kinds_for(target)
    scale = {k: SCALE[k] for k in kinds if target.forms[k].nominal} | scale_for(target, kinds)
    silent = target.name == "imu-tk"
    return import_calibration(
        data,
        f"file{target.suffix}",
        target,
        sensors=kinds if target.single else (),
        units=dict.fromkeys(kinds, "count") if silent else None,
        unit={"acc": "mps2", "gyr": "radps"} if silent else None,
        scale=scale,
    )


def measured_deg(got: SensorModel, want: SensorModel, rng: np.random.Generator, *, bias: bool = True) -> Array:
    """Angle between the vectors that two calibrations make of the same raw readings, in random directions (2000,)."""
    u = rng.normal(size=(2000, 3))
    size = 1.0 if want.reference_vector is None else float(np.linalg.norm(want.reference_vector))
    y = want.invert(size * u / np.linalg.norm(u, axis=1, keepdims=True))
    if want.kind == "gyr" or not bias:  # directions of a rate do not depend on the bias; nor where none is in the file
        v, w = (y - want.B) @ got.H.T, (y - want.B) @ want.H.T
    else:
        v, w = got.apply(y), want.apply(y)
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(v, w), axis=1), np.sum(v * w, axis=1)))


def _round_trip(target: Target) -> float:
    """Largest difference of H and B between the calibration and what comes back, relative to their largest element.

    Where the target cannot hold all of H, that is the loss, not an error of the way: H is compared with the one that
    went into the file.
    """
    worst = 0.0
    for seed in range(5):
        calibration = node(seed)
        done = exported(calibration, target)
        back = imported(done.data, target)
        for kind, model in back.models.items():
            want, form = calibration.models[kind], target.forms[kind]
            H, B = want.H, want.B
            if form.matrix != "full":
                H, B = in_counts(*form.decode(done.page.sensors[kind].fields), kind, target)
            worst = max(worst, _relative(model.H, H), _relative(model.B, B) if form.bias else 0.0)
    return worst


def in_counts(H: Array, B: Array, kind: Kind, target: Target) -> tuple[Array, Array]:
    """H and B of `target`'s units as SI (uT) per count and counts."""
    form = target.forms[kind]
    if form.nominal:
        return H * SCALE[kind], B
    out = UNITS[kind][form.unit or SI_COLUMN[SI_UNIT[kind]]] or 1.0
    raw = UNITS[kind][form.raw[0]] if form.raw else None
    per_raw = 1.0 if raw is None else SCALE[kind] / raw
    return H * (out * per_raw), B / per_raw


def _relative(a: Array, b: Array) -> float:
    return float(np.abs(a - b).max() / np.abs(b).max())


def _power(x: float) -> str:
    """The power of ten at or above `x`, none below 1e-12."""
    return f"1e{max(-12, math.ceil(math.log10(max(x, 1e-300)))):d}"


def rows() -> list[list[str]]:
    """One row a target: name, file, formula, carries, loss of each sensor, round-trip error."""
    out = []
    for target in TARGETS.values():
        loss: dict[Kind, list[float]] = {}
        for seed in range(NODES):
            for x in exported(node(seed), target).losses:
                loss.setdefault(x.kind, []).append(x.rms_deg)
        cells = [
            f"{np.median(loss[k]):.2g}" if k in loss and np.median(loss[k]) > 1e-4 else "0" if k in loss else ""
            for k in KINDS
        ]
        if target.single:  # one sensor a file was measured; the others it takes are carried alike
            cells = ["0" if not c and k in target.forms else c for c, k in zip(cells, KINDS)]
        kept = "; ".join(f"{k}: {v}" for k, v in carries(target).items())
        words = set(carries(target).values())
        if len(words) == 1 and len(target.forms) > 1:
            kept = f"{', '.join(target.forms)}: {words.pop()}"
        out.append([f"`{target.name}`", target.title, kept, *cells, _power(_round_trip(target))])
    return out


def table() -> str:
    header = ["`--to`, `--from`", "file", "carries", "acc, deg", "gyr, deg", "mag, deg", "round trip"]
    lines = [header, ["---"] * 3 + ["---:"] * 4, *rows()]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def write() -> None:
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}\n{table()}{END}{rest.split(END)[1]}", encoding="utf-8")


if __name__ == "__main__":
    write()
