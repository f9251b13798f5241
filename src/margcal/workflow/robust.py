"""Bad rests and turns: found by the fit itself, named, and left out while enough remain.

A wrong label, a disturbed field, a node that was moved during its rest: each contradicts what the other rests
say. The rows that the fit would most like to lose are taken out, the fit is made anew, and they are tested
against its prediction: only what misses that by more than chance allows, and by more than matters, stays out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np

from margcal.core import so3
from margcal.core.types import Array, Issue, Kind
from margcal.methods.joint import Gyro, JointFit, Priors, Triad, joint_fit, predicted_misfit

FALSE_ALARM = 0.005
"""Probability that anything at all is left out of a faultless recording."""
LOOK_AT = 12.0
"""Fall of the cost, chi-square of 3, from which a suspect is looked at."""
MATTERS = {"acc": 0.005, "mag": 0.01, "rot": math.radians(0.5), "turn": math.radians(1.0), "level": math.radians(8.0)}
"""Least misfit worth leaving something out for: of a reading relative to its magnitude, of an attitude or turn."""
MIN_POSES = 10
"""Rests that must remain (conventions of robustness: below, the recording is refused)."""
MAX_SHARE = 0.3
"""Share of the rests that may be left out; beyond, the data contradict the model."""


@dataclass(frozen=True)
class LeftOut:
    """Something that was left out: `what` ('acc', 'mag', 'rot', 'turn') of rest or turn `index`."""

    what: str
    index: int
    chi2: float
    limit: float
    misfit: float


@dataclass(frozen=True)
class RobustFit:
    """The joint fit without what contradicted it."""

    fit: JointFit
    left_out: tuple[LeftOut, ...]
    triads: Mapping[Kind, Triad]
    gyro: Gyro | None
    priors: Priors


def robust_joint(triads: Mapping[Kind, Triad], gyro: Gyro | None, R: Array, priors: Priors) -> RobustFit:
    """`joint_fit`, with contradicting rests and turns left out one by one."""
    first = now = RobustFit(joint_fit(triads, gyro, R, priors), (), triads, gyro, priors)
    most = max(1, int(MAX_SHARE * len(R)))
    while len(now.left_out) < most:
        suspect = _suspect(now.fit)
        if suspect is None:
            break
        without = _without(now, *suspect)
        trial = joint_fit(without.triads, without.gyro, now.fit.R, without.priors, components=now.fit.component)
        chi2, misfit = predicted_misfit(trial, now.triads, now.gyro, now.priors, *suspect)
        limit = _limit(now.fit, suspect[0])
        if chi2 < limit or misfit < MATTERS[suspect[0]]:
            break
        found = LeftOut(*suspect, chi2, limit, misfit)
        now = replace(without, fit=trial, left_out=(*now.left_out, found))
    return _taken_in_again(first, now) if len(now.left_out) > 1 else now


def _taken_in_again(first: RobustFit, last: RobustFit) -> RobustFit:
    """`last` with what agrees with it after all: of a wrong label, a good reading may have gone out before it did."""
    now = last
    for out in last.left_out:
        others = tuple(o for o in now.left_out if o is not out)
        with_it = replace(first, left_out=others)
        for other in others:
            with_it = _without(with_it, other.what, other.index)
        # the attitude of that rest may hang on these rows alone: how they fit is seen with them in
        rows = with_it.triads, with_it.gyro, now.fit.R, with_it.priors
        fit = joint_fit(*rows, components=now.fit.component, estimate_components=False)
        if fit.converged and fit.cost - now.fit.cost < LOOK_AT:
            now = replace(with_it, fit=joint_fit(*rows, components=now.fit.component))
    return now


def _suspect(fit: JointFit) -> tuple[str, int] | None:
    """The rows without which the cost would fall most, if it is worth a look."""
    best, where = LOOK_AT, None
    for name in MATTERS:
        chi2 = fit.deletion.get(name)
        if chi2 is None or np.isnan(chi2).all():
            continue
        index = int(np.nanargmax(chi2))
        if chi2[index] > best:
            best, where = float(chi2[index]), (name, index)
    return where


def _without(now: RobustFit, name: str, index: int) -> RobustFit:
    if name == "rot":
        assert now.priors.R0 is not None
        R0 = now.priors.R0.copy()
        R0[index] = np.nan
        return replace(now, priors=replace(now.priors, R0=R0))
    if name == "level":
        assert now.priors.up is not None
        up = now.priors.up.copy()
        up[index] = np.nan
        return replace(now, priors=replace(now.priors, up=up))
    if name == "turn":
        # the turn stays in the batch, so that numbers keep their meaning, and counts for nothing
        assert now.gyro is not None
        weight = np.ones(len(now.gyro.before)) if now.gyro.weight is None else now.gyro.weight.copy()
        weight[index] = 0.0
        return replace(now, gyro=replace(now.gyro, weight=weight))
    kind: Kind = "acc" if name == "acc" else "mag"
    y = now.triads[kind].y.copy()
    y[index] = np.nan
    return replace(now, triads={**now.triads, kind: replace(now.triads[kind], y=y)})


def _limit(fit: JointFit, name: str) -> float:
    """Quantile of the largest of n predicted misfits, each 3 F(3, redundancy): chi-square by Wilson and Hilferty,
    widened for the variance component that is estimated from few residuals."""
    n = sum(int(np.isfinite(c).sum()) for k, c in fit.deletion.items() if k in MATTERS)
    z = NormalDist().inv_cdf(1 - FALSE_ALARM / max(n, 1))
    chi2 = 3 * (1 - 2 / 27 + z * math.sqrt(2 / 27)) ** 3
    nu = max(fit.redundancy.get(name, 1.0) - 3, 1.0)
    return chi2 * (1 + 10 / nu + 40 / nu**2)


def issues_of(robust: RobustFit, cube: bool) -> list[Issue]:
    """What was left out, in words: which rest, what is wrong with it, and for a label the likely one."""
    found = []
    for out in robust.left_out:
        number = out.index + 1
        if out.what == "turn":
            assert robust.gyro is not None
            a, b = robust.gyro.before[out.index] + 1, robust.gyro.after[out.index] + 1
            text = (
                f"turn from rest {a} to {b} ends {np.degrees(out.misfit):.1f} degrees from where the rests lie; it was "
                "left out of the gyroscope's fit (a saturated, interrupted or too violent turn)"
            )
            found.append(Issue("turn-left-out", "warn", text, "gyr", out.chi2, out.limit))
        elif out.what == "level":
            found.append(_face_issue(robust, out))
        elif out.what == "rot":
            found.append(_label_issue(robust, out, cube))
        else:
            kind: Kind = "acc" if out.what == "acc" else "mag"
            why = (
                "most likely the field was disturbed there (iron, a phone, another place)"
                if kind == "mag"
                else "most likely the node was touched or moved there"
            )
            name = {"acc": "accelerometer", "mag": "magnetometer"}[kind]
            text = f"{name}: rest {number} is off by {out.misfit * 100:.1f} % and was left out: {why}"
            found.append(Issue("pose-left-out", "warn", text, kind, out.chi2, out.limit))
    return found


def _face_issue(robust: RobustFit, out: LeftOut) -> Issue:
    up = robust.fit.R[out.index][2]
    k = int(np.argmax(np.abs(up)))
    text = (
        f"rest {out.index + 1} lay {np.degrees(out.misfit):.1f} degrees from the face that it was given; its label was "
        f"left out: most likely {'-' if up[k] < 0 else '+'}{'xyz'[k]} was up"
    )
    return Issue("label-left-out", "warn", text, None, out.chi2, out.limit)


def _label_issue(robust: RobustFit, out: LeftOut, cube: bool) -> Issue:
    number = out.index + 1
    text = (
        f"rest {number} lay {np.degrees(out.misfit):.1f} degrees from the attitude that it was given; "
        "its attitude was left out"
    )
    if cube and out.misfit > math.radians(20):
        group = so3.cube_group()
        nearest = group[int(np.argmin(so3.angle_between(group, robust.fit.R[out.index])))]
        names = ["+x", "-x", "+y", "-y", "+z", "-z"]
        axes = np.vstack([np.eye(3), -np.eye(3)])[[0, 3, 1, 4, 2, 5]]
        up = names[int(np.argmax(axes @ nearest[2]))]
        front = names[int(np.argmax(axes @ nearest[1]))]
        text += f": a wrong label; most likely right is up {up}, front {front}"
    else:
        text += ": it was put down badly, or moved during the rest"
    return Issue("label-left-out", "warn", text, None, out.chi2, out.limit)
