"""A calibration for other programs: their units, what they cannot hold and what that costs, their file.

The cost is a direction error: the angle, over all directions, between the vector that the file's numbers give and the
vector that the calibration gives. It is computed from the fields as they are written, rounding and all.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from margcal.core.errors import DataError, UsageError
from margcal.core.types import Array, Calibration, Issue
from margcal.core.units import KINDS, UNITS, Kind
from margcal.files.exchange.fitting import ORIENTATIONS, lower_frame, nearest, orientation_of
from margcal.files.exchange.registry import find
from margcal.files.exchange.target import Form, Matrix, Page, Sensor, Target
from margcal.methods.uncertainty import direction_errors_deg, sphere
from margcal.workflow.export_units import Converted, converted, field_strength

MAX_LOSS_DEG = 0.5
"""Largest direction error, rms, that an export may cost without being told to."""

FIELD_UT = (1.0, 1000.0)
"""Strengths of the field that are taken, uT."""

FOREIGN_SCALE = 3.0
"""A data sheet is off by a few percent, a unit by 9.8, 57.3 or 100."""

NOTHING_DEG = 1e-9
"""Below this an angle is a rounding error of float64."""

KEPT: Mapping[Matrix, str] = {
    "full": "all of H",
    "lower": "lower triangle",
    "symmetric": "symmetric part",
    "diagonal": "a scale an axis",
    "scalar": "one scale",
    "unit": "nothing of H",
}


@dataclass(frozen=True)
class Loss:
    """What one sensor's place in a file keeps, and what the rest costs.

    `rms_deg`, `max_deg`: direction error over the sphere. `length_percent`: rms error of the vector's length, None
    where the target multiplies by a nominal sensitivity that only it knows. `bias`: whether B is in the file.
    `orientation`: number of the board orientation taken, None where the target has none. `without_bias_deg`: rms
    direction error if a bias that is not in the file is forgotten. `step`, `step_deg`: the step in which results come
    (fixed point), calibrated unit, and the direction error of rounding to it; not part of `rms_deg`.
    """

    kind: Kind
    kept: Matrix
    bias: bool
    rms_deg: float
    max_deg: float
    length_percent: float | None
    orientation: int | None = None
    without_bias_deg: float | None = None
    step: float | None = None
    step_deg: float | None = None


@dataclass(frozen=True)
class Export:
    """A file for another program and the account of it."""

    target: Target
    data: bytes
    page: Page
    models: Mapping[Kind, Converted]
    losses: tuple[Loss, ...]
    left_out: tuple[Kind, ...] = ()
    warnings: tuple[str, ...] = ()
    frame_turn_deg: float | None = None


def export(
    calibration: Calibration,
    target: Target | str,
    *,
    sensors: Collection[Kind] | None = None,
    scale: Mapping[str, float] | None = None,
    field_uT: float | None = None,
    max_loss_deg: float = MAX_LOSS_DEG,
    allow_lossy: bool = False,
    move_frame: bool = False,
) -> Export:
    """The file of `target` for `calibration`.

    Parameters
    ----------
    target : Target or str
        A name in `files.exchange.registry.TARGETS`, such as ``'c'`` or ``'imucal'``.
    sensors : kinds, optional
        Only these; without it, all that the target has a place for.
    scale : mapping of kind to float, optional
        SI units (magnetometer: uT) a count, by which the target's driver multiplies raw counts before it calibrates.
    field_uT : float, optional
        Strength of the field, for a magnetometer that is calibrated in `norm`.
    max_loss_deg : float
        Refuse above this direction error (rms, any sensor), unless `allow_lossy`.
    move_frame : bool
        Turn the file's frame so that the accelerometer's H fits (Kalibr, basalt).

    Raises
    ------
    DataError
        The loss is too large, a value is out of the target's range, or a sensor cannot be expressed in its units.
    UsageError
        Options that do not fit the target.
    """
    target = find(target) if isinstance(target, str) else target
    _refuse_odd_limits(max_loss_deg, field_uT)
    kinds, left_out = _chosen(calibration, target, sensors)
    _refuse_foreign_scale(
        calibration, [k for k in kinds if "count" not in (target.forms[k].raw or ("count",))], scale, field_uT
    )
    models: dict[Kind, Converted] = {
        k: converted(calibration, k, target.forms[k], target.name, scale, field_uT) for k in kinds
    }
    _refuse_idle_options(target, models, scale, move_frame)
    R_ih = _moved_frame(models, target) if move_frame else None
    losses: list[Loss] = []
    page_sensors: dict[Kind, Sensor] = {}
    warnings: list[str] = []
    if calibration.verdict == "fail":
        warnings.append("the verdict of this calibration is fail; its numbers are not to be trusted")
    for kind, (fitted, R) in _fitted(models, target, R_ih).items():
        form, model = target.forms[kind], models[kind]
        fields = form.encode(fitted, model.B if form.bias else np.zeros(3), R)
        page_sensors[kind] = Sensor(fields, model.raw_unit, model.unit, _vectors(form, fields, model))
        losses.append(_loss(kind, form, fields, model, R))
        warnings += _out_of_range(kind, form, fields, allow_lossy)
    turn = None if R_ih is None else math.degrees(math.acos(min(1.0, max(-1.0, (np.trace(R_ih) - 1) / 2))))
    _refuse_losses(losses, target, max_loss_deg, allow_lossy)
    page = Page(
        page_sensors,
        calibration.device,
        calibration.frame if R_ih is None else f"{calibration.frame}, turned by {turn:.4g} deg",
        (*_remarks(losses, models, target, turn), *warnings),
        field_strength(calibration, field_uT),
    )
    return Export(target, target.write(page), page, models, tuple(losses), left_out, tuple(warnings), turn)


def _chosen(
    calibration: Calibration, target: Target, sensors: Collection[Kind] | None
) -> tuple[tuple[Kind, ...], tuple[Kind, ...]]:
    """The sensors that go into the file, and those of the calibration that have no place in it."""
    have = calibration.models
    for kind in sensors or ():
        if kind not in have:
            raise DataError(f"{kind} is not in the calibration, which holds {', '.join(have) or 'no sensor'}")
        if kind not in target.forms:
            raise DataError(f"{target.name} has no place for {kind}; it carries {', '.join(target.forms)}")
    wanted: tuple[Kind, ...] = tuple(k for k in KINDS if k in have and (not sensors or k in sensors))
    kinds: tuple[Kind, ...] = tuple(k for k in wanted if k in target.forms)
    if not kinds:
        raise DataError(
            f"{target.name} carries {', '.join(target.forms)}; the calibration holds {', '.join(have) or 'no sensor'}"
        )
    if target.single and len(kinds) > 1:
        if sensors or "mag" not in kinds:
            raise UsageError(f"a {target.name} file holds one sensor; give --sensors {' or '.join(kinds)}")
        kinds = ("mag",)
    if missing := [k for k in target.required if k not in kinds]:
        raise DataError(f"{target.name} needs {' and '.join(target.required)}; {missing[0]} is not there")
    return kinds, tuple(k for k in wanted if k not in kinds)


def _refuse_odd_limits(max_loss_deg: float, field_uT: float | None) -> None:
    """NaN is no limit: nothing would be above it."""
    if not max_loss_deg >= 0:
        raise UsageError(f"--max-loss is {max_loss_deg:g}; give degrees, 0 or more")
    if field_uT is not None and not FIELD_UT[0] <= field_uT <= FIELD_UT[1]:
        raise UsageError(
            f"--field is {field_uT:g} uT; on the earth it lies between {FIELD_UT[0]:g} and {FIELD_UT[1]:g}"
        )


def _refuse_foreign_scale(
    calibration: Calibration,
    kinds: Collection[Kind],
    scale: Mapping[str, float] | None,
    field_uT: float | None,
) -> None:
    """A scale that is far from what was calibrated was given in another unit: g for m/s^2, degrees for rad/s."""
    for kind in kinds:
        told, own = (scale or {}).get(kind), calibration.models[kind]
        field = field_strength(calibration, field_uT) if own.unit == "norm" else 1.0
        if told is None or field is None or UNITS[kind].get(own.raw_unit) is not None:
            continue
        measured = float(np.cbrt(abs(np.linalg.det(own.H)))) * field
        if not 1 / FOREIGN_SCALE <= told / measured <= FOREIGN_SCALE:
            unit = "uT" if kind == "mag" else own.unit
            raise UsageError(
                f"--scale {kind}={told:g} is {told / measured:.3g} times what was calibrated, {measured:.4g} {unit} a "
                f"{own.raw_unit}; give it in {unit} a {own.raw_unit}"
            )


def _refuse_idle_options(
    target: Target, models: Mapping[Kind, Converted], scale: Mapping[str, float] | None, move_frame: bool
) -> None:
    """An option that would change nothing is a misunderstanding."""
    for kind in scale or ():
        if kind not in KINDS:
            raise UsageError(f"--scale {kind!r} is no sensor; acc, gyr and mag are")
        if kind in models and target.forms[kind].raw in ((), ("count",)):
            what = "raw counts" if target.forms[kind].raw else "readings in any unit"
            raise UsageError(f"--scale {kind}: {target.name} takes {what}; leave it out")
    if move_frame and not any(f.movable for f in target.forms.values()):
        raise UsageError(f"--move-frame is for kalibr and basalt; {target.name} has no frame that could be turned")


# --- what is kept -------------------------------------------------------------------------------------


def _moved_frame(models: Mapping[Kind, Converted], target: Target) -> Array:
    """R_ih for ``--move-frame``: the accelerometer's H becomes lower triangular in i."""
    if "acc" not in models:
        raise UsageError("--move-frame fits the frame to the accelerometer, which is not in the calibration")
    return lower_frame(models["acc"].H)


