"""x-io Fusion (C) and imufusion (Python): inertial and magnetic calibration.

Form        inertial: M diag(s) (y - o); magnetic: W (y - h)   (Fusion 1.2 and later; before it was W y - h)
Fields      misalignment M, sensitivity s, offset o; soft_iron_matrix W, hard_iron_offset h
Carries     all of H and B, in float32; s are the lengths of H's columns, so that M is close to a rotation
Units       accelerometer in g, gyroscope in deg/s (what FusionAhrs takes); magnetometer any

From       x-io Technologies, Fusion/FusionCalibration.h; checked against imufusion 1.3 (`model_inertial`,
           `model_magnetic`), which the tests run.
"""

from __future__ import annotations

import math
import re

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import InputError
from margcal.core.types import Array
from margcal.core.units import Kind
from margcal.files.exchange import texts
from margcal.files.exchange.c_code import block_comment, literal
from margcal.files.exchange.target import Fields, Form, Page, Target, single_precision

FACTS = "x-io Fusion, FusionCalibration.h; imufusion 1.3 itself"


def _encode_inertial(H: Array, B: Array, R: Array) -> Fields:
    s = single_precision(np.linalg.norm(H, axis=0))
    return {"misalignment": single_precision(H / s), "sensitivity": s, "offset": single_precision(B)}


def _decode_inertial(fields: Fields) -> tuple[Array, Array]:
    return fields["misalignment"] * fields["sensitivity"], fields["offset"]


def _apply_inertial(fields: Fields, y: ArrayLike) -> Array:
    return ((np.asarray(y) - fields["offset"]) * fields["sensitivity"]) @ fields["misalignment"].T


def _encode_magnetic(H: Array, B: Array, R: Array) -> Fields:
    return {"soft_iron_matrix": single_precision(H), "hard_iron_offset": single_precision(B)}


def _decode_magnetic(fields: Fields) -> tuple[Array, Array]:
    return fields["soft_iron_matrix"], fields["hard_iron_offset"]


def _apply_magnetic(fields: Fields, y: ArrayLike) -> Array:
    return (np.asarray(y) - fields["hard_iron_offset"]) @ fields["soft_iron_matrix"].T


def _inertial(unit: str) -> Form:
    return Form("M diag(s) (y - o)", _encode_inertial, _decode_inertial, _apply_inertial, unit=unit)


FORMS: dict[Kind, Form] = {
    "acc": _inertial("g"),
    "gyr": _inertial("dps"),
    "mag": Form("W (y - h)", _encode_magnetic, _decode_magnetic, _apply_magnetic),
}
_SHAPES = {
    "acc": {"misalignment": (3, 3), "sensitivity": (3,), "offset": (3,)},
    "gyr": {"misalignment": (3, 3), "sensitivity": (3,), "offset": (3,)},
    "mag": {"soft_iron_matrix": (3, 3), "hard_iron_offset": (3,)},
}
_C_NAMES = {
    ("acc", "misalignment"): "accelerometerMisalignment",
    ("acc", "sensitivity"): "accelerometerSensitivity",
    ("acc", "offset"): "accelerometerOffset",
    ("gyr", "misalignment"): "gyroscopeMisalignment",
    ("gyr", "sensitivity"): "gyroscopeSensitivity",
    ("gyr", "offset"): "gyroscopeOffset",
    ("mag", "soft_iron_matrix"): "softIronMatrix",
    ("mag", "hard_iron_offset"): "hardIronOffset",
}


def _write_c(page: Page) -> bytes:
    lines = [
        *texts.heading(page),
        "FusionCalibrationInertial(accelerometer, accelerometerMisalignment, accelerometerSensitivity,",
        "  accelerometerOffset); the same for the gyroscope;",
        "FusionCalibrationMagnetic(magnetometer, softIronMatrix, hardIronOffset)",
    ]
    out = block_comment([*lines, *texts.vector_lines(page)])
    for kind, sensor in page.sensors.items():
        out += "\n"
        for key, value in sensor.fields.items():
            rows = [", ".join(literal(v) for v in row) for row in np.atleast_2d(value)]
            inner = "{" + "}, {".join(rows) + "}"
            kind_of = "FusionMatrix" if np.ndim(value) == 2 else "FusionVector"
            body = f"{{{inner}}}" if kind_of == "FusionMatrix" else inner
            out += f"static const {kind_of} {_C_NAMES[kind, key]} = {{{body}}};\n"
    return out.encode()


def _read_c(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    text = texts.decode(data, name)
    code = re.sub(r"/\*.*?\*/|//[^\n]*", "", text, flags=re.DOTALL)
    found: dict[Kind, Fields] = {}
    for kind in FORMS:
        names = {key: _C_NAMES[kind, key] for key in _SHAPES[kind]}
        if not any(re.search(rf"\b{n}\s*=", code) for n in names.values()):
            continue
        found[kind] = {
            key: single_precision(texts.numbers_after(code, rf"\b{n}\s*=", math.prod(shape), n, name)).reshape(shape)
            for (key, n), shape in zip(names.items(), _SHAPES[kind].values())
        }
    if not found:
        raise InputError(f"{name}: holds no accelerometerMisalignment, gyroscopeMisalignment or softIronMatrix")
    return texts.page_of(found, text)


def _write_json(page: Page) -> bytes:
    sensors = {k: {f: np.asarray(v).tolist() for f, v in s.fields.items()} for k, s in page.sensors.items()}
    return texts.json_bytes({**sensors, "margcal": texts.json_about(page)})


def _read_json(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    document = texts.json_object(data, name)
    found: dict[Kind, Fields] = {}
    for kind in FORMS:
        sensor = document.get(kind)
        if sensor is None:
            continue
        if not isinstance(sensor, dict):
            raise InputError(f"{name}: {kind!r} is no object with {', '.join(_SHAPES[kind])}")
        found[kind] = {key: texts.array(sensor.get(key), shape, key, name) for key, shape in _SHAPES[kind].items()}
    if not found:
        raise InputError(f"{name}: holds none of acc, gyr, mag with the arguments of imufusion.model_inertial")
    return texts.json_page(found, document.get("margcal"))


C = Target(
    "fusion",
    "x-io Fusion, C",
    ".h",
    FORMS,
    _write_c,
    _read_c,
    6e-8,
    FACTS,
    remark="for Fusion 1.2 and later; the names are those of its advanced example",
)
PYTHON = Target(
    "imufusion",
    "imufusion arguments, JSON",
    ".json",
    FORMS,
    _write_json,
    _read_json,
    6e-8,
    FACTS,
    remark="imufusion.model_inertial(y, **arguments['acc']), imufusion.model_magnetic(y, **arguments['mag'])",
)
