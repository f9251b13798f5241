"""`verify`: are the usual mistakes named, and is nobody accused wrongly?

    python benchmarks/studies/verify.py [--nodes 100]

Typical simulated nodes (5 % scale, 3 degrees mounting, biases and hard iron, raw counts). Each is calibrated from one
session by the pipeline, and the numbers are applied to another session of the same node rightly and with each mistake:
on all sensors, and on one of them in turn. `verify` then sees the result alone, and the result with the raw readings.
Prints counts and writes results/verify.json; 100 nodes take ten minutes on one core.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from margcal.core.types import Calibration, Kind, Recording, Stream
from margcal.core.units import KINDS, SI_COLUMN
from margcal.workflow.calibrate import calibrate
from margcal.workflow.simulate import simulate
from margcal.workflow.verify import Verification, verify
from margcal.workflow.verify_mistakes import suspects

RESULTS = Path(__file__).resolve().parent / "results"
MISTAKES = ("bias-sign", "transposed", "forward", "post-offset", "unit")
NODE: dict[str, Any] = {"scale_error": 0.05, "mounting_deg": 3.0, "rest_s": 2.0, "turn_s": 1.2}
FIELD = 49.1


def applied(calibration: Calibration, recording: Recording, wrong: Mapping[Any, str]) -> Recording:
    """What a user has who applied the file's numbers, with the mistakes of `wrong`."""
    streams: dict[Kind, Stream] = {}
    for kind, stream in recording.streams.items():
        mistakes = (wrong[kind],) if kind in wrong else ()
        ways = suspects(calibration.models, kind, everything=False)
        way = next(w for w in ways if w.mistakes == mistakes)
        streams[kind] = Stream(kind, stream.t, way.of(stream.y), SI_COLUMN[calibration.models[kind].unit])
    return Recording(streams.get("acc"), streams.get("gyr"), streams.get("mag"), source="calibrated elsewhere")


def named(found: Verification) -> dict[str, str]:
    """What is said of the sensors that are not right."""
    return {f.sensor: "+".join(f.mistakes) or f.outcome for f in found.findings if f.outcome != "right"}


def node(number: int) -> tuple[Calibration, Recording]:
    """A calibration by the pipeline, and another session of the same node."""
    made = simulate(seed=20_000 + number, node_seed=number, n_poses=24, **NODE)
    other = simulate(seed=30_000 + number, node_seed=number, n_poses=12, **NODE)
    return calibrate(made.recording, field=FIELD), other.recording


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, default=100)
    nodes = parser.parse_args().nodes
    named_right: dict[str, dict[str, int]] = {m: {} for m in MISTAKES}
    wrong_answers: list[str] = []
    misfits, accused, told = [], 0, 0
    for number in range(nodes):
        calibration, recording = node(number)
        right = applied(calibration, recording, {})
        for raw in (None, recording):
            found = verify(calibration, right, raw)
            accused += found.fails
            told += not named(found)
            if named(found):
                wrong_answers.append(f"node {number}, right: {named(found)}")
            if raw is None:
                misfits.append(found.findings[0].residual)
        single = KINDS[number % 3]
        for mistake in MISTAKES:
            for where, wrong in (("all sensors", dict.fromkeys(KINDS, mistake)), ("one sensor", {single: mistake})):
                made = applied(calibration, recording, wrong)
                for how, raw in (("rests", None), ("exact", recording)):
                    answer = named(verify(calibration, made, raw))
                    key = f"{where}, {how}"
                    named_right[mistake][key] = named_right[mistake].get(key, 0) + (answer == wrong)
                    if answer != wrong:
                        wrong_answers.append(f"node {number}, {mistake}, {key}: {answer}")
        print(f"{number + 1} of {nodes}: {len(wrong_answers)} answers not as they should be", flush=True)
    kept = {
        "nodes": nodes,
        "node": NODE,
        "right ones accused": accused,
        "right ones called right (of twice the nodes)": told,
        "misfit of right ones, mean and largest": [float(np.mean(misfits)), float(np.max(misfits))],
        "named": named_right,
        "not as they should be": wrong_answers,
    }
    print(json.dumps(kept, indent=1))
    RESULTS.mkdir(exist_ok=True)
    (RESULTS / "verify.json").write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
