"""basalt calibration JSON: the inertial part.

Form        (I + S) y - b
Fields      value0.calib_accel_bias: 9 numbers, b then the lower triangle of S column by column;
            value0.calib_gyro_bias: 12 numbers, b then S column by column
Carries     the accelerometer's S is lower triangular: 6 of the 9 numbers of H in the node's frame, all where the frame
            may be turned (--move-frame); the gyroscope all. b = H B. No magnetometer
Units       raw m/s^2 and rad/s

From       basalt-headers, calibration/calib_bias.hpp (getBiasAndScale, getCalibrated). The turn of the frame and the
           test vectors stand under the key "margcal", which basalt does not read.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import InputError
from margcal.core.types import Array
from margcal.core.units import Kind
from margcal.files.exchange import texts
from margcal.files.exchange.target import Fields, Form, Page, Target

_LOWER = ((0, 0), (1, 0), (2, 0), (1, 1), (2, 1), (2, 2))
"""Where the six numbers of the accelerometer's S stand, in their order."""


def _encode_acc(H: Array, B: Array, R: Array) -> Fields:
    S = R @ H - np.eye(3)
    parameters = np.concatenate([R @ H @ B, [S[i, j] for i, j in _LOWER]])
    return {"calib_accel_bias": parameters, "R_ih": np.array(R)}


def _encode_gyr(H: Array, B: Array, R: Array) -> Fields:
    return {"calib_gyro_bias": np.concatenate([R @ H @ B, (R @ H - np.eye(3)).T.ravel()]), "R_ih": np.array(R)}


def _scale(fields: Fields) -> tuple[Array, Array]:
    """S and b of either sensor."""
    if "calib_gyro_bias" in fields:
        p = fields["calib_gyro_bias"]
        return p[3:].reshape(3, 3).T, p[:3]
    p, S = fields["calib_accel_bias"], np.zeros((3, 3))
    for value, (i, j) in zip(p[3:], _LOWER):
        S[i, j] = value
    return S, p[:3]


def _decode(fields: Fields) -> tuple[Array, Array]:
    S, b = _scale(fields)
    G = np.eye(3) + S
    return fields["R_ih"].T @ G, np.asarray(np.linalg.solve(G, b), dtype=np.float64)


def _apply(fields: Fields, y: ArrayLike) -> Array:
    """As getCalibrated: y + S y - b, in the IMU's frame."""
    S, b = _scale(fields)
    y = np.asarray(y)
    return y + y @ S.T - b


FORMS: dict[Kind, Form] = {
    "acc": Form(
        "(I + S) y - b", _encode_acc, _decode, _apply, matrix="lower", raw=("mps2",), unit="mps2", movable=True
    ),
    "gyr": Form("(I + S) y - b", _encode_gyr, _decode, _apply, raw=("radps",), unit="radps", movable=True),
}
_SIZES: tuple[tuple[Kind, str, int], ...] = (("acc", "calib_accel_bias", 9), ("gyr", "calib_gyro_bias", 12))


def _write(page: Page) -> bytes:
    R = next(iter(page.sensors.values())).fields["R_ih"]
    value = {key: page.sensors[k].fields[key].tolist() for k, key, _ in _SIZES if k in page.sensors}
    return texts.json_bytes({"value0": value, "margcal": {**texts.json_about(page), "R_ih": R.tolist()}})


def _read(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    document = texts.json_object(data, name)
    value: Any = document.get("value0")
    if not isinstance(value, dict):
        raise InputError(f"{name}: holds no value0; expected a calibration of basalt")
    about: Any = document.get("margcal")
    R = np.eye(3)
    if isinstance(about, dict) and "R_ih" in about:
        R = texts.array(about["R_ih"], (3, 3), "R_ih", name)
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-6:
            raise InputError(f"{name}: R_ih is no rotation")
    found: dict[Kind, Fields] = {
        kind: {key: texts.array(value[key], (size,), key, name), "R_ih": R}
        for kind, key, size in _SIZES
        if key in value
    }
    if not found:
        raise InputError(f"{name}: holds neither calib_accel_bias nor calib_gyro_bias")
    for kind, fields in found.items():
        if np.linalg.cond(np.eye(3) + _scale(fields)[0]) > 1e6:
            raise InputError(f"{name}: the scale matrix of {kind} is singular")
    page = texts.json_page(found, about)
    unit = {"acc": "mps2", "gyr": "radps"}
    return replace(page, sensors={k: replace(s, raw_unit=unit[k], unit=unit[k]) for k, s in page.sensors.items()})


BASALT = Target(
    "basalt",
    "basalt calibration JSON",
    ".json",
    FORMS,
    _write,
    _read,
    1e-12,
    "basalt-headers, calib_bias.hpp",
    remark="copy both keys into value0 of your calibration; --move-frame keeps all of the accelerometer's H",
)
