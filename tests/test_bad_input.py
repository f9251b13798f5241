"""Bad input, row by row of the project's list: each is refused, warned of or mended, and says so.

A case is a small generator that damages a simulated session or a file, the arguments of the program, and what
must come of it: exit status, issue codes, words of the message. Checked for every case beside that: no
traceback and no internal error; an error is one line that names the file; no half-written file and nothing
left behind; a calibration that is written loads again, and is as good as it claims to be.
"""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from margcal.apps import cli
from margcal.core import so3
from margcal.core.types import Array, Calibration, Kind, Recording
from margcal.core.units import UNITS
from margcal.files.calfile import load
from margcal.files.tables import write_table
from margcal.workflow import simulate as simulator
from margcal.workflow.simulate import Simulation, simulate, swing

Columns = dict[str, Any]
Arguments = list[str | Path]


# --- running -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """What the program did: exit status, both streams, and the files that it left in the folder."""

    status: int
    out: str
    err: str
    new: frozenset[str]

    @property
    def plain(self) -> dict[str, Any]:
        return json.loads(self.out)

    @property
    def codes(self) -> set[tuple[str, str, str | None]]:
        return {(i["level"], i["code"], i["sensor"]) for i in self.plain["issues"]}


def margcal(folder: Path, *arguments: str | Path) -> Outcome:
    """Run the command in `folder`, and hold it to what must never happen."""
    before = {p.relative_to(folder) for p in folder.rglob("*")}
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), contextlib.chdir(folder):
        status = cli.run([str(a) for a in arguments])
    new = frozenset(str(p) for p in {p.relative_to(folder) for p in folder.rglob("*")} - before)
    outcome = Outcome(status, out.getvalue(), err.getvalue(), new)
    for word in ("Traceback", "internal error", "Warning:"):
        assert word not in outcome.out + outcome.err, outcome.err
    if status in (1, 2):
        assert outcome.err.startswith("margcal: ") and outcome.err.count("\n") == 1, outcome.err
        assert not new, new
    return outcome


# --- sessions and files ------------------------------------------------------------------------------

SMALL: dict[str, Any] = {"seed": 3, "n_poses": 14, "rest_s": 1.6, "rate": 50.0}


@cache
def session(**options: Any) -> Simulation:
    return simulate(**{**SMALL, **options})


def put_in(R: Array, **options: Any) -> Simulation:
    """A session with the attitudes `R` (J, 3, 3) instead of random ones."""
    usual = simulator.attitudes
    simulator.attitudes = lambda poses, n, rng: np.array(R)  # type: ignore[assignment]
    try:
        return simulate(**{**SMALL, "n_poses": len(R), **options})
    finally:
        simulator.attitudes = usual


def columns(recording: Recording) -> Columns:
    """The table of a recording whose sensors share a clock."""
    table: Columns = {"t_s": np.array(next(iter(recording.streams.values())).t)}
    for kind, stream in recording.streams.items():
        table |= {f"{kind}_{a}_{stream.unit}": np.array(stream.y[:, i]) for i, a in enumerate("xyz")}
    if recording.reference is not None:
        table |= {f"ref_q{a}": np.array(recording.reference.q[:, i]) for i, a in enumerate("wxyz")}
    return table


def as_csv(table: Mapping[str, Any], separator: str = ",", decimal: str = ".") -> str:
    rows = zip(*(np.asarray(v).tolist() for v in table.values()))
    lines = [separator.join(table)]
    for row in rows:
        cells = ("" if isinstance(v, float) and np.isnan(v) else str(v).replace(".", decimal) for v in row)
        lines.append(separator.join(cells))
    return "\n".join(lines) + "\n"


def axes(kind: str, unit: str = "count") -> list[str]:
    return [f"{kind}_{a}_{unit}" for a in "xyz"]


# --- cases -------------------------------------------------------------------------------------------

Damage = Callable[[Columns], "Columns | None"]


@dataclass(frozen=True)
class Case:
    """A damaged session, how it is calibrated, and what must come of it.

    `row` is the number in the list of bad inputs, `has` issues (level, code, sensor) that must be there, `without`
    sensors that must not be calibrated, `says` words of the message or of an issue.
    """

    name: str
    row: str
    status: int
    damage: Damage = lambda table: None
    made: Callable[[], Simulation] = session
    options: tuple[str, ...] = ()
    has: tuple[tuple[str, str, str | None], ...] = ()
    without: tuple[Kind, ...] = ()
    says: tuple[str, ...] = ()
    labels: Callable[[Simulation], Columns] | None = None
    scale: Mapping[str, float] = field(default_factory=dict)


