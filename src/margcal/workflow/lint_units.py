"""Whether readings can be in the unit that they claim, and whether somebody calibrated them already.

What nature gives is the yardstick: at rest an accelerometer reads gravity, the gyroscope must turn gravity as
fast as the accelerometer sees it turn, and the sphere of a magnetometer has the earth's field for a radius. Raw
sensors are wide of it by bias (1 m/s^2 is normal), scale (10 %) and hard iron (several hundred uT); wrong units
are wide of it by 9.8, 57.3, 100 or more. Rows 3 to 6 of the list of bad inputs.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from margcal.core.types import Array, Issue, Kind, Recording, Stream
from margcal.core.units import STANDARD_GRAVITY, UNITS

NAMES = {"acc": "accelerometer", "gyr": "gyroscope", "mag": "magnetometer"}

BLOCK_S = 0.25
STILL = 0.02
"""Scatter over mean up to which a block of the accelerometer counts as quiet."""
QUIET_SHARE = 0.02
"""With fewer quiet blocks than this the quietest tenth stands for them, with twice the tolerance."""
GRAVITY_RATIO = 1.3
"""Norm at rest over gravity, either way, that a raw accelerometer may have (measured: 0.98 to 1.06)."""
GRAVITY_IMPOSSIBLE = 3.0
NO_GRAVITY = 0.05
COUNTS_ABOVE = 100.0
FASTEST_RMS = 35.0
"""Rms rate, rad/s, above which a gyroscope's readings are no rad/s (row 5)."""
TURN_DEG = 5.0
"""Turn of gravity within two blocks from which it is compared with the gyroscope."""
TURN_RATIO = 8.0
"""Gravity's turn over the gyroscope's, either way, that gives a wrong unit away (measured: 0.7 to 1.6)."""
FIELD_UT = (15.0, 100.0)
"""Radius of the sphere that is the field of the earth, indoors too (row 6 and what buildings add)."""
FIELD_IMPOSSIBLE_UT = (3.0, 1000.0)
LOCAL_FIELD = (0.4, 2.5)
SPHERE_RMS, SPHERE_SE = 0.25, 0.1
"""Misfit, and standard error of the radius, over the radius, up to which a sphere says anything."""
CALIBRATED_ACC = 0.03
"""Largest deviation of the norm at rest from gravity, m/s^2, of an accelerometer that was calibrated."""
CALIBRATED_MAG = 0.05
"""Centre over radius of a magnetometer's sphere that was calibrated."""


def lint_units(recording: Recording, without: Collection[Kind | None] = ()) -> list[Issue]:
    """Issues of what the readings must be.

    Parameters
    ----------
    recording : Recording
    without : collection of sensor kinds
        Sensors that are unusable anyway.

    Returns
    -------
    list of Issue
        ``acc-unit``, ``gyr-unit``, ``mag-unit`` (fail, sensor None, since numbers in an unknown unit are not
        understood; the text proposes ``--units``), ``acc-magnitude``, ``mag-magnitude`` (warn), ``no-gravity``
        (fail), ``looks-calibrated`` (note).
    """
    streams = {k: s for k, s in recording.streams.items() if k not in without}
    streams = {k: _finite(s) for k, s in streams.items()}
    streams = {k: s for k, s in streams.items() if len(s.t) >= 16 and np.isfinite(s.rate)}
    issues: list[Issue] = []
    if "acc" in streams:
        issues += _lint_acc(streams["acc"], recording.source)
    if "gyr" in streams:
        issues += _lint_gyr(streams["gyr"], streams.get("acc"), recording.source)
    if "mag" in streams:
        issues += _lint_mag(streams["mag"], recording.source)
    return issues


def _finite(stream: Stream) -> Stream:
    if np.isfinite(stream.y.sum()):
        return stream
    kept = np.isfinite(stream.y).all(axis=1)
    return Stream(stream.kind, stream.t[kept], stream.y[kept], stream.unit)


def _mismatch(kind: Kind, text: str, proposal: str | None, value: float, limit: float) -> Issue:
    if proposal is not None:
        text += f"; if so, give --units {kind}={proposal}, or name its columns {kind}_x_{proposal} and so on"
    return Issue(f"{kind}-unit", "fail", text, None, value, limit)


# --- accelerometer -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Blocks:
    """Means (K, 3) and scatter over mean (K,) of consecutive blocks of a stream, `size` samples each."""

    mean: Array
    scatter: Array
    size: int