def _fitted(models: Mapping[Kind, Converted], target: Target, R_ih: Array | None) -> dict[Kind, tuple[Array, Array]]:
    """The nearest H that each place can hold, and the rotation that the file holds beside it."""
    found: dict[Kind, tuple[Array, Array]] = {}
    boards: dict[str, Array] = {}
    for kind, model in models.items():
        form = target.forms[kind]
        if form.board:
            before = form.board == "before"
            R = boards.setdefault(form.group, ORIENTATIONS[orientation_of(model.H, before=before)])
            found[kind] = nearest(model.H, form.matrix, R, before=before), R
        elif R_ih is not None:
            found[kind] = model.H, R_ih
        else:
            found[kind] = nearest(model.H, form.matrix), np.eye(3)
    return found


def _loss(kind: Kind, form: Form, fields: Mapping[str, object], model: Converted, R: Array) -> Loss:
    """The loss of the fields as they stand in the file."""
    H, B = form.decode(fields)
    B = B if form.bias else model.B
    magnitude = None if kind == "gyr" else model.magnitude
    angle = direction_errors_deg(H, B, model.H, model.B, magnitude)
    size = 1.0 if magnitude is None else magnitude
    z = size * sphere() @ np.linalg.inv(model.H).T + (0.0 if magnitude is None else model.B - B)
    length = np.linalg.norm(z @ H.T, axis=1) / size - 1
    orientation = fields.get("orientation")
    return Loss(
        kind,
        form.matrix if ("C_i_b" not in fields and "R_ih" not in fields) or np.array_equal(R, np.eye(3)) else "full",
        form.bias,
        float(np.sqrt(np.mean(angle**2))),
        float(angle.max()),
        None if form.nominal else 100 * float(np.sqrt(np.mean(length**2))),
        orientation if isinstance(orientation, int) else None,
        None if form.bias or magnitude is None else _forgotten_bias(model),
        *_step(form, fields, magnitude),
    )