def missing(kind: str, share: float) -> Damage:
    def damage(table: Columns) -> None:
        gone = np.random.default_rng(0).random(len(table["t_s"])) < share
        for name in axes(kind):
            table[name][gone] = np.nan

    return damage


def missing_run(kind: str, first: int, last: int) -> Damage:
    def damage(table: Columns) -> None:
        for name in axes(kind):
            table[name][first:last] = np.nan

    return damage


def stuck(kind: str, which: str = "y", first: int = 0, last: int | None = None) -> Damage:
    def damage(table: Columns) -> None:
        for axis in which:
            name = f"{kind}_{axis}_count"
            table[name][first:last] = table[name][first]

    return damage


def clipped(kind: str, share: float = 0.8) -> Damage:
    def damage(table: Columns) -> None:
        name = f"{kind}_x_count"
        table[name] = np.minimum(table[name], np.round(share * table[name].max()))

    return damage


def cell(name: str, row: int, value: float) -> Damage:
    def damage(table: Columns) -> None:
        table[name] = np.array(table[name], dtype=np.float64)
        table[name][row] = value

    return damage


def time(change: Callable[[Array], Array]) -> Damage:
    def damage(table: Columns) -> None:
        table["t_s"] = change(table["t_s"])

    return damage


def rows(choose: Callable[[int], Any]) -> Damage:
    def damage(table: Columns) -> Columns:
        index = choose(len(table["t_s"]))
        return {k: v[index] for k, v in table.items()}

    return damage


def unit(kind: Kind, true: str, label: str) -> Damage:
    """Readings in the unit `true` whose columns say `label`."""

    def damage(table: Columns) -> Columns:
        factor = UNITS[kind][true]
        scale = 1.0 if factor is None else np.cbrt(np.linalg.det(session().truth.models[kind].H)) / factor
        renamed = {k.replace("count", label) if k.startswith(kind) else k: v for k, v in table.items()}
        for name in axes(kind, label):
            renamed[name] = renamed[name] * scale
        return renamed

    return damage


def rename(old: str, new: str) -> Damage:
    return lambda table: {k.replace(old, new): v for k, v in table.items()}


def quaternions(change: Callable[[Array], Array] = lambda q: q) -> Callable[[Simulation], Columns]:
    def labels(made: Simulation) -> Columns:
        q = change(so3.quat_from_matrix(made.nominal))
        return dict(zip(("qw", "qx", "qy", "qz"), q.T))

    return labels


def spans(start: float = 0.0, stop: float = 0.0) -> Callable[[Simulation], Columns]:
    def labels(made: Simulation) -> Columns:
        return {**quaternions()(made), "start_s": made.start + start, "stop_s": made.stop + stop}

    return labels


def ups(change: Callable[[list[str]], list[str]] = lambda up: up) -> Callable[[Simulation], Columns]:
    def labels(made: Simulation) -> Columns:
        z = made.nominal[:, 2, :]
        largest = np.abs(z).argmax(axis=1)
        return {"up": change([f"{'+' if z[j, k] > 0 else '-'}{'xyz'[k]}" for j, k in enumerate(largest)])}

    return labels


def about(axis: int, n: int = 14, step: float = np.pi / 2) -> Callable[[], Simulation]:
    return lambda: put_in(so3.exp(np.outer(np.arange(n) * step, np.eye(3)[axis])))


def cone(degrees: float) -> Callable[[], Simulation]:
    angles = np.radians(np.random.default_rng(2).uniform(-degrees, degrees, (14, 3)))
    return lambda: put_in(so3.exp(angles))


def few(n: int, poses: str = "cube", **options: Any) -> Callable[[], Simulation]:
    return lambda: session(n_poses=n, poses=poses, **options)


def only(*sensors: Kind) -> Callable[[], Simulation]:
    return lambda: session(sensors=sensors)


def flip(text: list[str], row: int) -> list[str]:
    return [("-" if u[0] == "+" else "+") + u[1] if j == row else u for j, u in enumerate(text)]


