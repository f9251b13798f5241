"""How the sensors' axes lie to each other before any calibration: swapped, reversed, mirrored, late, wrong sign.

`relate` follows gravity and the field through the motion with the gyroscope. What it proves is said; what it cannot
tell (see there) is said too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Kind, Recording, Stream
from margcal.core.units import STANDARD_GRAVITY, UNITS
from margcal.methods.rates import RateRelation, relate
from margcal.workflow.findings import Finding, graded
from margcal.workflow.job import NAMES
from margcal.workflow.lint_units import blocks_of, sphere_of
from margcal.workflow.place import Place

SURE = 0.35
"""Share of the changes that the gyroscope must account for. Measured: 0.42 to 0.99 where the rest agrees too; gait,
translation and still nodes have less, or one axis only (`CONDITION`)."""
CONDITION = 3.0
"""Ratio of largest to smallest gain of G beyond which the motion did not show all axes (a gyroscope's own: 1.2)."""
OFF_AXES_DEG = 30.0
"""Rotation from the nearest order of axes beyond which the sensor does not lie along the gyroscope's axes."""
DELAY_S = 0.005
LATE_S = 0.05
"""Delay from which it is more than a filter's: clocks that do not share an origin."""
CLEAR_DIP = 0.15
"""Least mean of cosine between "up" and field from which its sign means anything."""

_SIGNED = np.concatenate([so3.cube_group(), -so3.cube_group()])


@dataclass(frozen=True)
class Axes:
    """One vector sensor against the gyroscope: `P` (3, 3) takes the gyroscope's axes to the sensor's."""

    relation: RateRelation
    P: Array
    off_deg: float
    turn: Array  # rotation (or reflection) nearest to G

    @property
    def same(self) -> bool:
        return bool(np.allclose(self.P, np.eye(3)))

    @property
    def mirrored(self) -> bool:
        return bool(np.linalg.det(self.P) < 0)


def axes_of(recording: Recording, kind: Kind) -> Axes | None:
    """How accelerometer or magnetometer lies to the gyroscope; None where the motion does not tell."""
    stream, gyr = recording.streams.get(kind), recording.gyr
    centred = None if stream is None else centred_stream(stream)
    if centred is None or gyr is None:
        return None
    try:
        found = relate(*centred, gyr.t, gyr.y - gyr_bias(gyr))
    except DataError:
        return None
    gains = np.linalg.svd(found.G, compute_uv=False)
    if found.explained < SURE or gains[0] > CONDITION * gains[2]:
        return None
    turn = _orthogonal(found.G)
    P = _nearest(turn)
    off = float(np.degrees(so3.angle_between(turn @ P.T, np.eye(3))))
    if not all(np.allclose(_nearest(_orthogonal(G)), P) for G in found.replicas):
        return None
    return Axes(found, P, off, turn)


def centred_stream(stream: Stream) -> tuple[Array, Array] | None:
    """Times and readings without bias, about one long; None where nothing tells the bias."""
    sphere = sphere_of(stream.y)
    factor = UNITS[stream.kind][stream.unit]
    if sphere is not None and sphere.rms < 0.25 * sphere.radius and sphere.radius_se < 0.1 * sphere.radius:
        size = sphere.radius * (factor or 0.0)
        if stream.kind != "acc" or factor is None or 0.8 < size / STANDARD_GRAVITY < 1.25:
            return stream.t, (stream.y - sphere.centre) / sphere.radius
    if stream.kind == "acc" and factor is not None:  # its bias is small beside gravity
        return stream.t, stream.y * (factor / STANDARD_GRAVITY)
    return None


def gyr_bias(gyr: Stream) -> Array:
    """Median reading over the quietest tenth of the blocks."""
    blocks = blocks_of(gyr)
    if len(blocks.mean) < 4:
        return np.zeros(3)
    scatter = blocks.scatter * np.linalg.norm(blocks.mean, axis=1)
    return np.median(blocks.mean[scatter <= np.quantile(scatter, 0.1)], axis=0)


def _orthogonal(G: Array) -> Array:
    U, _, Vt = np.linalg.svd(G)
    return U @ Vt


def _nearest(Q: Array) -> Array:
    return _SIGNED[int(np.argmax(np.einsum("kij,ij->k", _SIGNED, Q)))]


# --- findings ----------------------------------------------------------------------------------------


def inspect_axes(recordings: Sequence[Recording], place: Place | None, up: str | None) -> list[Finding]:
    """Axis order and handedness, sign, delay: of the recording that tells most."""
    acc, mag = (_best(recordings, kind) for kind in ("acc", "mag"))
    out = []
    if any(r.acc is not None and r.gyr is not None for r in recordings):
        out.append(_axes_finding("acc", acc, mag))
    if any(r.mag is not None and r.gyr is not None for r in recordings):
        out.append(_axes_finding("mag", mag, acc))
        out.append(_delay(mag))
    if any(r.acc is not None for r in recordings):
        out.append(_sign(recordings, acc, mag, place, up))
    return out


def _best(recordings: Sequence[Recording], kind: Kind) -> Axes | None:
    found = [a for a in (axes_of(r, kind) for r in recordings) if a is not None]
    return max(found, key=lambda a: a.relation.explained, default=None)


def _axes_finding(kind: Kind, axes: Axes | None, other: Axes | None) -> Finding:
    name = NAMES[kind]
    if axes is None:
        text = f"{name} and gyroscope: the motion does not tell how their axes lie to each other"
        todo = "turn the node slowly by 90 degrees or more about each of its three axes"
        return Finding("axes", "note", text, kind, todo=todo)
    if axes.mirrored:
        text, todo = _mirrored_words(kind, axes)
        return Finding("axes", "warn", text, kind, axes.off_deg, OFF_AXES_DEG, "deg", todo)
    if axes.off_deg > OFF_AXES_DEG:
        text = f"{name}: lies {axes.off_deg:.0f} degrees askew to the gyroscope's axes; calibration takes care of it"
        return Finding("axes", "note", text, kind, axes.off_deg, OFF_AXES_DEG, "deg")
    if axes.same:
        text = f"{name}: axes as the gyroscope's, right-handed, within {axes.off_deg:.0f} degrees"
        return Finding("axes", "pass", text, kind, axes.off_deg, OFF_AXES_DEG, "deg")
    return _turned(kind, axes, other)


def _turned(kind: Kind, axes: Axes, other: Axes | None) -> Finding:
    """A proper turn other than none; or one mirrored axis, which motion cannot tell from it."""
    text = f"{NAMES[kind]}: {_in_words(axes.P, kind)}"
    instead = -axes.P  # the same to all data: the vector sensor reversed as a whole
    if np.sum(instead < 0) < np.sum(axes.P < 0):
        text += f"; the same to these data would be a left-handed {NAMES[kind]}: {_in_words(instead, kind)}"
    if kind == "acc" or (other is not None and np.allclose(other.P, axes.P)):
        both = " Accelerometer and magnetometer agree: the gyroscope is the odd one." if other is not None else ""
        both = both if other is not None and np.allclose(other.P, axes.P) else ""
        todo = (
            "H takes care of it, but chips share their axes: check the driver for axes that are swapped or reversed."
            + both
        )
        return Finding("axes", "warn", text, kind, axes.off_deg, OFF_AXES_DEG, "deg", todo)
    todo = "H takes care of it; many boards mount the magnetometer so. --at (or --nominal) settles its sign"
    return Finding("axes", "note", text, kind, axes.off_deg, OFF_AXES_DEG, "deg", todo)


def _in_words(P: Array, kind: Kind) -> str:
    """``x is the gyroscope's -y`` for each axis that is not its namesake."""
    parts = []
    for i, axis in enumerate("xyz"):
        k = int(np.argmax(np.abs(P[i])))
        if k != i or P[i, k] < 0:
            parts.append(f"{axis} is {'-' if P[i, k] < 0 else ''}{'xyz'[k]}")
    return f"its {', '.join(parts)} of the gyroscope" if parts else "its axes are the gyroscope's"


def _mirrored_words(kind: Kind, axes: Axes) -> tuple[str, str]:
    flipped = [f"{'xyz'[k]}" for k in range(3) if axes.P[k, k] < 0]
    which = f", most likely {flipped[0]}" if len(flipped) == 1 and _is_diagonal(axes.P) else ""
    if len(flipped) == 3 and _is_diagonal(axes.P):
        which = ", all three axes reversed: it turns by the left hand"
    text = f"gyroscope: left-handed against the {NAMES[kind]}{which} ({_in_words(axes.P, kind)})"
    todo = "H takes care of it; check the wiring or the driver that flips an axis"
    return text, todo


def _is_diagonal(P: Array) -> bool:
    return bool(np.all(np.diag(P) != 0))


def _delay(axes: Axes | None) -> Finding:
    if axes is None:
        text = "magnetometer against gyroscope: the motion does not tell a delay"
        return Finding("delay", "note", text, "mag", None, 1e3 * DELAY_S, "ms")
    d, se = axes.relation.delay_s, axes.relation.delay_se_s
    text = f"magnetometer: {abs(1e3 * d):.1f} ms {'behind' if d >= 0 else 'ahead of'} the gyroscope"
    text += f", standard error {1e3 * se:.1f} ms"
    if abs(d) <= max(DELAY_S, 3 * se):
        return Finding("delay", "pass", text, "mag", 1e3 * d, 1e3 * DELAY_S, "ms")
    late = abs(d) > LATE_S
    todo = "rests do not feel it; a swing, and what uses both sensors in motion, does"
    if late:
        todo = "check that the two clocks share an origin"
    limit = LATE_S if late else DELAY_S
    return Finding("delay", "warn" if late else "note", text, "mag", 1e3 * d, 1e3 * limit, "ms", todo)


# --- sign --------------------------------------------------------------------------------------------


def _sign(
    recordings: Sequence[Recording], acc: Axes | None, mag: Axes | None, place: Place | None, up: str | None
) -> Finding:
    """Whether the accelerometer reads specific force (+g up) or gravity: seen only with something from outside."""
    first = _first_reading(recordings)
    if up is not None and first is not None:
        return _sign_by_side(first, up)
    by_field = None if place is None else _up_in_field(recordings, acc, mag)
    if by_field is not None and place is not None and abs(by_field) > CLEAR_DIP:
        dips = place.field.dip_deg > 0
        good = (by_field < 0) == dips
        text = "accelerometer and magnetometer agree with the dip of the field here"
        todo = ""
        if not good:
            text = "accelerometer and magnetometer contradict the dip of the field here: one of them is reversed"
            todo = (
                "either the accelerometer reads gravity instead of specific force (it must read + on the axis that "
                "points up), or the magnetometer is left-handed or reversed; --up AXIS tells which"
            )
        return Finding("sign", graded(good, "warn"), text, "acc", by_field, 0.0, "cos", todo)
    text = "accelerometer: its sign cannot be seen in these data alone"
    todo = "it must read + on the axis that points up; give --up AXIS or --at LAT,LON to have it checked"
    if first is not None:
        axis = _named(first)
        text += f"; in its first rest it reads {axis}, so that side must have been up"
    return Finding("sign", "note", text, "acc", todo=todo)


def _first_reading(recordings: Sequence[Recording]) -> Array | None:
    """Direction (3,) of the accelerometer in the quietest block of the first seconds."""
    stream = next((r.acc for r in recordings if r.acc is not None), None)
    centred = None if stream is None else centred_stream(stream)
    if stream is None or centred is None:
        return None
    v = centred[1][: max(8, round(2.0 * stream.rate))]
    mean = np.asarray(v.mean(axis=0))
    return mean if np.linalg.norm(mean) > 0.5 and np.linalg.norm(v.std(axis=0)) < 0.2 else None


def _named(v: Array) -> str:
    k = int(np.argmax(np.abs(v)))
    return f"{'+' if v[k] > 0 else '-'}{'xyz'[k]}"


def _sign_by_side(v: Array, up: str) -> Finding:
    want = np.eye(3)["xyz".index(up[-1])] * (-1.0 if up.startswith("-") else 1.0)
    cosine = float(v @ want / np.linalg.norm(v))
    if cosine > 0.7:
        text = f"accelerometer: reads + on the side that was up ({up}): specific force, as it must"
        return Finding("sign", "pass", text, "acc", cosine, 0.7, "cos")
    if cosine < -0.7:
        text = f"accelerometer: reads {_named(v)} while {up} was up: it reads gravity, not specific force"
        return Finding("sign", "fail", text, "acc", cosine, 0.7, "cos", "reverse the sign of all three columns")
    text = f"accelerometer: reads {_named(v)} while {up} was up"
    return Finding("sign", "warn", text, "acc", cosine, 0.7, "cos", "its axes are not those of the housing, or swapped")


def _up_in_field(recordings: Sequence[Recording], acc: Axes | None, mag: Axes | None) -> float | None:
    """Mean cosine between "up" and the field, both brought into the gyroscope's axes."""
    both = [r for r in recordings if r.acc is not None and r.mag is not None]
    if acc is None or mag is None or not both:
        return None
    a, m = centred_stream(both[0].streams["acc"]), centred_stream(both[0].streams["mag"])
    if a is None or m is None:
        return None
    f = np.column_stack([np.interp(m[0], a[0], a[1][:, k]) for k in range(3)])
    cosine = np.einsum("ni,ni->n", f @ acc.turn, m[1] @ mag.turn)
    cosine = cosine / np.maximum(np.linalg.norm(f, axis=1) * np.linalg.norm(m[1], axis=1), 1e-12)
    return float(np.mean(cosine))
