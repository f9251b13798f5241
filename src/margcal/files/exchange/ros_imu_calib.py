"""imu_calib (ROS): the yaml of apply_calib.

Form        SM y - bias
Fields      SM: nine numbers row by row; bias: three; bias = H B
Carries     all of H and B of the accelerometer. The gyroscope's bias is measured by the node itself at its start
Units       raw m/s^2, as a ROS driver publishes it

From       dpkoch/imu_calib, accel_calib.cpp (loadCalib, applyCalib).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import InputError
from margcal.core.types import Array
from margcal.core.units import Kind
from margcal.files.exchange import texts, yaml_subset
from margcal.files.exchange.target import Fields, Form, Page, Sensor, Target


def _encode(H: Array, B: Array, R: Array) -> Fields:
    return {"SM": np.array(H), "bias": H @ B}


def _decode(fields: Fields) -> tuple[Array, Array]:
    return fields["SM"], np.linalg.solve(fields["SM"], fields["bias"])


def _apply(fields: Fields, y: ArrayLike) -> Array:
    return np.asarray(y) @ fields["SM"].T - fields["bias"]


FORMS: dict[Kind, Form] = {"acc": Form("SM y - bias", _encode, _decode, _apply, raw=("mps2",), unit="mps2")}


def _write(page: Page) -> bytes:
    fields = page.sensors["acc"].fields
    out = texts.comment([*texts.heading(page), *texts.vector_lines(page)], "#")
    out += "SM:\n" + "".join(f"  - {texts.number(v)}\n" for v in fields["SM"].ravel())
    return (out + "bias:\n" + "".join(f"  - {texts.number(v)}\n" for v in fields["bias"])).encode()


def _read(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    text = texts.decode(data, name)
    document = yaml_subset.load(text, name)
    if not isinstance(document, dict) or not {"SM", "bias"} <= set(document):
        raise InputError(f"{name}: holds no SM and bias; expected the yaml of imu_calib")
    SM = texts.array(document["SM"], (9,), "SM", name).reshape(3, 3)
    if np.linalg.cond(SM) > 1e6:
        raise InputError(f"{name}: SM is singular")
    fields = {"SM": SM, "bias": texts.array(document["bias"], (3,), "bias", name)}
    vectors = texts.vectors_in(text).get("acc")
    return Page({"acc": Sensor(fields, "mps2", "mps2", vectors)}, *texts.about(text))


ROS_IMU_CALIB = Target(
    "ros-imu-calib",
    "ROS imu_calib yaml",
    ".yaml",
    FORMS,
    _write,
    _read,
    1e-12,
    "imu_calib, accel_calib.cpp",
    remark="accelerometer only; the node measures the gyroscope's bias itself",
)