NEEDS = ("fail", "needs-accelerometer", "gyr"), ("fail", "needs-accelerometer", "mag")
ALL: tuple[Kind, ...] = ("acc", "gyr", "mag")

CASES = [
    Case("sound", "-", 0),
    Case("sound-labels", "-", 0, labels=quaternions()),
    Case("sound-spans", "-", 0, labels=spans()),
    # rows 1 and 2: missing and infinite readings
    Case("nan-few", "1", 0, missing("acc", 0.005), has=(("warn", "nan-rows", "acc"),), says=("left out",)),
    Case("nan-acc", "2", 3, missing("acc", 0.08), has=(("fail", "nan-rows", "acc"),), without=ALL),
    Case("nan-gyr", "2", 0, missing("gyr", 0.08), has=(("fail", "nan-rows", "gyr"),), without=("gyr",)),
    Case("nan-mag", "2", 0, missing("mag", 0.08), has=(("fail", "nan-rows", "mag"),), without=("mag",)),
    Case(
        "nan-mag-asked",
        "2",
        3,
        missing("mag", 0.08),
        options=("--sensors", "mag"),
        has=(("fail", "nan-rows", "mag"),),
        without=("mag",),
        says=("record again",),
    ),
    Case(
        "nan-run-in-turn",
        "2",
        0,
        missing_run("gyr", 84, 150),
        has=(("warn", "nan-rows", "gyr"), ("warn", "gaps", "gyr")),
    ),
    Case("nan-all", "2", 0, missing("mag", 2.0), has=(("warn", "sensor-empty", "mag"),), without=("mag",)),
    Case("inf", "2", 1, cell("gyr_x_count", 76, np.inf), says=("sample 77", "take the row out")),
    Case("minus-inf-time", "2", 1, cell("t_s", 5, -np.inf), says=("t_s", "row 6")),
    # rows 3 to 6: units that cannot be
    Case("acc-g-as-mps2", "3", 1, unit("acc", "g", "mps2"), says=("--units acc=g",)),
    Case("acc-mps2-as-g", "3", 1, unit("acc", "mps2", "g"), says=("--units acc=mps2",)),
    Case("acc-count-as-mps2", "4", 1, unit("acc", "count", "mps2"), says=("--units acc=count",)),
    Case("gyr-dps-as-radps", "5", 1, unit("gyr", "dps", "radps"), says=("--units gyr=dps",)),
    Case("gyr-radps-as-dps", "5", 1, unit("gyr", "radps", "dps"), says=("--units gyr=radps",)),
    Case("mag-gauss-as-uT", "6", 1, unit("mag", "gauss", "uT"), says=("--units mag=gauss",)),
    Case("mag-nT-as-uT", "6", 1, unit("mag", "nT", "uT"), says=("--units mag=nT",)),
    Case(
        "acc-g-mended",
        "3",
        0,
        unit("acc", "g", "mps2"),
        options=("--units", "acc=g"),
        has=(("warn", "unit-relabelled", "acc"),),
        scale={"acc": 0.0},
    ),
    Case("no-unit", "6", 1, rename("_count", ""), says=("--units acc=UNIT",)),
    Case("unknown-unit", "6", 1, rename("acc_x_count", "acc_x_furlong"), says=("acc_x_count", "one unit")),
    # rows 8 to 11: mirrored, saturated, stuck, coarse
    Case(
        "mirrored-gyr",
        "8",
        0,
        lambda table: {k: -v if k == "gyr_x_count" else v for k, v in table.items()},
        has=(("warn", "mirrored-axes", "gyr"),),
        scale={"gyr": 0.0},
    ),
    Case("saturated-acc", "9", 3, clipped("acc"), has=(("fail", "saturated", "acc"),), without=ALL),
    Case("saturated-gyr", "9", 0, clipped("gyr"), has=(("fail", "saturated", "gyr"),), without=("gyr",)),
    Case("saturated-mag", "9", 0, clipped("mag"), has=(("fail", "saturated", "mag"),), without=("mag",)),
    Case("stuck-acc", "10", 3, stuck("acc"), has=(("fail", "stuck-axis", "acc"),), without=ALL, says=("y shows",)),
    Case("stuck-gyr", "10", 0, stuck("gyr"), has=(("fail", "stuck-axis", "gyr"),), without=("gyr",)),
    Case("stuck-mag", "10", 0, stuck("mag"), has=(("fail", "stuck-axis", "mag"),), without=("mag",)),
    Case("dead-gyr", "10", 0, stuck("gyr", "xyz"), has=(("fail", "stuck-sensor", "gyr"),), without=("gyr",)),
    Case("stuck-acc-for-4-s", "10", 3, stuck("acc", "x", 300, 500), has=(("warn", "stuck-stretch", "acc"),)),
    Case("stuck-mag-for-4-s", "10", 0, stuck("mag", "x", 300, 500), has=(("warn", "stuck-stretch", "mag"),)),
    Case(
        "all-dead",
        "10",
        3,
        lambda table: {k: v if k == "t_s" else np.full_like(v, 12.0) for k, v in table.items()},
        has=(("fail", "stuck-sensor", "acc"), ("fail", "stuck-sensor", "gyr"), ("fail", "stuck-sensor", "mag")),
        without=ALL,
    ),
    Case(
        "coarse-mag",
        "11",
        0,
        lambda table: {k: 40 * np.round(v / 40) if k.startswith("mag") else v for k, v in table.items()},
        has=(("warn", "coarse-quantisation", "mag"),),
    ),
    # rows 12 to 17: time
    Case(
        "duplicate-time",
        "12",
        0,
        time(lambda t: np.where(t == t[300], t[299], t)),
        has=(("warn", "duplicate-time", "acc"),),
    ),
    Case(
        "backward-time", "13", 1, time(lambda t: np.where(t == t[300], t[300] - 0.1, t)), says=("sample 301", "--sort")
    ),
    Case(
        "shuffled-sorted",
        "13",
        0,
        rows(lambda n: np.random.default_rng(1).permutation(n)),
        options=("--sort",),
        has=(("warn", "time-sorted", "gyr"),),
    ),
    Case("restarted-clock", "13", 1, time(lambda t: np.where(t > 20, t - 20, t)), says=("restarted",)),
    Case(
        "gap-in-turn",
        "14",
        0,
        rows(lambda n: np.delete(np.arange(n), np.s_[84:140])),
        has=(("warn", "gaps", "acc"), ("warn", "gap-in-turn", "gyr")),
    ),
    Case(
        "gap-in-every-turn",
        "14",
        0,
        rows(lambda n: np.flatnonzero(np.arange(n) % 155 < 95)),
        has=(("fail", "too-few-turns", "gyr"),),
        without=("gyr",),
    ),
    Case("milliseconds", "17", 1, time(lambda t: 1000 * t), says=("milliseconds",)),
    Case(
        "epoch-float32", "68", 1, time(lambda t: (t + 1.7e9).astype(np.float32).astype(np.float64)), says=("float32",)
    ),
    Case("epoch", "68", 0, time(lambda t: t + 1.7e9)),
    # rows 18 to 20: what the attitudes carry
    Case(
        "same-attitude", "18", 3, made=lambda: put_in(np.tile(np.eye(3), (14, 1, 1))), without=ALL, says=("attitudes",)
    ),
    Case(
        "same-attitude-labels",
        "18",
        3,
        made=lambda: put_in(np.tile(np.eye(3), (14, 1, 1))),
        labels=quaternions(),
        without=ALL,
    ),
    Case(
        "same-attitude-swing",
        "18",
        3,
        made=lambda: put_in(np.tile(np.eye(3), (14, 1, 1))),
        options=("--poses", "swing"),
        without=ALL,
    ),
    Case("about-vertical", "19", 3, made=about(2), without=ALL),
    Case("about-vertical-labels", "19", 3, made=about(2), labels=quaternions(), without=ALL, says=("one axis",)),
    Case("about-x", "19", 3, made=about(0, step=0.7), without=ALL),
    Case("about-x-labels", "19", 3, made=about(0, step=0.7), labels=quaternions(), without=ALL, says=("one axis",)),
    Case("about-vertical-swing", "19", 3, made=about(2), options=("--poses", "swing"), without=ALL),
    Case("narrow-cone", "19", 3, made=cone(10), without=ALL),
    Case("narrow-cone-swing", "19", 3, made=cone(10), options=("--poses", "swing"), without=ALL),
    Case("narrow-cone-labels", "19", 0, made=cone(20), labels=quaternions()),
    Case("one-pose", "20", 3, made=few(1), without=ALL),
    Case("three-poses", "20", 3, made=few(3), without=ALL, says=("needed",)),
    Case("three-poses-cube", "20", 3, made=few(3), options=("--poses", "cube"), without=ALL, says=("six faces",)),
    Case("four-labels", "20", 3, made=few(4), labels=quaternions(), without=ALL, says=("4 poses found, 5 needed",)),
    Case("five-faces", "20", 3, made=few(5, "faces"), options=("--poses", "faces"), without=ALL),
    Case("six-free", "20", 3, made=few(6, "free"), options=("--poses", "free"), without=ALL, says=("10 needed",)),
    Case("six-faces-level", "20", 0, made=few(6, "faces"), labels=ups()),
    Case(
        "six-faces-not-level",
        "20",
        3,
        made=few(6, "faces"),
        labels=ups(),
        options=("--level-sd", "30"),
    ),
    Case(
        "no-rests",
        "20",
        3,
        made=lambda: swing(seed=3, duration_s=20, rate=50),
        options=("--sensors", "acc"),
        without=ALL,
    ),
    # rows 21 to 26: motion, disturbance, wrong labels
    Case("knocks", "21", 0, made=few(14, knocks=5)),
    Case("disturbed-pose", "23", 0, made=few(24, disturbed=4, disturbance=0.2), labels=quaternions()),
    Case("wrong-label", "25", 0, made=few(24, wrong_label=7), labels=quaternions(), says=("8",)),
    Case("wrong-up", "25", 0, made=few(14), labels=ups(lambda up: flip(up, 5)), says=("rest 6",)),
    Case(
        "same-labels", "25", 3, made=few(8), labels=quaternions(lambda q: np.repeat(q[:1], len(q), axis=0)), without=ALL
    ),
    Case("too-many-labels", "25", 1, labels=quaternions(lambda q: np.vstack([q, q[:1]])), says=("15 rows", "14 rests")),
    Case("too-few-labels", "25", 1, labels=quaternions(lambda q: q[:-1]), says=("13 rows", "14 rests")),
    Case(
        "labels-nan",
        "33",
        1,
        labels=quaternions(lambda q: np.where(np.arange(len(q))[:, None] == 3, np.nan, q)),
        says=("row 4",),
    ),
    Case(
        "labels-zero",
        "33",
        1,
        labels=quaternions(lambda q: np.where(np.arange(len(q))[:, None] == 3, 0, q)),
        says=("row 4", "norm 0"),
    ),
    Case("labels-not-unit", "33", 1, labels=quaternions(lambda q: 1.2 * q), says=("norm 1.2",)),
    Case("unknown-face", "25", 1, labels=ups(lambda up: ["+w", *up[1:]]), says=("row 1", "+w")),
    Case("spans-outside", "25", 1, labels=spans(500.0, 500.0), says=("row 1", "no span")),
    Case("spans-backwards", "25", 1, labels=spans(2.0, -2.0), says=("row 1",)),
    Case("spans-in-turns", "25", 3, labels=spans(1.7, 1.4), without=ALL),
    # rows 33 and 34: reference attitudes
    Case("reference", "-", 0, made=few(14, reference=True), options=("--poses", "reference")),
    Case("reference-gaps", "34", 0, made=few(14, reference=True, reference_gaps=3), options=("--poses", "reference")),
    Case(
        "reference-zeros",
        "34",
        0,
        lambda table: {k: np.where(table["t_s"] < 3, 0.0, v) if k.startswith("ref") else v for k, v in table.items()},
        made=few(14, reference=True),
        options=("--poses", "reference"),
    ),
    Case(
        "reference-not-unit", "33", 1, cell("ref_qw", 9, 3.0), made=few(14, reference=True), says=("norm", "sample 10")
    ),
    Case(
        "reference-lost",
        "34",
        3,
        lambda t: {k: v * np.nan if k.startswith("ref") else v for k, v in t.items()},
        made=few(14, reference=True),
        options=("--poses", "reference"),
        without=ALL,
    ),
    Case("no-reference", "34", 3, options=("--poses", "reference"), without=ALL, says=("ref_q",)),
    # missing sensors
    Case("only-acc", "-", 0, made=only("acc")),
    Case("only-gyr", "-", 3, made=only("gyr"), without=ALL, says=("--poses FILE",)),
    Case("only-mag", "-", 3, made=only("mag"), without=ALL),
    Case("no-acc", "-", 3, made=only("gyr", "mag"), without=ALL, has=NEEDS),
    Case("no-gyr", "-", 0, made=only("acc", "mag")),
    Case("mag-asked-but-absent", "-", 1, made=only("acc", "gyr"), options=("--sensors", "mag"), says=("magnetometer",)),
    # row 67: place
    Case("latitude-95", "67", 2, options=("--at", "95,10"), says=("latitude",)),
    Case("year-2040", "67", 1, options=("--at", "52,13,2040-01-01"), says=("2040", "--field")),
    Case("gravity-of-the-moon", "67", 2, options=("--gravity", "1.62"), says=("gravity",)),
    Case("gravity-nan", "67", 2, options=("--gravity", "nan"), says=("gravity",)),
    # row 69: solvers by name, on data that they cannot work with
    *(
        Case(f"method-{m}", "69", 0, made=few(14), options=("--method", m))
        for m in ("one-step", "ellipsoid", "triangular", "alternation", "eigen", "svd", "ukf", "gauss-newton")
    ),
    Case("method-unknown", "69", 2, options=("--method", "magic"), says=("gls-ml",)),
]


