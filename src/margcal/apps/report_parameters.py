"""The parameters of a sensor in words that people know, with standard errors, and as H and B."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from margcal.apps.report_text import decimals_for, esc, fixed, matrix, number, per_unit, plus_minus, unit_words
from margcal.core.errors import InputError
from margcal.core.types import Array, SensorModel
from margcal.methods.sensor_model import Description, describe


@dataclass(frozen=True)
class Line:
    """A row of the table: what it is, what that means, and three figures with their standard errors."""

    name: str
    meaning: str
    columns: tuple[str, str, str]
    value: Array
    unit: str
    se: Array


def _flat(about: Description) -> Array:
    """Every figure of a description in one row."""
    rows = [about.bias, about.scale_factor, about.non_orthogonality_deg.values(), about.mounting_deg.values()]
    rows += [about.hard_iron or (0.0,) * 3, *(about.soft_iron or ((0.0,) * 3,) * 3)]
    return np.array([v for row in rows for v in row])


def standard_errors(model: SensorModel) -> Array | None:
    """Standard errors of `_flat`, by central differences through the covariance of (H, B); None without one.

    A figure that the covariance says nothing about (a bias that was held fixed) has NaN.
    """
    C = model.covariance
    if C is None or not np.isfinite(C).all():
        return None
    sd = np.sqrt(np.maximum(np.diag(C), 0.0))
    p = np.r_[model.H.ravel(), model.B]
    # small beside the standard errors and beside the values, large beside rounding
    step = np.maximum(np.minimum(1e-2 * sd, 1e-4 * np.abs(p).max(initial=1e-12)), 1e-7 * _sizes(model))
    J = np.empty((len(_flat(describe(model))), 12))
    for k in range(12):
        d = np.zeros(12)
        d[k] = step[k]
        J[:, k] = (_flat(describe(_at(model, p + d))) - _flat(describe(_at(model, p - d)))) / (2 * step[k])
    se = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", J, C, J), 0.0))
    return np.where(se > 0, se, np.nan)


def _sizes(model: SensorModel) -> Array:
    """The size of the twelve numbers: that of H, and of B in readings."""
    size = float(np.linalg.norm(model.H)) / math.sqrt(3)
    return np.r_[np.full(9, size), np.full(3, 1.0 / size)]


def _at(model: SensorModel, p: Array) -> SensorModel:
    return replace(model, H=p[:9].reshape(3, 3), B=p[9:], covariance=None)


def lines(model: SensorModel) -> list[Line]:
    """The rows of the table.

    Raises
    ------
    InputError
        If H is singular.
    """
    about = describe(model)
    flat = _flat(about)
    se = standard_errors(model)
    rows = flat.reshape(-1, 3)
    errors = np.full_like(rows, np.nan) if se is None else se.reshape(-1, 3)
    raw, unit, xyz = unit_words(model.raw_unit), unit_words(model.unit), ("x", "y", "z")
    scale_unit = f"{raw} per {per_unit(model.unit)}"
    magnetic = model.kind == "mag"
    bias = ("Hard iron and bias", "Offset of the readings: what they are centred on, in raw units")
    bias = bias if magnetic else ("Bias", "What the sensor reads when there is nothing to sense")
    out = [
        Line(*bias, xyz, rows[0], raw, errors[0]),
        Line(
            "Scale factor",
            "Raw units for one calibrated unit",
            xyz,
            rows[1],
            scale_unit,
            errors[1],
        ),
        Line(
            "Non-orthogonality",
            "How far two axes are from a right angle; positive where they lean together",
            ("x, y", "x, z", "y, z"),
            rows[2],
            "degrees",
            errors[2],
        ),
        Line("Mounting", _mounting_words(about, model), ("roll", "pitch", "yaw"), rows[3], "degrees", errors[3]),
    ]
    if magnetic:
        words = "The same offset as a field along the raw axes"
        out.insert(1, Line("Hard iron as a field", words, xyz, rows[4], unit, errors[4]))
        for k, axis in enumerate("xyz"):
            name = "Soft iron" if k == 0 else ""
            words = "How iron nearby bends the field, a matrix; " if k == 0 else ""
            out.append(Line(name, f"{words}row {axis}", xyz, rows[5 + k], "", errors[5 + k]))
    return out


def _mounting_words(about: Description, model: SensorModel) -> str:
    size = f"{fixed(about.mounting_angle_deg, 2)}°"
    if about.axes is None:
        return f"The triad is turned by {size} against the frame (yaw, then pitch, then roll)"
    if about.axes == ("+x", "+y", "+z"):
        return f"The triad is turned by {size} against the frame (yaw, then pitch, then roll)"
    named = ", ".join(f"{raw} along {axis.replace('-', '−')}" for raw, axis in zip("xyz", about.axes))
    return f"Axes swapped or flipped on the board: {named}; beyond that the triad is turned by {size}"


def parameter_table(model: SensorModel) -> str:
    """The table in words."""
    try:
        rows = lines(model)
    except (InputError, np.linalg.LinAlgError) as error:
        return f'<p class="note">Not told in words: {esc(error)}.</p>'
    return (
        f'<div class="scroll" tabindex="0" role="region" aria-label="parameters of the {model.kind}">'
        f'<table class="parameters" role="table"><tbody>{"".join(map(_row, rows))}</tbody></table></div>'
    )


def _row(line: Line) -> str:
    cells = "".join(
        f'<td role="cell"><span class="axis">{name}</span>{plus_minus(float(v), float(s))}</td>'
        for name, v, s in zip(line.columns, line.value, line.se)
    )
    about = f'<span class="meaning">{line.meaning}</span>' if line.meaning else ""
    unit = f'<td class="unit" role="cell">{line.unit}</td>'
    return f'<tr role="row"><th scope="row" role="rowheader">{line.name}{about}</th>{cells}{unit}</tr>'


def matrices(model: SensorModel) -> str:
    """H and B side by side."""
    unit, raw = unit_words(model.unit), unit_words(model.raw_unit)
    one = per_unit(model.raw_unit)
    return (
        '<div class="scroll" tabindex="0" role="region" aria-label="H and B"><div class="matrices">'
        f'<span class="group"><span class="symbol">H</span> = {matrix(model.H, "H")}'
        f'<span class="unit">{unit} per {one}</span></span>'
        f'<span class="group"><span class="symbol">B</span> = {matrix(model.B, "B")}'
        f'<span class="unit">{raw}</span></span></div></div>'
    )


def delay_text(model: SensorModel) -> str | None:
    """``25.6 ± 3.0 ms``, or None for a sensor without delay."""
    if not model.delay_s:
        return None
    delay, se = 1e3 * model.delay_s, 1e3 * (model.delay_se_s or 0.0)
    decimals = decimals_for(se)
    return f"{number(delay, 4)} ms" if decimals is None else f"{fixed(delay, decimals)} ± {fixed(se, decimals)} ms"
