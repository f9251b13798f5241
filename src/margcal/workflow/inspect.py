"""What recordings can be used for, before anything is fitted: `inspect`.

Readings, units, clocks (`lint`), rests, turns and directions (`inspect_coverage`), axes, handedness, sign and delay
(`inspect_axes`). Every look becomes a `Finding`, also those with nothing to say; `Inspection.conclusion` sums up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from margcal.core.errors import UsageError
from margcal.core.types import Array, Issue, Kind, Mask, Recording
from margcal.core.units import STANDARD_GRAVITY, UNITS
from margcal.workflow.findings import ORDER, Finding, from_issue
from margcal.workflow.inspect_axes import axes_of, inspect_axes
from margcal.workflow.inspect_coverage import Carried, as_findings, inspect_coverage
from margcal.workflow.job import NAMES
from margcal.workflow.lint import lint
from margcal.workflow.lint_units import blocks_of, sphere_of, turn_ratio
from margcal.workflow.place import Place
from margcal.workflow.segment import Segmentation, find_poses, measured

BY_SENSOR = ("readings", "unit", "alive", "range", "resolution", "clock")
"""Checks of `lint` that every sensor gets, found faultless where lint says nothing."""
UPS = ("+x", "-x", "+y", "-y", "+z", "-z")


@dataclass(frozen=True)
class Inspection:
    """What was looked at, in the order in which people read it.

    Attributes
    ----------
    findings : tuple of Finding
    carried : tuple of Carried
        What the recordings carry of each sensor.
    segmentation : Segmentation or None
        Rests and turns; None where a recording was not understood.
    """

    findings: tuple[Finding, ...]
    carried: tuple[Carried, ...]
    segmentation: Segmentation | None

    @property
    def level(self) -> str:
        """The worst level of all findings."""
        return next((g for g in ORDER if any(f.level == g for f in self.findings)), "pass")

    @property
    def conclusion(self) -> str:
        """All of it in one line."""
        carries: dict[Kind | None, str] = {f.sensor: f.level for f in self.findings if f.check == "carries"}
        whole: dict[Kind, str] = {c.kind: c.level for c in self.carried}
        parts: dict[str, list[str]] = {"pass": [], "warn": [], "fail": []}
        for kind in carries:
            if kind is not None:
                parts[whole.get(kind, "fail")].append(NAMES[kind])
        text = ["ready to calibrate: " + _and(parts["pass"])] if parts["pass"] else []
        text += ["in part: " + _and(parts["warn"])] if parts["warn"] else []
        text += ["not: " + _and(parts["fail"])] if parts["fail"] else []
        for level, word in (("fail", "failure"), ("warn", "warning")):
            n = sum(f.level == level and f.check != "carries" for f in self.findings)
            text += [f"{n} {word}{'s' if n > 1 else ''}"] if n else []
        return "; ".join(text or ["nothing can be calibrated"])

    @property
    def next_steps(self) -> tuple[str, ...]:
        """What to do or record next, without repetition, the gravest first."""
        told = [f for g in ("fail", "warn") for f in self.findings if f.level == g and f.todo]
        if any(c.level != "pass" for c in self.carried):  # that says it already
            told = [f for f in told if f.check not in ("rests", "turns", "faces", "directions")]
        return tuple(dict.fromkeys(f.todo for f in told))


def inspect(*recordings: Recording, place: Place | None = None, up: str | None = None) -> Inspection:
    """Look at recordings of one node before calibrating them.

    Parameters
    ----------
    *recordings : Recording
    place : Place, optional
        Its dip tells whether accelerometer and magnetometer have the same sign.
    up : str, optional
        Which side of the node (``+z``) was up in the first two seconds: tells the accelerometer's sign.

    Returns
    -------
    Inspection

    Raises
    ------
    UsageError
        If there is no recording, or `up` names no side.
    """
    if not recordings:
        raise UsageError("no recording to check")
    if up is not None:
        up = up if up[:1] in "+-" else f"+{up}"
        if up not in UPS:
            raise UsageError(f"--up {up!r} is none of {', '.join(UPS)}")
    issues = [i for r in recordings for i in r.issues] + [i for r in recordings for i in lint(r)]
    findings = _readings(recordings, issues)
    if any(i.level == "fail" and i.sensor is None for i in issues):
        return Inspection(_sorted(findings), (), None)
    lame: list[Kind] = [i.sensor for i in issues if i.level == "fail" and i.sensor is not None]
    usable = tuple(measured(replace(r, **dict.fromkeys(lame))) for r in recordings)
    usable = tuple(r for r in usable if r.streams)
    if not usable:
        return Inspection(_sorted(findings), (), None)
    segmentation = find_poses(*usable)
    findings += [from_issue(i) for i in segmentation.issues]
    gains = _gains(usable)
    coverage, carried = inspect_coverage(usable, segmentation, lame, gains)
    findings += coverage
    findings += inspect_axes(_moving(recordings, issues), place, up)
    findings += as_findings(carried, issues)
    return Inspection(_sorted(findings), tuple(carried), segmentation)


def _moving(recordings: tuple[Recording, ...], issues: list[Issue]) -> tuple[Recording, ...]:
    """Recordings with the sensors that were read at all: a saturated one still tells how its axes lie."""
    dead = {i.sensor: None for i in issues if i.level == "fail" and i.sensor is not None and i.code != "saturated"}
    return tuple(measured(replace(r, **dead)) for r in recordings)


def _gains(recordings: tuple[Recording, ...]) -> dict[Kind, Array]:
    """Rough gain of a gyroscope in counts, from gravity's turns."""
    if any(r.gyr is not None and UNITS["gyr"][r.gyr.unit] is not None for r in recordings):
        return {}
    found = [a for a in (axes_of(r, "acc") for r in recordings) if a is not None]
    return {"gyr": found[0].relation.G} if found else {}


