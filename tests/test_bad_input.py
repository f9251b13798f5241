"""Bad input, row by row of the project's list: each is refused, warned of or mended, and says so.

A case is a small generator that damages a simulated session or a file, the arguments of the program, and what
must come of it: exit status, issue codes, words of the message. Checked for every case beside that: no
traceback and no internal error; an error is one line that names the file; no half-written file and nothing
left behind; a calibration that is written loads again, and is as good as it claims to be.
"""

from __future__ import annotations

import contextlib
import gzip
import io
import json
from collections.abc import Callable, Mapping, Sequence
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
from margcal.files.calfile import dumps, load
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
    sensors that must not be calibrated, `says` words of the message or of an issue. `scale` says by what a sensor's
    readings were multiplied, 0 that it cannot be compared with the truth. `bug` names what the program does wrong
    today; the test is strict, so it tells when that is mended.
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
    bug: str = ""


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


def copied(source: str, to: str) -> Damage:
    def damage(table: Columns) -> None:
        table[f"{to}_count"] = table[f"{source}_count"].copy()

    return damage


def nearly_copied(source: str, to: str) -> Damage:
    """The axis `to` senses what `source` senses, with a noise of its own."""

    def damage(table: Columns) -> None:
        own = np.random.default_rng(0).integers(-2, 3, len(table["t_s"]))
        table[f"{to}_count"] = table[f"{source}_count"] + own

    return damage


def noise(kind: str) -> Damage:
    def damage(table: Columns) -> None:
        rng = np.random.default_rng(0)
        for name in axes(kind):
            table[name] = np.round(rng.normal(100, 3, len(table["t_s"])))

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


