"""imu_tk (C++): the file of one CalibratedTriad.

Form        T K (y - B)
Fields      nine numbers of T, nine of K (diagonal), three of B, without names, separated by white space
Carries     all of H and B of one accelerometer or gyroscope: K = diag(H), T = H K^-1 with ones on its diagonal
Units       the file does not say

From       A. Pretto, imu_tk/calibration.h, class CalibratedTriad_ (its comment, `load`,
           `unbiasNormalize`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import InputError
from margcal.core.types import Array
from margcal.core.units import Kind
from margcal.files.exchange import texts
from margcal.files.exchange.target import Fields, Form, Page, Sensor, Target


def _encode(H: Array, B: Array, R: Array) -> Fields:
    size = np.linalg.norm(H, axis=0)
    K = np.diag(H) if (np.abs(np.diag(H)) > 0.1 * size).all() else size  # axes that are swapped: T has no ones
    return {"T": H / K, "K": np.diag(K), "B": np.array(B)}


def _decode(fields: Fields) -> tuple[Array, Array]:
    return fields["T"] @ fields["K"], fields["B"]


def _apply(fields: Fields, y: ArrayLike) -> Array:
    scaled = (np.asarray(y) - fields["B"]) @ fields["K"].T
    return scaled @ fields["T"].T


FORMS: dict[Kind, Form] = dict.fromkeys(("acc", "gyr"), Form("T K (y - B)", _encode, _decode, _apply))


def _write(page: Page) -> bytes:
    (sensor,) = page.sensors.values()
    blocks = [sensor.fields["T"], sensor.fields["K"], sensor.fields["B"].reshape(3, 1)]
    return ("\n\n".join("\n".join(texts.row(r, texts.number, " ") for r in b) for b in blocks) + "\n").encode()


def _read(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    if len(kinds) != 1 or kinds[0] not in FORMS:
        raise InputError(f"{name}: an imu_tk file does not say which sensor it is of; give --sensors acc or gyr")
    words = texts.decode(data, name).split()[:21]
    try:
        values = [float(w) for w in words]
    except ValueError as error:
        raise InputError(f"{name}: expected 21 numbers (T, K, B); something else is among them") from error
    v = texts.array(values, (21,), "T, K, B", name)
    fields = {"T": v[:9].reshape(3, 3), "K": v[9:18].reshape(3, 3), "B": v[18:]}
    return Page({kinds[0]: Sensor(fields)})


IMU_TK = Target(
    "imu-tk",
    "imu_tk calibration file",
    ".calib",
    FORMS,
    _write,
    _read,
    1e-12,
    "imu_tk, calibration.h",
    single=True,
    vectors=False,
    remark="one sensor a file: --sensors acc, then --sensors gyr",
)