def _and(names: list[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


CHECKS = (
    *BY_SENSOR,
    "calibrated",
    "temperature-span",
    "rests",
    "turns",
    "faces",
    "directions",
    "attitudes",
    "axes",
    "sign",
    "delay",
    "carries",
)
"""Order in which people read them; unknown ones stand before `rests`."""


def _sorted(findings: list[Finding]) -> tuple[Finding, ...]:
    def place(finding: Finding) -> int:
        return CHECKS.index(finding.check) if finding.check in CHECKS else CHECKS.index("rests")

    return tuple(sorted(findings, key=place))


# --- readings ----------------------------------------------------------------------------------------


def _readings(recordings: tuple[Recording, ...], issues: list[Issue]) -> list[Finding]:
    """What lint found, and for each sensor what it did not find."""
    told = [from_issue(i) for i in issues]
    out = list(told)
    for kind in NAMES:
        mine = [r for r in recordings if kind in r.streams]
        if not mine:
            continue
        bad = {f.check for f in told if f.sensor == kind and f.level != "note"}
        dead = any(f.sensor == kind and f.level == "fail" for f in told)
        for check in BY_SENSOR:
            if check not in bad and not dead:
                out.append(_faultless(check, kind, mine[0]))
    return out


def _faultless(check: str, kind: Kind, recording: Recording) -> Finding:
    name, stream = NAMES[kind], recording.streams[kind]
    if check == "unit":
        return _unit_finding(kind, recording)
    text = {
        "readings": f"{name}: {len(stream.t)} readings, none missing",
        "alive": f"{name}: no axis stuck, nothing frozen",
        "range": f"{name}: no reading at the end of the scale",
        "resolution": f"{name}: steps finer than the noise",
        "clock": f"{name}: steady, {stream.rate:.4g} Hz",
    }[check]
    value = {"readings": float(len(stream.t)), "range": 0.0, "clock": float(stream.rate)}.get(check)
    return Finding(check, "pass", text, kind, value, unit="Hz" if check == "clock" else "")


def _unit_finding(kind: Kind, recording: Recording) -> Finding:
    """The figure behind a unit that can be."""
    name, stream = NAMES[kind], recording.streams[kind]
    factor = UNITS[kind][stream.unit]
    if stream.unit == "count":
        return Finding("unit", "pass", f"{name}: raw counts, taken as they are", kind, unit="count")
    finite = replace(stream, t=stream.t[_whole(stream.y)], y=stream.y[_whole(stream.y)])
    if len(finite.t) < 16:
        return Finding("unit", "pass", f"{name}: {stream.unit}", kind)
    if kind == "acc" and factor is not None:
        blocks = blocks_of(finite)
        quiet = blocks.mean[blocks.scatter <= np.quantile(blocks.scatter, 0.1)] if len(blocks.mean) else finite.y
        g = float(np.median(np.linalg.norm(quiet, axis=1))) * factor / STANDARD_GRAVITY
        return Finding("unit", "pass", f"{name}: |a| at rest is {g:.3f} of gravity", kind, g, 1.0, "g")
    if kind == "gyr" and recording.acc is not None:
        ratio = turn_ratio(measured(recording).streams["acc"], finite) if "acc" in measured(recording).streams else None
        if ratio is not None:
            text = f"{name}: gravity turns {ratio:.2f} times as fast as {stream.unit} say"
            return Finding("unit", "pass", text, kind, ratio, 1.0)
    if kind == "mag" and factor is not None:
        sphere = sphere_of(finite.y)
        if sphere is not None and sphere.rms < 0.25 * sphere.radius and sphere.radius_se < 0.1 * sphere.radius:
            text = f"{name}: the field is {sphere.radius * factor:.1f} uT"
            return Finding("unit", "pass", text, kind, sphere.radius * factor, None, "uT")
    return Finding("unit", "pass", f"{name}: {stream.unit}, nothing speaks against it", kind)


def _whole(y: Array) -> Mask:
    return np.all(np.isfinite(y), axis=1)