def blocks_of(stream: Stream) -> Blocks:
    """Blocks of `BLOCK_S` (eight samples at least)."""
    size = max(8, round(BLOCK_S * stream.rate))
    n = len(stream.y) // size
    parts = np.ascontiguousarray(stream.y[: n * size].T).reshape(3, n, size)
    mean = parts.mean(axis=2)
    sd = np.sqrt(np.maximum(np.einsum("jki,jki->k", parts, parts) / size - np.einsum("jk,jk->k", mean, mean), 0))
    norm = np.maximum(np.linalg.norm(mean, axis=0), 1e-300)
    return Blocks(mean.T, sd / norm, size)


def _at_rest(blocks: Blocks) -> tuple[Array, bool]:
    """Means of the quiet blocks, and whether they are truly quiet."""
    quiet = blocks.scatter <= STILL
    if quiet.mean() >= QUIET_SHARE and quiet.sum() >= 3:
        return blocks.mean[quiet], True
    return blocks.mean[blocks.scatter <= np.quantile(blocks.scatter, 0.1)], False


def _lint_acc(stream: Stream, source: str) -> list[Issue]:
    """Rows 3 and 4: the norm at rest is gravity in the unit that is claimed."""
    factor = UNITS["acc"][stream.unit]
    blocks = blocks_of(stream)
    if factor is None or not len(blocks.mean):
        return []
    rest, quiet = _at_rest(blocks)
    norm = float(np.median(np.linalg.norm(rest, axis=1)))
    ratio = norm * factor / STANDARD_GRAVITY
    tolerance = GRAVITY_RATIO if quiet else 2 * GRAVITY_RATIO
    if 1 / tolerance <= ratio <= tolerance:
        return _looks_calibrated_acc(rest * factor, quiet, source)
    reads = f"{source}: accelerometer: |a| at rest is {norm:.4g} {stream.unit}"
    proposal = _fitting("acc", norm, STANDARD_GRAVITY, GRAVITY_RATIO)
    if proposal is not None:
        return [
            _mismatch("acc", f"{reads}, which is gravity in {proposal}, not in {stream.unit}", proposal, ratio, 1.0)
        ]
    if ratio < NO_GRAVITY:
        text = f"{reads}: gravity was taken out; record the raw acceleration, gravity is what calibrates it"
        return [Issue("no-gravity", "fail", text, "acc", ratio, NO_GRAVITY)]
    if norm > COUNTS_ABOVE or ratio > GRAVITY_IMPOSSIBLE or ratio < 1 / GRAVITY_IMPOSSIBLE:
        text = f"{reads}, {ratio:.3g} times gravity: these look like raw counts or another unit"
        return [_mismatch("acc", text, "count", ratio, tolerance)]
    text = (
        f"{reads}, {ratio:.2f} times gravity: more than bias and scale factors of a sensor give; check the range "
        "(full scale) that the readings were converted with"
    )
    return [Issue("acc-magnitude", "warn", text, "acc", ratio, tolerance)]


def _fitting(kind: Kind, size: float, expected: float, tolerance: float) -> str | None:
    """The unit in which `size` is `expected` (SI) within a factor of `tolerance`, the closest first."""
    off = {u: abs(np.log(size * f / expected)) for u, f in UNITS[kind].items() if f and size > 0}
    best = min(off, key=lambda u: off[u], default=None)
    return best if best is not None and off[best] <= np.log(tolerance) else None


def _looks_calibrated_acc(rest: Array, quiet: bool, source: str) -> list[Issue]:
    """Norms that agree with gravity in many directions: no raw sensor does that."""
    norm = np.linalg.norm(rest, axis=1)
    if not quiet or _directions(rest / norm[:, None]) < 5:
        return []
    off = float(np.quantile(np.abs(norm - STANDARD_GRAVITY), 0.9))
    if off > CALIBRATED_ACC:
        return []
    text = (
        f"{source}: accelerometer: |a| at rest is gravity within {off:.2g} m/s^2 in all directions; the readings look "
        "calibrated already"
    )
    return [Issue("looks-calibrated", "note", text, "acc", off, CALIBRATED_ACC)]


def _directions(unit: Array, apart_deg: float = 30.0) -> int:
    """How many of the directions (K, 3) are more than `apart_deg` from each other, taken in order."""
    left, found = unit, 0
    while len(left) and found < 12:
        found += 1
        left = left[left @ left[0] < np.cos(np.radians(apart_deg))]
    return found


# --- gyroscope ---------------------------------------------------------------------------------------


