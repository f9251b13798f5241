"""How well calibrations of one node repeat: five simulated recordings, and parts of two real ones.

    python benchmarks/bench_repeatability.py [--resamples 6] [--json]

Simulated: five recordings of one node (same node seed, other motion and noise). Real: the two halves of a recording,
and the recording with a random quarter of its rests cut out, several times (`mikoff/mpu9150_imu0` and the Xsens of
`imu_tk`; MARGCAL_DATA says where they lie). Shown: scatter of 20 converted readings, of the direction, and scatter over
the standard error that the calibrations state. Parts of one recording share rests, so resamples repeat better than
recordings would; halves share none.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from margcal.apps.comparing import compare
from margcal.core.errors import DataError
from margcal.core.types import Calibration, Recording, Stream
from margcal.files.tables import read
from margcal.workflow.calibrate import calibrate
from margcal.workflow.segment import find_poses
from margcal.workflow.simulate import simulate

DATA = Path(os.environ.get("MARGCAL_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
REAL = {"mikoff": "mikoff/mpu9150_imu0.parquet", "xsens": "imu_tk/xsens_mti_multipose.parquet"}


def between(recording: Recording, start: float, stop: float) -> Recording:
    """The samples of `recording` from `start` to `stop`, s."""

    def cut(s: Stream) -> Stream:
        keep = (s.t >= start) & (s.t < stop)
        return replace(s, t=s.t[keep], y=s.y[keep])

    return replace(recording, **{k: cut(s) for k, s in recording.streams.items()})


def without_saturated(recording: Recording) -> Recording:
    """The Xsens' gyroscope is at the end of its scale in 30 of 51175 samples; in a part alone they would refuse it."""
    gyr = recording.gyr
    if gyr is None or gyr.unit != "count":
        return recording
    keep = np.all(np.abs(gyr.y) < 65270, axis=1)
    return replace(recording, gyr=replace(gyr, t=gyr.t[keep], y=gyr.y[keep]))


def halves(recording: Recording) -> list[list[Recording]]:
    """Before and after the middle of the middle rest."""
    poses = find_poses(recording).poses
    middle = float((poses.start + poses.stop)[len(poses) // 2] / 2)
    return [[between(recording, -np.inf, middle)], [between(recording, middle, np.inf)]]


def resample(recording: Recording, rng: np.random.Generator) -> list[Recording]:
    """What is left when a random quarter of the rests is cut out: the pieces between them."""
    poses = find_poses(recording).poses
    gone = np.sort(rng.permutation(len(poses))[: len(poses) // 4])
    edges = [-np.inf, *(t for j in gone for t in (poses.start[j] - 0.05, poses.stop[j] + 0.05)), np.inf]
    pieces = [between(recording, a, b) for a, b in zip(edges[::2], edges[1::2])]
    return [p for p in pieces if all(len(s.t) > 50 for s in p.streams.values())]


def agreed(calibrations: list[Calibration]) -> dict[str, dict[str, float | None]]:
    """Figures of each sensor."""
    found = compare(calibrations, [f"part {i + 1}" for i in range(len(calibrations))])
    return {
        kind: {
            "n": r.n,
            "sd": float(np.sqrt(np.mean(r.scatter**2))),
            "sd_percent": 100 * float(np.sqrt(np.mean(r.scatter**2))) / r.magnitude,
            "direction_deg": r.angle_rms_deg,
            "stated_deg": r.expected_error_deg,
            "over_stated": r.over_claimed,
        }
        for kind, (r, _) in found.items()
    }


def calibrated(parts: list[list[Recording]], name: str, notes: list[str]) -> list[Calibration]:
    out = []
    for i, part in enumerate(parts):
        try:
            out.append(calibrate(*part))
        except DataError as error:
            notes.append(f"{name}, part {i + 1} refused: {error}")
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resamples", type=int, default=6)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    notes: list[str] = []
    results = {
        "simulated, 5 recordings": agreed([calibrate(simulate(seed=s, node_seed=42).recording) for s in range(5)])
    }
    for name, file in REAL.items():
        if not (DATA / file).exists():
            notes.append(f"{name}: {DATA / file} is not here (MARGCAL_DATA)")
            continue
        units = {"acc": "count", "gyr": "count"} if name == "xsens" else None
        recording = without_saturated(read(DATA / file, units=units) if units else read(DATA / file))
        rng = np.random.default_rng(0)
        for what, parts in (
            ("halves", halves(recording)),
            (f"{args.resamples} resamples of the rests", [resample(recording, rng) for _ in range(args.resamples)]),
        ):
            calibrations = calibrated(parts, f"{name}, {what}", notes)
            if len(calibrations) > 1:
                results[f"{name}, {what}"] = agreed(calibrations)
    if args.json:
        print(json.dumps({"results": results, "notes": notes}, indent=2))
        return
    print(f"{'':38s} {'':4s} {'n':>2s} {'sd, %':>8s} {'direction, deg':>15s} {'stated':>8s} {'sd/stated':>10s}")
    for name, sensors in results.items():
        for kind, f in sensors.items():
            stated, over = (f"{v:.3g}" if v is not None else "-" for v in (f["stated_deg"], f["over_stated"]))
            line = f"{name:38s} {kind:4s} {f['n']:2.0f} {f['sd_percent']:8.4f} {f['direction_deg']:15.4f}"
            print(f"{line} {stated:>8s} {over:>10s}")
    for note in notes:
        print(note)


if __name__ == "__main__":
    main()
