"""Betaflight: lines for its command line.

Form        y - zero, in counts of its driver
Fields      set acc_calibration = x,y,z,1; set mag_calibration = x,y,z
Ranges      16-bit integers
Carries     bias only, of accelerometer and magnetometer. The scale is the driver's nominal one, the axes are those of
            align_...; the gyroscope's bias is measured at every start
Units       raw counts

From       betaflight, sensors/acceleration.c (applyAccelerationTrims), and `diff` listings of users.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import InputError
from margcal.core.types import Array
from margcal.core.units import Kind
from margcal.files.exchange import texts
from margcal.files.exchange.target import Fields, Form, Page, Range, Sensor, Target


def _encode_zero(H: Array, B: Array, R: Array) -> Fields:
    return {"zero": np.rint(B)}


def _decode_zero(fields: Fields) -> tuple[Array, Array]:
    return np.eye(3), fields["zero"]


def _apply_zero(fields: Fields, y: ArrayLike) -> Array:
    return np.asarray(y) - fields["zero"]


_ZERO = Form(
    "y - zero",
    _encode_zero,
    _decode_zero,
    _apply_zero,
    matrix="unit",
    raw=("count",),
    unit="count",
    nominal=True,
    ranges=(Range("zero", -32768, 32767, "counts", shown="acc_calibration, mag_calibration"),),
)
FORMS: dict[Kind, Form] = {"acc": _ZERO, "mag": _ZERO}


def _write_betaflight(page: Page) -> bytes:
    out = texts.comment([*texts.heading(page), *texts.vector_lines(page)], "#")
    for kind, sensor in page.sensors.items():
        cells = [str(int(v)) for v in sensor.fields["zero"]] + (["1"] if kind == "acc" else [])
        out += f"set {kind}_calibration = {','.join(cells)}\n"
    return (out + "save\n").encode()


def _read_betaflight(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    text = texts.decode(data, name)
    vectors, found = texts.vectors_in(text), {}
    for kind in FORMS:
        hits = re.findall(
            rf"^[ \t]{{0,20}}set {kind}_calibration {{0,9}}= {{0,9}}([-\d, ]{{5,60}})\r?$", text, re.MULTILINE
        )
        if hits:
            values = [float(v) for v in hits[-1].split(",") if v.strip().lstrip("-").isdigit()][:3]
            fields = {"zero": texts.array(values, (3,), f"{kind}_calibration", name)}
            found[kind] = Sensor(fields, "count", "count", vectors.get(kind))
    if not found:
        raise InputError(f"{name}: holds no 'set acc_calibration' and no 'set mag_calibration'")
    return Page(found, *texts.about(text))


BETAFLIGHT = Target(
    "betaflight",
    "Betaflight CLI",
    ".txt",
    FORMS,
    _write_betaflight,
    _read_betaflight,
    1e-2,
    "Betaflight, sensors/acceleration.c",
    remark="bias only, in whole counts; scale is the sensor's nominal one, axes those of align_...",
)
