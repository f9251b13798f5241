"""Kalibr imu.yaml (scale-misalignment) and OpenVINS kalibr_imu_chain.yaml: forward models of visual-inertial systems.

Kalibr      Form      accelerometer: y = M C_i_b a + b; gyroscope: y = M C_gyro_i C_i_b w + A C_gyro_i C_i_b a + b
            Fields    accelerometers.M; gyroscopes.M, A, C_gyro_i; T_i_b (4 x 4; its rotation is C_i_b)
            Carries   M is lower triangular, so the accelerometer has 6 of its 9 numbers in the node's frame, all 9
                      where the frame may be turned (--move-frame: T_i_b keeps the turn); the gyroscope all
OpenVINS    Form      a = R_IMUtoACC^T Ta^-1 (y - b); w = R_IMUtoGYRO^T Tw^-1 (y - b - Tg a)
            Fields    Ta, R_IMUtoACC, Tw, R_IMUtoGYRO, Tg; model: kalibr (Ta, Tw lower triangular)
            Carries   all of H of both
Both        No bias (both estimate it while running) and no magnetometer. The margcal bias stands in a comment.
Units       raw m/s^2 and rad/s, as a ROS driver publishes them

From        ethz-asl/kalibr, IccSensors.py, IccScaledMisalignedImu.addAccelerometerErrorTerms and
            addGyroscopeErrorTerms: A multiplies the specific force in the gyroscope's frame and is added to the
            reading, beside M, not inside it. rpng/open_vins, State.h (Dm) and VioManagerOptions.h (Dw = Tw^-1).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import InputError
from margcal.core.types import Array
from margcal.core.units import Kind
from margcal.files.exchange import texts, yaml_subset
from margcal.files.exchange.fitting import inverse, lower_times_rotation
from margcal.files.exchange.target import Fields, Form, Page, Target

NO_BIAS = np.zeros(3)


def _encode_acc(H: Array, B: Array, R: Array) -> Fields:
    return {"M": np.tril(inverse(R @ H)), "C_i_b": np.array(R)}


def _decode_acc(fields: Fields) -> tuple[Array, Array]:
    return inverse(fields["M"] @ fields["C_i_b"]), NO_BIAS


def _apply_acc(fields: Fields, y: ArrayLike) -> Array:
    """In the IMU frame i: what Kalibr predicts from it, M a, is the reading."""
    return np.linalg.solve(fields["M"], np.asarray(y).T).T


def _encode_gyr(H: Array, B: Array, R: Array) -> Fields:
    M, C = lower_times_rotation(inverse(R @ H))
    return {"M": M, "C_gyro_i": C, "C_i_b": np.array(R)}


def _decode_gyr(fields: Fields) -> tuple[Array, Array]:
    return inverse(fields["M"] @ fields["C_gyro_i"] @ fields["C_i_b"]), NO_BIAS


def _apply_gyr(fields: Fields, y: ArrayLike) -> Array:
    in_gyro = np.linalg.solve(fields["M"], np.asarray(y).T)
    return (fields["C_gyro_i"].T @ in_gyro).T


KALIBR_FORMS: dict[Kind, Form] = {
    "acc": Form(
        "y = M C_i_b a + b",
        _encode_acc,
        _decode_acc,
        _apply_acc,
        matrix="lower",
        bias=False,
        raw=("mps2",),
        unit="mps2",
        movable=True,
    ),
    "gyr": Form(
        "y = M C_gyro_i C_i_b w + A C_gyro_i C_i_b a + b",
        _encode_gyr,
        _decode_gyr,
        _apply_gyr,
        bias=False,
        raw=("radps",),
        unit="radps",
        movable=True,
    ),
}


def _rows(name: str, matrix: Array, indent: int) -> str:
    pad = " " * indent
    return f"{pad}{name}:\n" + "".join(f"{pad}  - [{texts.row(r)}]\n" for r in matrix)


def _write_kalibr(page: Page) -> bytes:
    C = next(iter(page.sensors.values())).fields["C_i_b"]
    T = np.eye(4)
    T[:3, :3] = C
    out = texts.comment([*texts.heading(page), *texts.vector_lines(page)], "#")
    out += "# Add your accelerometer_noise_density, accelerometer_random_walk, gyroscope_noise_density,\n"
    out += "# gyroscope_random_walk, rostopic and update_rate.\n"
    out += "imu0:\n  model: scale-misalignment\n" + _rows("T_i_b", T, 2)
    if acc := page.sensors.get("acc"):
        out += "  accelerometers:\n" + _rows("M", acc.fields["M"], 4)
    if gyr := page.sensors.get("gyr"):
        out += "  gyroscopes:\n" + _rows("M", gyr.fields["M"], 4)
        out += _rows("A", np.zeros((3, 3)), 4) + _rows("C_gyro_i", gyr.fields["C_gyro_i"], 4)
    return out.encode()


def imu_of(text: str, name: str) -> Mapping[str, Any]:
    """The mapping of the first IMU in the YAML `text`."""
    document = yaml_subset.load(text, name)
    if not isinstance(document, dict):
        raise InputError(f"{name}: holds no mapping; expected imu0: ...")
    imu = document.get("imu0", document)
    if not isinstance(imu, dict):
        raise InputError(f"{name}: imu0 holds no keys")
    return imu


def _rotation(value: Any, what: str, name: str) -> Array:
    """A rotation of a file, made exactly orthogonal; refused where it is none to begin with."""
    C = texts.array(value, (3, 3), what, name)
    if np.abs(C @ C.T - np.eye(3)).max() > 1e-3 or np.linalg.det(C) < 0:
        raise InputError(f"{name}: {what} is no rotation matrix")
    return C


def _invertible(value: Any, what: str, name: str) -> Array:
    M = texts.array(value, (3, 3), what, name)
    if np.linalg.cond(M) > 1e6:
        raise InputError(f"{name}: {what} is singular")
    return M


def _read_kalibr(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    text = texts.decode(data, name)
    imu = imu_of(text, name)
    model = imu.get("model", "calibrated")
    if model == "calibrated" and "accelerometers" not in imu and "gyroscopes" not in imu:
        raise InputError(f"{name}: its model is 'calibrated': it holds noise figures only, no calibration")
    T = texts.array(imu.get("T_i_b", np.eye(4)), (4, 4), "T_i_b", name)
    C_i_b = _rotation(T[:3, :3], "the rotation in T_i_b", name)
    found: dict[Kind, Fields] = {}
    dropped: dict[Kind, str] = {}
    if isinstance(acc := imu.get("accelerometers"), dict):
        found["acc"] = {"M": _invertible(acc.get("M"), "accelerometers.M", name), "C_i_b": C_i_b}
        if any(np.any(texts.array(acc.get(f"r{k}_i", NO_BIAS), (3,), f"r{k}_i", name)) for k in "xyz"):
            dropped["acc"] = "the lever arms rx_i, ry_i, rz_i (size effect) have no place in a margcal file"
    if isinstance(gyr := imu.get("gyroscopes"), dict):
        C = _rotation(gyr.get("C_gyro_i", np.eye(3)), "gyroscopes.C_gyro_i", name)
        found["gyr"] = {"M": _invertible(gyr.get("M"), "gyroscopes.M", name), "C_gyro_i": C, "C_i_b": C_i_b}
        A = texts.array(gyr.get("A", np.zeros((3, 3))), (3, 3), "gyroscopes.A", name)
        dropped["gyr"] = _sensitivity(A, "A")
    if not found:
        raise InputError(f"{name}: holds neither accelerometers nor gyroscopes; expected model: scale-misalignment")
    return _in_si(texts.page_of(found, text, dropped))


def _sensitivity(A: Array, letter: str) -> str:
    if not A.any():
        return ""
    size = texts.short(float(np.abs(A).max()))
    return f"{letter} (what acceleration does to the gyroscope, up to {size}) has no place in a margcal file"


def _in_si(page: Page) -> Page:
    """Units are those of ROS, whatever the file says or does not say."""
    unit = {"acc": "mps2", "gyr": "radps"}
    sensors = {k: replace(s, raw_unit=unit[k], unit=unit[k]) for k, s in page.sensors.items()}
    return replace(page, sensors=sensors)


def _encode_chain(H: Array, B: Array, R: Array) -> Fields:
    T, C = lower_times_rotation(inverse(H))
    return {"T": T, "R": C}


def _decode_chain(fields: Fields) -> tuple[Array, Array]:
    return fields["R"].T @ inverse(fields["T"]), NO_BIAS


def _apply_chain(fields: Fields, y: ArrayLike) -> Array:
    """Column by column as in State.h: D is the lower triangle of T^-1."""
    D = np.tril(inverse(fields["T"]))
    return np.asarray(y) @ D.T @ fields["R"]


def _chain(formula: str, unit: str) -> Form:
    return Form(formula, _encode_chain, _decode_chain, _apply_chain, bias=False, raw=(unit,), unit=unit)


OPENVINS_FORMS: dict[Kind, Form] = {
    "acc": _chain("R_IMUtoACC^T Ta^-1 (y - b)", "mps2"),
    "gyr": _chain("R_IMUtoGYRO^T Tw^-1 (y - b - Tg a)", "radps"),
}
_NAMES = {"acc": ("Ta", "R_IMUtoACC"), "gyr": ("Tw", "R_IMUtoGYRO")}


def _write_openvins(page: Page) -> bytes:
    out = "%YAML:1.0\n" + texts.comment([*texts.heading(page), *texts.vector_lines(page)], "#")
    out += "# Add your noise densities, random walks, rostopic, time_offset and update_rate.\n"
    out += "imu0:\n  model: kalibr\n" + _rows("T_i_b", np.eye(4), 2)
    for kind, (T, R) in _NAMES.items():
        sensor = page.sensors.get(kind)  # type: ignore[call-overload]
        out += _rows(T, sensor.fields["T"] if sensor else np.eye(3), 2)
        out += _rows(R, sensor.fields["R"] if sensor else np.eye(3), 2)
    return (out + _rows("Tg", np.zeros((3, 3)), 2)).encode()


def _read_openvins(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    text = texts.decode(data, name)
    imu = imu_of(text, name)
    lower = imu.get("model", "kalibr") != "rpng"
    found: dict[Kind, Fields] = {}
    for kind, (T, R) in (("acc", ("Ta", "R_IMUtoACC")), ("gyr", ("Tw", "R_IMUtoGYRO"))):
        if T not in imu:
            continue
        matrix = _invertible(imu[T], T, name)
        if np.any(np.triu(matrix, 1) if lower else np.tril(matrix, -1)):
            shape = "lower" if lower else "upper"
            raise InputError(f"{name}: {T} is not {shape} triangular, as model {imu.get('model')!s:.20} has it")
        rotation = _rotation(imu.get(R, np.eye(3)), R, name)
        if not lower:  # kept as it is: T need not be lower triangular to be decoded
            matrix, rotation = lower_times_rotation(matrix @ rotation)
        found[kind] = {"T": matrix, "R": rotation}  # type: ignore[index]
    if not found:
        raise InputError(f"{name}: holds neither Ta nor Tw; expected OpenVINS' kalibr_imu_chain.yaml")
    Tg = texts.array(imu.get("Tg", np.zeros((3, 3))), (3, 3), "Tg", name)
    return _in_si(texts.page_of(found, text, {"gyr": _sensitivity(Tg, "Tg")}))


_LIVE = "the bias is estimated while it runs; margcal's stands in a comment"
KALIBR = Target(
    "kalibr",
    "Kalibr imu.yaml, scale-misalignment",
    ".yaml",
    KALIBR_FORMS,
    _write_kalibr,
    _read_kalibr,
    1e-12,
    "kalibr, IccSensors.py",
    remark=f"{_LIVE}; --move-frame keeps all of the accelerometer's H",
)
OPENVINS = Target(
    "openvins",
    "OpenVINS kalibr_imu_chain.yaml",
    ".yaml",
    OPENVINS_FORMS,
    _write_openvins,
    _read_openvins,
    1e-12,
    "open_vins, State.h, VioManagerOptions.h",
    remark=_LIVE,
)