def turning(made: Simulation) -> Columns:
    """Spans in the middle of the turns, where nothing rests (the last one lies in its rest)."""
    start, stop = made.start + 1.7, made.start + 2.9
    start[-1], stop[-1] = made.start[-1], made.stop[-1]
    return {**quaternions()(made), "start_s": start, "stop_s": stop}


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
    Case(
        "acc-g-as-mps2",
        "3",
        1,
        unit("acc", "g", "mps2"),
        says=("--units acc=g",),
    ),
    Case(
        "acc-mps2-as-g",
        "3",
        1,
        unit("acc", "mps2", "g"),
        says=("--units acc=mps2",),
    ),
    Case(
        "acc-count-as-mps2",
        "4",
        1,
        unit("acc", "count", "mps2"),
        says=("--units acc=count",),
    ),
    Case(
        "gyr-dps-as-radps",
        "5",
        1,
        unit("gyr", "dps", "radps"),
        says=("--units gyr=dps",),
    ),
    Case(
        "gyr-radps-as-dps",
        "5",
        1,
        unit("gyr", "radps", "dps"),
        says=("--units gyr=radps",),
    ),
    Case(
        "mag-gauss-as-uT",
        "6",
        1,
        unit("mag", "gauss", "uT"),
        says=("--units mag=gauss",),
    ),
    Case(
        "mag-nT-as-uT",
        "6",
        1,
        unit("mag", "nT", "uT"),
        says=("--units mag=nT",),
    ),
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
    Case("stuck-acc-for-4-s", "10", 0, stuck("acc", "x", 300, 500), has=(("warn", "stuck-stretch", "acc"),)),
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
    Case("acc-twice-in-acc", "10", 3, copied("acc_x", "acc_y"), has=(("fail", "same-axes", "acc"),), says=("x and y",)),
    Case("mag-twice-in-mag", "10", 0, copied("mag_x", "mag_y"), has=(("fail", "same-axes", "mag"),), without=("mag",)),
    Case("gyr-nearly-twice", "10", 0, nearly_copied("gyr_x", "gyr_y"), without=("gyr",)),
    Case("mag-nearly-twice", "10", 0, nearly_copied("mag_x", "mag_y"), without=("mag",)),
    Case(
        "acc-called-mag",
        "10",
        0,
        lambda table: {k: table[k.replace("mag", "acc")] for k in table},
        has=(("fail", "same-readings", "mag"),),
        without=("mag",),
    ),
    Case(
        "gyr-is-noise",
        "10",
        0,
        noise("gyr"),
        without=("gyr",),
    ),
    Case("mag-is-noise", "10", 0, noise("mag"), without=("mag",)),
    Case("acc-is-noise", "10", 3, noise("acc"), without=ALL),
    Case(
        "absurd-numbers",
        "2",
        3,
        lambda table: {k: v if k == "t_s" else 1e300 * v for k, v in table.items()},
        has=(("fail", "too-large", "acc"), ("fail", "too-large", "gyr"), ("fail", "too-large", "mag")),
        without=ALL,
    ),
    Case(
        "tiny-counts",
        "-",
        0,
        lambda table: {k: v if k == "t_s" else 1e-9 * v for k, v in table.items()},
        scale=dict.fromkeys(ALL, 1e-9),
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
    Case(
        "about-vertical-labels",
        "19",
        3,
        made=about(2),
        labels=quaternions(),
        without=ALL,
        says=("one axis",),
    ),
    Case("about-x", "19", 3, made=about(0, step=0.7), without=ALL),
    Case(
        "about-x-labels",
        "19",
        3,
        made=about(0, step=0.7),
        labels=quaternions(),
        without=ALL,
        says=("one axis",),
    ),
    Case(
        "about-vertical-swing",
        "19",
        3,
        made=about(2),
        options=("--poses", "swing"),
        without=ALL,
    ),
    Case("narrow-cone", "19", 3, made=cone(10), without=ALL),
    Case(
        "narrow-cone-swing",
        "19",
        3,
        made=cone(10),
        options=("--poses", "swing"),
        without=ALL,
    ),
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
    Case(
        "wrong-up",
        "25",
        0,
        made=few(14),
        labels=ups(lambda up: flip(up, 5)),
        says=("rest 6",),
    ),
    Case(
        "same-labels",
        "25",
        3,
        made=few(8),
        labels=quaternions(lambda q: np.repeat(q[:1], len(q), axis=0)),
        without=ALL,
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
    Case("spans-in-turns", "25", 3, labels=turning, without=ALL, says=("rest",)),
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
        for m in ("one-step", "ellipsoid", "eigen", "ukf")
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


def listed(cases: Sequence[Case | File | Cal]) -> list[Any]:
    def marks(case: Case | File | Cal) -> list[pytest.MarkDecorator]:
        return [pytest.mark.xfail(strict=True, reason=f"row {case.row}: {case.bug}")] if case.bug else []

    return [pytest.param(case, id=case.name, marks=marks(case)) for case in cases]


@pytest.mark.parametrize("case", listed(CASES))
def test_calibrate(case: Case, tmp_path: Path) -> None:
    outcome = margcal(tmp_path, *written(tmp_path, case))
    assert outcome.status == case.status, outcome.err
    assert outcome.new == ({"cal.json"} if case.status == 0 else frozenset())
    told = outcome.err
    if case.status in (0, 3):
        assert set(case.has) <= outcome.codes
        told += " ".join(i["text"] for i in outcome.plain["issues"])
        assert (outcome.plain["verdict"] == "fail") == (case.status == 3)
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
        apart = {i.sensor for i in calibration.issues if i.code == "own-frame"}
        unsure = {i.sensor for i in calibration.issues if i.code == "no-uncertainty"}
        scale = {**case.scale, **{k: 0.0 for k in apart if k}}
        for kind, error in errors_deg(calibration, case.made().truth, scale).items():
            claimed = calibration.models[kind].expected_error_deg  # type: ignore[index]
            assert claimed is not None or kind in unsure, kind
            assert error <= 3 * (0.5 if claimed is None else claimed) + 0.1, (kind, error, claimed)


# --- files -------------------------------------------------------------------------------------------


@cache
def text() -> str:
    """Eight seconds of a sound session as CSV."""
    return as_csv({k: v[:400] for k, v in columns(session().recording).items()})


def parquet(table: Mapping[str, Any]) -> bytes:
    import pyarrow as pa
    import pyarrow.parquet as pq

    sink = io.BytesIO()
    pq.write_table(pa.table(dict(table)), sink)
    return sink.getvalue()


@cache
def sound_parquet() -> bytes:
    return parquet({k: v[:400] for k, v in columns(session().recording).items()})


def with_line(number: int, change: Callable[[str], str]) -> str:
    """The sound file with line `number` (the header is 1) changed."""
    lines = text().splitlines()
    lines[number - 1] = change(lines[number - 1])
    return "\n".join(lines) + "\n"


def other_header(change: Callable[[str], str]) -> str:
    return with_line(1, change)


def no_numbers(line: str) -> str:
    return ",".join("ERR" if i == 3 else c for i, c in enumerate(line.split(",")))


@dataclass(frozen=True)
class File:
    """A file that `segment` reads, its name, and what must come of it."""

    name: str
    row: str
    status: int
    content: Callable[[], str | bytes]
    says: tuple[str, ...] = ()
    suffix: str = ".csv"
    options: tuple[str, ...] = ()
    codes: tuple[str, ...] = ()
    bug: str = ""


FILES = [
    File("sound", "-", 0, text),
    File("semicolon-decimal-comma", "37", 0, lambda: as_csv(columns_8s(), ";", ","), codes=("decimal-comma",)),
    File("tab", "37", 0, lambda: as_csv(columns_8s(), "\t")),
    File("comma-twice", "37", 1, lambda: as_csv(columns_8s(), ",", ","), ("comma", "semicolon")),
    File("thousands", "37", 1, lambda: with_line(9, lambda s: '"1,234",' + s.split(",", 1)[1]), ("1,234",)),
    File("bom", "38", 0, lambda: b"\xef\xbb\xbf" + text().encode()),
    File("utf-16", "38", 0, lambda: text().encode("utf-16")),
    File("unknown-columns", "39", 0, lambda: text().replace("\n", ",1\n").replace(",1\n", ",foo\n", 1)),
    File(
        "no-sensor",
        "39",
        1,
        lambda: other_header(
            lambda s: s.replace("_count", "_c").replace("acc", "a").replace("gyr", "b").replace("mag", "c")
        ),
        ("t_s", "no sensor"),
    ),
    File("upper-case", "39", 0, lambda: other_header(str.upper)),
    File("an-axis-is-missing", "39", 1, lambda: other_header(lambda s: s.replace("acc_y", "foo_y")), ("acc_y",)),
    File("no-time", "39", 1, lambda: other_header(lambda s: s.replace("t_s", "time")), ("t_s",)),
    File(
        "no-time-but-rate", "39", 0, lambda: other_header(lambda s: s.replace("t_s", "time")), options=("--rate", "50")
    ),
    File(
        "column-twice", "40", 1, lambda: other_header(lambda s: s.replace("acc_y", "acc_x")), ("acc_x_count", "twice")
    ),
    File("no-header", "41", 1, lambda: text().split("\n", 1)[1], ("first row",)),
    File("row-of-units", "41", 1, lambda: text().replace("\n", "\ns" + ",count" * 9 + "\n", 1), ("line 2", "count")),
    File("comments", "41", 0, lambda: "# a node\n// on a table\n" + text()),
    File("empty", "42", 1, lambda: "", ("empty",)),
    File("blank-lines", "42", 1, lambda: "\n\n\n", ("no rows",)),
    File("header-only", "42", 1, lambda: text().split("\n")[0] + "\n", ("no rows",)),
    File("one-row", "42", 3, lambda: "\n".join(text().split("\n")[:2]) + "\n", ("rests",)),
    File("two-rows", "42", 3, lambda: "\n".join(text().split("\n")[:3]) + "\n", ("rests",)),
    File("short-row", "43", 1, lambda: with_line(101, lambda s: s[:20]), ("line 101", "--skip-bad")),
    File("long-row", "43", 1, lambda: with_line(101, lambda s: s + ",7,8"), ("line 101", "--skip-bad")),
    File(
        "long-row-skipped",
        "43",
        0,
        lambda: with_line(101, lambda s: s + ",7,8"),
        options=("--skip-bad", "1"),
        codes=("rows-skipped",),
    ),
    File(
        "two-bad-one-skipped",
        "43",
        1,
        lambda: with_line(101, lambda s: s + ",7,8\n" + s + ",7"),
        options=("--skip-bad", "1"),
    ),
    File("text-in-a-number", "43", 1, lambda: with_line(101, no_numbers), ("line 101", "acc_z_count", "ERR")),
    File("open-quote", "43", 1, lambda: with_line(101, lambda s: '"' + s), ("line 101", "quote")),
    File("nul", "43", 1, lambda: with_line(101, lambda s: s[:5] + "\0" + s[5:]), ("line 101", "NUL")),
    File("cut-in-a-row", "43", 1, lambda: text()[:-30], ("line 401",)),
    File("infinite", "2", 1, lambda: with_line(50, lambda s: s.rsplit(",", 1)[0] + ",1e999"), ("mag", "infinite")),
    File("not-available", "1", 0, lambda: with_line(50, lambda s: s.rsplit(",", 1)[0] + ",N/A"), codes=("nan-rows",)),
    File("hexadecimal", "43", 1, lambda: text().replace("\n", "\n0x", 5), ("0x",)),
    File("one-endless-line", "43", 1, lambda: text().split("\n")[0] + "\n" + "1" * 2_000_000, ("line 2",)),
    File("binary", "43", 1, lambda: bytes(range(256)) * 40, ("binary",)),
    File("web-page", "41", 1, lambda: "<html><body>Not found</body></html>"),
    File("zip", "45", 1, lambda: b"PK\x03\x04" + b"\0" * 60, ("zip",), ".xlsx"),
    File("cut-gzip", "46", 1, lambda: gzip.compress(text().encode())[:-200], ("cut",), ".csv.gz"),
    File("terminal-codes", "59", 0, lambda: text().replace("\n", ",1\n").replace(",1\n", ",\x1b[31mred\n", 1)),
    File("terminal-codes-refused", "59", 1, lambda: "t_s,\x1b[31mred\n1,2\n", ("?",)),
    File("parquet", "-", 0, sound_parquet, suffix=".parquet"),
    File("parquet-cut-in-half", "46", 1, lambda: sound_parquet()[: len(sound_parquet()) // 2], ("cut",), ".parquet"),
    File("parquet-without-its-end", "46", 1, lambda: sound_parquet()[:-5], ("cut",), ".parquet"),
    File("parquet-of-nothing", "46", 1, lambda: b"", ("0 bytes",), ".parquet"),
    File(
        "parquet-with-a-hole",
        "46",
        1,
        lambda: sound_parquet()[:200] + bytes(500) + sound_parquet()[700:],
        ("damaged",),
        ".parquet",
    ),
    File(
        "parquet-of-text",
        "43",
        1,
        lambda: parquet({k: [str(x) for x in v] for k, v in columns_8s().items()}),
        ("acc_x_count", "string"),
        ".parquet",
    ),
    File(
        "parquet-of-lists",
        "43",
        1,
        lambda: parquet({**columns_8s(), "acc_x_count": [[1.0, 2.0]] * 400}),
        ("acc_x_count",),
        ".parquet",
    ),
    File(
        "parquet-no-rows",
        "42",
        1,
        lambda: parquet({k: v[:0] for k, v in columns_8s().items()}),
        ("no rows",),
        ".parquet",
    ),
    File("csv-called-parquet", "46", 1, text, ("Parquet",), ".parquet"),
    File("parquet-called-csv", "46", 1, sound_parquet, (".parquet",)),
    File("too-large", "44", 1, text, ("--max-bytes",), options=("--max-bytes", "1000")),
    File("rate-of-nothing", "16", 1, text, ("rate",), options=("--rate", "0")),
    File("units-unknown", "6", 1, text, ("furlong",), options=("--units", "acc=furlong")),
    File("units-garbled", "6", 2, text, ("SENSOR=UNIT",), options=("--units", "acc")),
]


def columns_8s() -> Columns:
    return {k: v[:400] for k, v in columns(session().recording).items()}


@pytest.mark.parametrize("file", listed(FILES))
def test_read(file: File, tmp_path: Path) -> None:
    content = file.content()
    (tmp_path / f"walk{file.suffix}").write_bytes(content if isinstance(content, bytes) else content.encode())
    outcome = margcal(tmp_path, "segment", f"walk{file.suffix}", "--json", *file.options)
    assert outcome.status == file.status, outcome.err
    assert "\x1b" not in outcome.err + outcome.out
    for word in file.says:
        assert word in outcome.err, outcome.err
    if file.status == 1 and not file.options:
        assert f"walk{file.suffix}" in outcome.err
    if file.status == 0:
        assert set(file.codes) == {i["code"] for i in outcome.plain["issues"]} - {"knocked-rest"}


@pytest.mark.parametrize(
    ("files", "says"),
    [
        ({"x.pdf": "a"}, "no table"),
        (
            {"a.csv": "t_s,acc_x_g,acc_y_g,acc_z_g\n0,0,0,1\n", "b.csv": "t_s,acc_x_g,acc_y_g,acc_z_g\n0,0,0,1\n"},
            "a.csv",
        ),
        ({"a.csv": "t_s,x\n0,1\n", "b.csv": "t_s,y\n0,1\n"}, "a.csv, b.csv"),
    ],
    ids=["no-table", "a-sensor-twice", "no-sensor"],
)
def test_folders(files: dict[str, str], says: str, tmp_path: Path) -> None:
    (tmp_path / "node").mkdir()
    for name, content in files.items():
        (tmp_path / "node" / name).write_text(content)
    outcome = margcal(tmp_path, "segment", "node")
    assert outcome.status == 1 and says in outcome.err


def test_two_recordings_in_different_units(tmp_path: Path) -> None:
    write_table(tmp_path / "a.parquet", columns(session().recording))
    write_table(tmp_path / "b.parquet", unit("acc", "g", "g")(columns(session().recording)) or {})
    outcome = margcal(tmp_path, "calibrate", "a.parquet", "b.parquet")
    assert outcome.status == 1
    assert "count in a.parquet" in outcome.err and "g in b.parquet" in outcome.err


def test_two_nodes_as_one(tmp_path: Path) -> None:
    for seed in (3, 9):
        write_table(tmp_path / f"{seed}.parquet", columns(session(n_poses=24, seed=seed).recording))
    outcome = margcal(tmp_path, "calibrate", "3.parquet", "9.parquet", "-o", "cal.json", "--json")
    assert outcome.status == 3 and not outcome.new


def test_no_such_file(tmp_path: Path) -> None:
    for arguments in (
        ["calibrate", "nix.csv"],
        ["segment", "nix.csv"],
        ["apply", "nix.json", "nix.csv", "-o", "o.csv"],
    ):
        outcome = margcal(tmp_path, *arguments)
        assert outcome.status == 1 and "nix." in outcome.err


# --- calibration files -------------------------------------------------------------------------------


@cache
def truth_text() -> str:
    return dumps(session().truth).decode()


def edited(*place: str | int, to: Any) -> Callable[[], str]:
    """The truth file with the value at `place` replaced."""

    def content() -> str:
        whole = json.loads(truth_text())
        part = whole
        for key in place[:-1]:
            part = part[key]
        part[place[-1]] = to
        return json.dumps(whole)

    return content


def replaced(old: str, new: str) -> Callable[[], str]:
    return lambda: truth_text().replace(old, new, 1)


@dataclass(frozen=True)
class Cal:
    """A calibration file that `apply` is given, and what must come of it."""

    name: str
    row: str
    status: int
    content: Callable[[], str | bytes]
    says: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    bug: str = ""


SINGULAR = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]
CALS = [
    Cal("sound", "-", 0, truth_text),
    Cal("bom", "38", 0, lambda: b"\xef\xbb\xbf" + truth_text().encode()),
    Cal("other-format", "53", 1, edited("format", to="other"), ("margcal-calibration",)),
    Cal("no-format", "53", 1, replaced('"format": "margcal-calibration",', ""), ("format",)),
    Cal("newer", "53", 1, edited("version", to=2), ("newer margcal",)),
    Cal("version-0", "53", 1, edited("version", to=0), ("version",)),
    Cal("version-as-text", "53", 1, edited("version", to="1"), ("version",)),
    Cal("nan", "50", 1, edited("acc", "B", 0, to=float("nan")), ("NaN",)),
    Cal("too-large-a-number", "50", 1, replaced('"version": 1', '"version": 1e999'), ("1e999",)),
    Cal("5000-digits", "50", 1, replaced('"version": 1', '"version": ' + "9" * 5000), ("5000 digits",)),
    Cal("nested-arrays", "50", 1, lambda: "[" * 100_000 + "]" * 100_000, ("deep",)),
    Cal("nested-objects", "50", 1, lambda: '{"a":' * 100_000 + "1" + "}" * 100_000, ("deep",)),
    Cal("two-by-two", "50", 1, edited("acc", "H", to=[[1, 0], [0, 1]]), ("$.acc.H",)),
    Cal("unknown-key", "50", 1, edited("gain", to=1), ("gain",)),
    Cal("unknown-key-in-a-sensor", "50", 1, edited("acc", "gain", to=1), ("gain", "$.acc")),
    Cal("a-key-twice", "50", 1, replaced('"version": 1', '"version": 1, "version": 1'), ("version", "twice")),
    Cal("number-as-text", "50", 1, edited("acc", "B", 0, to="1.5"), ("$.acc.B[0]",)),
    Cal("singular", "51", 1, edited("acc", "H", to=SINGULAR), ("singular", "$.acc.H")),
    Cal(
        "ill-conditioned",
        "51",
        1,
        edited("acc", "H", to=[[1, 0, 0], [0, 1, 0], [0, 0, 0.04]]),
        ("condition", "$.acc.H"),
    ),
    Cal("negative-covariance", "51", 1, edited("acc", "covariance", to=(-np.eye(12)).tolist()), ("$.acc.covariance",)),
    Cal("unknown-unit", "52", 1, edited("acc", "unit", to="furlong"), ("furlong",)),
    Cal("another-raw-unit", "52", 1, edited("acc", "raw_unit", to="g"), ("count", "--force")),
    Cal("another-raw-unit-forced", "52", 0, edited("acc", "raw_unit", to="g"), options=("--force",)),
    Cal("unknown-verdict", "50", 1, edited("verdict", to="splendid"), ("splendid",)),
    Cal("empty", "42", 1, lambda: "", ("JSON",)),
    Cal("cut", "46", 1, lambda: truth_text()[: len(truth_text()) // 2], ("JSON", "line")),
    Cal("no-json", "50", 1, lambda: "t_s,acc_x_g\n0,1\n", ("JSON",)),
    Cal("utf-16", "50", 1, lambda: truth_text().encode("utf-16"), ("UTF-8",)),
    Cal("null", "50", 1, lambda: "null", ("format",)),
]


@pytest.mark.parametrize("cal", listed(CALS))
def test_apply(cal: Cal, tmp_path: Path) -> None:
    content = cal.content()
    (tmp_path / "node.json").write_bytes(content if isinstance(content, bytes) else content.encode())
    (tmp_path / "walk.csv").write_text(text())
    outcome = margcal(tmp_path, "apply", "node.json", "walk.csv", "-o", "si.csv", *cal.options)
    assert outcome.status == cal.status, outcome.err
    assert outcome.new == ({"si.csv"} if cal.status == 0 else frozenset())
    for word in cal.says:
        assert word in outcome.err, outcome.err
    if cal.status == 1:
        assert "node.json" in outcome.err or "walk.csv" in outcome.err
        for arguments in (["report", "node.json", "-o", "r.html"], ["calibrate", "walk.csv", "--nominal", "node.json"]):
            if "--force" not in outcome.err:  # a raw unit is wrong only beside a recording
                assert margcal(tmp_path, *arguments).status == 1


@pytest.mark.parametrize(
    ("walk", "says"),
    [
        (lambda: text()[:-30], "line 401"),
        (lambda: text() + "9,a,b,c,d,e,f,g,h,i\n", "line 402"),
        (lambda: "t_s,foo\n0,1\n", "no sensor"),
        (
            lambda: other_header(
                lambda s: (
                    s.replace("acc_x_count", "acc_x_g")
                    .replace("acc_y_count", "acc_y_g")
                    .replace("acc_z_count", "acc_z_g")
                )
            ),
            "acc is in g",
        ),
    ],
    ids=["cut", "text-at-the-end", "no-sensor", "another-unit"],
)
def test_apply_to_a_bad_recording(walk: Callable[[], str], says: str, tmp_path: Path) -> None:
    """What is found only at the end of the stream leaves no half table either."""
    (tmp_path / "node.json").write_text(truth_text())
    (tmp_path / "walk.csv").write_text(walk())
    outcome = margcal(tmp_path, "apply", "node.json", "walk.csv", "-o", "si.csv")
    assert outcome.status == 1 and says in outcome.err and not outcome.new


# --- results -----------------------------------------------------------------------------------------


def prepared(folder: Path) -> None:
    (folder / "node.json").write_text(truth_text())
    (folder / "walk.csv").write_text(text())
    write_table(folder / "session.parquet", columns(session().recording))


RESULTS = {
    "calibrate": ["calibrate", "session.parquet", "-o", "result.json"],
    "apply": ["apply", "node.json", "walk.csv", "-o", "result.csv"],
    "segment": ["segment", "walk.csv", "-o", "result.csv"],
    "report": ["report", "node.json", "-o", "result.html"],
    "simulate": ["simulate", "-o", "result", "--n-poses", "2"],
}


@pytest.mark.parametrize("verb", RESULTS)
def test_an_existing_result_is_kept(verb: str, tmp_path: Path) -> None:
    prepared(tmp_path)
    arguments = RESULTS[verb]
    result = tmp_path / arguments[arguments.index("-o") + 1]
    keep = result / "session.parquet" if verb == "simulate" else result
    keep.parent.mkdir(exist_ok=True)
    keep.write_text("precious")
    outcome = margcal(tmp_path, *arguments)
    assert outcome.status == 1 and "exists" in outcome.err
    assert keep.read_text() == "precious"


@pytest.mark.parametrize("verb", ["calibrate", "apply", "segment", "report"])
def test_a_folder_that_is_not_there(verb: str, tmp_path: Path) -> None:
    prepared(tmp_path)
    arguments = [a.replace("result", "no/result") for a in RESULTS[verb]]
    outcome = margcal(tmp_path, *arguments)
    assert outcome.status == 1 and "folder" in outcome.err


@pytest.mark.parametrize("verb", ["calibrate", "apply", "segment", "report"])
@pytest.mark.parametrize(
    ("error", "status"),
    [(OSError(28, "No space left on device"), 1), (KeyboardInterrupt(), 130)],
    ids=["disk-full", "ctrl-c"],
)
def test_a_failing_write_leaves_the_old_file(
    verb: str, error: BaseException, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepared(tmp_path)
    arguments = RESULTS[verb]
    result = tmp_path / arguments[arguments.index("-o") + 1]
    result.write_text("precious")

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr("os.fsync", fail)
    outcome = margcal(tmp_path, *arguments, "--overwrite")
    assert outcome.status == status
    assert result.read_text() == "precious" and not outcome.new


def test_a_result_must_not_be_the_input(tmp_path: Path) -> None:
    prepared(tmp_path)
    before = (tmp_path / "walk.csv").read_bytes()
    outcome = margcal(tmp_path, "apply", "node.json", "walk.csv", "-o", "walk.csv", "--overwrite")
    assert outcome.status == 2 and (tmp_path / "walk.csv").read_bytes() == before


@pytest.mark.parametrize(
    "arguments",
    [["bogus"], ["calibrate"], ["segment", "--foo", "x"], ["apply", "a.json"], ["simulate", "-o", "x", "--seed", "-1"]],
    ids=" ".join,
)
def test_usage(arguments: list[str], tmp_path: Path) -> None:
    outcome = margcal(tmp_path, *arguments)
    assert outcome.status == 2 and "--help" in outcome.err


def test_names_in_a_report_are_text(tmp_path: Path) -> None:
    """Row 56."""
    (tmp_path / "node.json").write_text(edited("device", to="<script>alert(1)</script>")())
    assert margcal(tmp_path, "report", "node.json", "-o", "r.html").status == 0
    assert "<script>alert(1)" not in (tmp_path / "r.html").read_text()