def _lint_gyr(stream: Stream, acc: Stream | None, source: str) -> list[Issue]:
    """Row 5: the rate itself, and gravity that turns against the gyroscope."""
    factor = UNITS["gyr"][stream.unit]
    if factor is None:
        return []
    units = [u for u, f in UNITS["gyr"].items() if f is not None]
    rms = float(np.sqrt(np.mean(np.einsum("ni,ni->n", stream.y, stream.y)))) * factor
    ratio = None if acc is None else turn_ratio(acc, stream)
    proposal = None
    if ratio is not None and not 1 / TURN_RATIO < ratio < TURN_RATIO:
        off = {u: abs(np.log(ratio * factor / (UNITS["gyr"][u] or 1.0))) for u in units}
        proposal = min(off, key=lambda u: off[u])
        if off[proposal] < np.log(4.0) and proposal != stream.unit:
            text = (
                f"{source}: gyroscope: gravity turns {ratio:.3g} times as fast as the readings say in {stream.unit}; "
                f"they look like {proposal}"
            )
            return [_mismatch("gyr", text, proposal, ratio, TURN_RATIO)]
    if rms <= FASTEST_RMS:
        return []
    smaller = {"radps": "dps", "dps": "mdps"}.get(stream.unit, "count")
    text = (
        f"{source}: gyroscope: the rms rate is {rms:.3g} rad/s as {stream.unit}, no hand turns that fast; they look "
        f"like {smaller} or counts"
    )
    return [_mismatch("gyr", text, smaller, rms, FASTEST_RMS)]