def written(folder: Path, case: Case) -> Arguments:
    """The case's files in `folder`, and the arguments that calibrate them."""
    made = case.made()
    table = columns(made.recording)
    table = case.damage(table) or table
    write_table(folder / "session.parquet", {k: np.asarray(v, dtype=np.float64) for k, v in table.items()})
    arguments: Arguments = ["calibrate", "session.parquet", *case.options, "-o", "cal.json", "--json"]
    if case.labels is not None:
        (folder / "poses.csv").write_text(as_csv(case.labels(made)))
        arguments += ["--poses", "poses.csv"]
    return arguments


def errors_deg(estimate: Calibration, truth: Calibration, scale: Mapping[str, float]) -> dict[str, float]:
    """Rms angle over the sphere between calibrated and true directions, after one rotation common to the sensors.

    The free route has a frame of its own, so the accelerometer's rotation (or that of the first sensor there is)
    is taken out of all; a magnetometer is told up to its sign and its field's strength. `scale` multiplied the
    readings; 0 leaves a sensor out of the comparison.
    """
    u = np.random.default_rng(0).normal(size=(400, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    common, errors = None, {}
    for kind, model in estimate.models.items():
        if scale.get(kind) == 0.0:
            continue
        true = truth.models[kind]
        factor = scale.get(kind, 1.0)
        E = model.H @ np.linalg.inv(true.H) * factor
        offset = model.H @ (model.B - factor * true.B)
        Q = so3.polar(E)[0]
        common = Q if common is None else common
        reference = true.reference_vector
        size = 1.0 if kind == "gyr" or reference is None else float(np.linalg.norm(reference))
        v = size * u @ E.T - (0 if kind == "gyr" else offset)
        cosine = np.sum((u @ common.T) * v, axis=1) / np.linalg.norm(v, axis=1)
        errors[kind] = float(np.degrees(np.sqrt(np.mean(np.arccos(np.clip(cosine, -1, 1)) ** 2))))
    return errors


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_calibrate(case: Case, tmp_path: Path) -> None:
    outcome = margcal(tmp_path, *written(tmp_path, case))
    assert outcome.status == case.status, outcome.err
    assert outcome.new == ({"cal.json"} if case.status == 0 else frozenset())
    told = outcome.err
    if case.status in (0, 3):
        assert set(case.has) <= outcome.codes
        told += " ".join(i["text"] for i in outcome.plain["issues"])
        for kind in case.without:
            assert outcome.plain.get(kind) is None
    for word in case.says:
        assert word in told, told
    if case.status == 1:
        assert any(
            name in outcome.err
            for name in ("session.parquet", "poses.csv", "poses table", "--poses", "date", "magnetometer")
        )
    if case.status == 0:
        calibration = load(tmp_path / "cal.json")
        assert calibration.models and not set(case.without) & set(calibration.models)
        for kind, error in errors_deg(calibration, case.made().truth, case.scale).items():
            claimed = calibration.models[kind].expected_error_deg  # type: ignore[index]
            assert claimed is not None and np.isfinite(claimed), kind
            assert error <= 3 * claimed + 0.1, (kind, error, claimed)