def _step(form: Form, fields: Mapping[str, object], magnitude: float | None) -> tuple[float | None, float | None]:
    """The step of the results, and the angle by which rounding to it turns a vector: two components of step^2 / 12."""
    if form.step is None:
        return None, None
    step = form.step(fields)
    return step, None if magnitude is None else math.degrees(step / magnitude / math.sqrt(6))


def _forgotten_bias(model: Converted) -> float:
    angle = direction_errors_deg(model.H, np.zeros(3), model.H, model.B, model.magnitude)
    return float(np.sqrt(np.mean(angle**2)))


def step_words(loss: Loss, unit: str) -> str:
    cost = "" if loss.step_deg is None else f", which turns a vector of the usual length by {loss.step_deg:.2g} deg rms"
    return f"{loss.kind}: results come in steps of {loss.step:.6g} {unit}{cost}"


def bias_words(loss: Loss, model: Converted) -> str:
    """What to do about a bias that has no place in the file."""
    B = ", ".join(f"{v:.9g}" for v in model.B)
    cost = "" if loss.without_bias_deg is None else f" (forgotten, it costs {loss.without_bias_deg:.3g} deg rms)"
    return f"{loss.kind}: the bias is not in this file; subtract it first or have it estimated{cost}: B = [{B}]"


def _out_of_range(kind: Kind, form: Form, fields: Mapping[str, object], allow: bool) -> list[str]:
    """Values outside the target's ranges, in words; refused where the target would refuse or clip them."""
    found = []
    for limits in form.ranges:
        values = np.ravel(np.asarray(fields[limits.name], dtype=np.float64))
        worst = float(values[np.argmax(np.maximum(limits.low - values, values - limits.high))])
        if limits.low <= worst <= limits.high:
            continue
        unit = f" {limits.unit}" if limits.unit else ""
        text = f"{kind}: {limits.shown or limits.name} is {worst:.5g}{unit}, outside {limits.low:g} to {limits.high:g}"
        if limits.hard and not allow:
            issue = Issue("out-of-range", "fail", text, kind, worst, limits.high if worst > 0 else limits.low)
            raise DataError(
                f"{text}, which the target does not take; leave {kind} out with --sensors, or give --allow-lossy",
                [issue],
            )
        found.append(text)
    return found