def turn_ratio(acc: Stream, gyr: Stream) -> float | None:
    """How fast the accelerometer sees gravity turn, over how fast the gyroscope (as SI) says it turns.

    Compared where the accelerometer's mean turns by more than `TURN_DEG` from block to block at nearly constant
    norm, so turns about the vertical, which gravity cannot show, do not count. None where that is hardly ever.
    The gyroscope's bias goes out with its median over the quietest blocks. Axes that are swapped or mirrored
    between the two blur the ratio, by less than two.
    """
    factor = UNITS["gyr"][gyr.unit] or 1.0
    blocks = blocks_of(acc)
    if len(blocks.mean) < 4:
        return None
    norm = np.linalg.norm(blocks.mean, axis=1)
    unit = blocks.mean / np.maximum(norm, 1e-300)[:, None]
    usual = float(np.median(norm))
    turned = 2 * np.arcsin(np.minimum(np.linalg.norm(unit[1:] - unit[:-1], axis=1) / 2, 1.0))
    level = np.abs(norm - usual) < 0.15 * usual
    steady = level[1:] & level[:-1]
    steady &= (turned > np.radians(TURN_DEG)) & (turned < np.radians(90))
    if not steady.any():
        return None
    centre = acc.t[np.arange(len(norm)) * blocks.size + blocks.size // 2]
    # integral of the gyroscope from the centre of one block to that of the next
    total = np.zeros((3, len(gyr.t)))
    np.cumsum(
        (np.ascontiguousarray(gyr.y.T) - _gyr_bias(gyr)[:, None])[:, :-1] * np.diff(gyr.t), axis=1, out=total[:, 1:]
    )
    at = np.clip(np.searchsorted(gyr.t, centre), 0, len(gyr.t) - 1)
    angle = (total[:, at[1:]] - total[:, at[:-1]]).T * factor
    middle = unit[1:] + unit[:-1]
    middle /= np.maximum(np.linalg.norm(middle, axis=1, keepdims=True), 1e-300)
    across = angle - np.einsum("ki,ki->k", angle, middle)[:, None] * middle
    inside = steady & (centre[:-1] >= gyr.t[0]) & (centre[1:] <= gyr.t[-1])
    if turned[inside].sum() < np.radians(60):
        return None
    by_gyr = float(np.linalg.norm(across[inside], axis=1).sum())
    return float(turned[inside].sum()) / max(by_gyr, 1e-12)


def _gyr_bias(gyr: Stream) -> Array:
    blocks = blocks_of(gyr)
    if len(blocks.mean) < 4:
        return np.zeros(3)
    scatter = blocks.scatter * np.linalg.norm(blocks.mean, axis=1)
    return np.median(blocks.mean[scatter <= np.quantile(scatter, 0.1)], axis=0)


# --- magnetometer ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sphere:
    """A sphere through readings: centre (3,), radius, rms misfit and standard error of the radius."""

    centre: Array
    radius: float
    rms: float
    radius_se: float


def sphere_of(y: Array) -> Sphere | None:
    """Sphere through readings (N, 3) by linear least squares, or None where they do not span one.

    |y|^2 = 2 c y + (r^2 - c c) is linear in the centre c and the constant. The standard error takes one
    sample in ten as independent: what deviates from a sphere (soft iron, disturbance) changes slowly.
    """
    y = y[:: max(1, len(y) // 2000)]
    origin = y.mean(axis=0)
    scale = float(np.sqrt(np.mean(np.sum((y - origin) ** 2, axis=1))))
    if len(y) < 16 or not scale > 0:
        return None
    z = (y - origin) / scale
    A = np.column_stack([2 * z, np.ones(len(z))])
    normal = A.T @ A
    if np.linalg.cond(normal) > 1e10:
        return None
    b = np.einsum("ni,ni->n", z, z)
    x = np.linalg.solve(normal, A.T @ b)
    square = x[3] + x[:3] @ x[:3]
    if not square > 0:
        return None
    radius = float(np.sqrt(square))
    misfit = np.linalg.norm(z - x[:3], axis=1) - radius
    rms = float(np.sqrt(np.mean(misfit**2)))
    # d r = (d x4 + 2 c d c) / 2 r, and d x has covariance (2 r rms)^2 normal^-1
    gradient = np.append(2 * x[:3], 1.0) / (2 * radius)
    variance = gradient @ np.linalg.solve(normal, gradient) * (2 * radius * rms) ** 2
    return Sphere(origin + scale * x[:3], scale * radius, scale * rms, scale * float(np.sqrt(10 * variance)))


def _lint_mag(stream: Stream, source: str) -> list[Issue]:
    """Row 6: the radius of the sphere is the field; without a sphere only readings beyond any field are told."""
    if stream.unit == "count":
        return []
    factor = UNITS["mag"][stream.unit]
    sphere = sphere_of(stream.y)
    if sphere is None or sphere.rms > SPHERE_RMS * sphere.radius or sphere.radius_se > SPHERE_SE * sphere.radius:
        return _lint_mag_size(stream, factor, source)
    reads = f"{source}: magnetometer: the readings lie on a sphere of radius {sphere.radius:.4g} {stream.unit}"
    low, high = FIELD_UT if factor is not None else LOCAL_FIELD
    size = sphere.radius * (factor or 1.0)
    if low <= size <= high:
        return _looks_calibrated_mag(sphere, source)
    proposal = _field_unit(sphere.radius, stream.unit)
    if proposal is not None:
        text = f"{reads}; the earth's field is 22 to 67 uT, so they look like {proposal}"
        return [_mismatch("mag", text, proposal, size, high if size > high else low)]
    if factor is not None and FIELD_IMPOSSIBLE_UT[0] < size < FIELD_IMPOSSIBLE_UT[1]:
        text = f"{reads}; the earth's field is 22 to 67 uT: a magnet is near, or they are in another unit"
        return [Issue("mag-magnitude", "warn", text, "mag", size, high if size > high else low)]
    text = f"{reads}, which is no field of the earth: these look like raw counts"
    return [_mismatch("mag", text, "count", size, high if size > high else low)]


def _field_unit(radius: float, claimed: str) -> str | None:
    """The unit in which a radius is the earth's field (22 to 67 uT), or the local one."""
    for unit, factor in UNITS["mag"].items():
        if unit != claimed and factor is not None and 20.0 <= radius * factor <= 70.0:
            return unit
    return "norm" if claimed != "norm" and 0.8 <= radius <= 1.25 else None


def _lint_mag_size(stream: Stream, factor: float | None, source: str) -> list[Issue]:
    """No sphere: hard iron may hide the field, but it does not shrink all readings to next to nothing."""
    largest = float(np.quantile(np.linalg.norm(stream.y, axis=1), 0.99))
    size = largest * (factor or 50.0)
    if FIELD_IMPOSSIBLE_UT[0] <= size <= 100 * FIELD_IMPOSSIBLE_UT[1]:
        return []
    units = {u: f for u, f in UNITS["mag"].items() if u != stream.unit and f is not None}
    proposal = next((u for u, f in units.items() if 15.0 <= largest * f <= 200.0), "count")
    text = (
        f"{source}: magnetometer: |m| is {largest:.3g} {stream.unit} throughout, which no sensor on the earth reads; "
        f"they look like {proposal}"
    )
    return [_mismatch("mag", text, proposal, size, FIELD_IMPOSSIBLE_UT[0])]


def _looks_calibrated_mag(sphere: Sphere, source: str) -> list[Issue]:
    off = float(np.linalg.norm(sphere.centre)) / sphere.radius
    if off > CALIBRATED_MAG or sphere.rms > CALIBRATED_MAG * sphere.radius:
        return []
    text = (
        f"{source}: magnetometer: its sphere is centred within {100 * off:.2g} % of the radius; the readings look "
        "calibrated already"
    )
    return [Issue("looks-calibrated", "note", text, "mag", off, CALIBRATED_MAG)]