def _refuse_losses(losses: list[Loss], target: Target, limit: float, allow: bool) -> None:
    too_much = [x for x in losses if math.hypot(x.rms_deg, x.step_deg or 0.0) > limit]
    if not too_much or allow:
        return
    issues = [
        Issue(
            "export-loss",
            "fail",
            f"{x.kind}: {target.name} keeps {KEPT[x.kept]}; direction error {angle(x.rms_deg)} rms, "
            f"{angle(x.max_deg)} at worst" + (f", and {x.step_deg:.2g} deg from rounding" if x.step_deg else ""),
            x.kind,
            x.rms_deg,
            limit,
        )
        for x in too_much
    ]
    mend = "--move-frame keeps all of it; " if any(target.forms[x.kind].movable for x in too_much) else ""
    rest = [x.kind for x in losses if x not in too_much]
    without = f"--sensors {','.join(rest)} leaves it out; " if rest else ""
    raise DataError(
        f"{'; '.join(i.text for i in issues)}; more than {limit:g} deg: {mend}{without}"
        "--allow-lossy writes it as it is",
        issues,
    )


def angle(deg: float) -> str:
    """`deg` in words for people: rounding errors of float64 are nothing."""
    return f"{deg:.3g} deg" if deg > NOTHING_DEG else "0 deg"


def percent(value: float) -> str:
    return f"{value:.2g} %" if value > NOTHING_DEG else "0 %"


def _vectors(form: Form, fields: Mapping[str, object], model: Converted) -> tuple[Array, Array]:
    """Ten raw readings, six along the axes and four between, and what the target makes of them."""
    between = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / math.sqrt(3)
    u = model.magnitude * np.vstack([np.eye(3), -np.eye(3), between])
    y = u @ np.linalg.inv(model.H).T + (model.B if form.bias else 0.0)
    whole = model.raw_unit == "count"
    y = np.rint(y) if whole else np.array([[float(f"{v:.6g}") for v in row] for row in y])
    return y, form.apply(fields, y)


def _remarks(losses: list[Loss], models: Mapping[Kind, Converted], target: Target, turn: float | None) -> list[str]:
    """What the file itself says of how it is meant and what it leaves out."""
    out = []
    for x in losses:
        out.append(f"{x.kind}: {target.forms[x.kind].formula}")
        length = "" if x.length_percent is None else f", length error {x.length_percent:.2g} percent rms"
        error = f"direction error {angle(x.rms_deg)} rms, {angle(x.max_deg)} at worst{length}"
        out.append(f"{x.kind}: keeps {KEPT[x.kept]}; {error if x.rms_deg > NOTHING_DEG else 'nothing is lost'}")
        if x.step is not None:
            out.append(step_words(x, models[x.kind].unit))
        if x.orientation is not None:
            out.append(f"{x.kind}: board orientation {x.orientation}")
        if not x.bias:
            out.append(bias_words(x, models[x.kind]))
    if turn is not None:
        out.append(f"the frame of this file is the node's turned by {turn:.4g} deg")
    return out
