"""Parameters of ArduPilot and PX4.

ArduPilot   Form      compass: M (R y + OFS); accelerometer: R (SCAL (y - OFFS)); gyroscope: R (y - OFFS)
            Fields    COMPASS_OFS_X.., COMPASS_DIA_X.., COMPASS_ODI_X (xy), _Y (xz), _Z (yz), COMPASS_SCALE (1),
                      COMPASS_ORIENT; INS_ACCOFFS_X.., INS_ACCSCAL_X.., INS_GYROFFS_X.., AHRS_ORIENTATION
            Units     milligauss; m/s^2; rad/s
PX4         Form      magnetometer: R (M (y - OFF)); accelerometer: R (SCALE (y - OFF)); gyroscope: R (y - OFF)
            Fields    CAL_MAG0_XOFF.., _XSCALE.., _XODIAG (xy), _YODIAG (xz), _ZODIAG (yz), CAL_MAG0_ROT;
                      CAL_ACC0_XOFF.., _XSCALE..; CAL_GYRO0_XOFF..; SENS_BOARD_ROT
            Units     gauss; m/s^2; rad/s
R is one of the board orientations that all of them number alike (see `fitting`); M is symmetric.
Carries     magnetometer: 6 of 9 numbers; accelerometer: a scale an axis; gyroscope: bias only

ArduPilot rotates the compass BEFORE offsets and matrix, PX4 after: read in AP_Compass_Backend.cpp (rotate_field comes
before publish_raw_field and correct_field) and in sensor_calibration/Magnetometer.hpp (Correct). So for ArduPilot
H = M R and OFS = -R B, for PX4 H = R M and OFF = B. Ranges of ArduPilot: @Range of AP_InertialSensor_Params.cpp,
limits of CompassCalibrator.cpp (DIA, ODI), COMPASS_OFFS_MAX; of PX4: its parameter reference (not read in source).
The node's frame must be the vehicle's: x forward, y right, z down.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import InputError
from margcal.core.types import Array
from margcal.core.units import Kind
from margcal.files.exchange import texts
from margcal.files.exchange.fitting import ORIENTATIONS, orientation_number
from margcal.files.exchange.target import Fields, Form, Page, Range, Sensor, Target, single_precision

AXES = "XYZ"


def symmetric(diagonal: ArrayLike, off: ArrayLike) -> Array:
    """The symmetric matrix of (xx, yy, zz) and (xy, xz, yz)."""
    (a, b, c), (d, e, f) = np.asarray(diagonal, dtype=np.float64), np.asarray(off, dtype=np.float64)
    return np.array([[a, d, e], [d, b, f], [e, f, c]])


def _halves(M: Array) -> tuple[Array, Array]:
    return single_precision(np.diag(M)), single_precision([M[0, 1], M[0, 2], M[1, 2]])


def _encode_compass(H: Array, B: Array, R: Array) -> Fields:
    diagonal, off = _halves(H @ R.T)
    ofs = single_precision(-R @ B)
    return {"ofs": ofs, "diagonal": diagonal, "off": off, "orientation": orientation_number(R)}


def _decode_compass(fields: Fields) -> tuple[Array, Array]:
    R = ORIENTATIONS[fields["orientation"]]
    return symmetric(fields["diagonal"], fields["off"]) @ R, -R.T @ fields["ofs"]


def _apply_compass(fields: Fields, y: ArrayLike) -> Array:
    turned = np.asarray(y) @ ORIENTATIONS[fields["orientation"]].T
    return (turned + fields["ofs"]) @ symmetric(fields["diagonal"], fields["off"]).T


def _encode_mag(H: Array, B: Array, R: Array) -> Fields:
    diagonal, off = _halves(R.T @ H)
    return {"ofs": single_precision(B), "diagonal": diagonal, "off": off, "orientation": orientation_number(R)}


def _decode_mag(fields: Fields) -> tuple[Array, Array]:
    return ORIENTATIONS[fields["orientation"]] @ symmetric(fields["diagonal"], fields["off"]), fields["ofs"]


def _apply_mag(fields: Fields, y: ArrayLike) -> Array:
    corrected = symmetric(fields["diagonal"], fields["off"]) @ (np.asarray(y) - fields["ofs"]).T
    return (ORIENTATIONS[fields["orientation"]] @ corrected).T


def _encode_acc(H: Array, B: Array, R: Array) -> Fields:
    scale = single_precision(np.diag(R.T @ H))
    return {"ofs": single_precision(B), "scale": scale, "orientation": orientation_number(R)}


def _decode_acc(fields: Fields) -> tuple[Array, Array]:
    return ORIENTATIONS[fields["orientation"]] * fields["scale"], fields["ofs"]


def _apply_acc(fields: Fields, y: ArrayLike) -> Array:
    return ((np.asarray(y) - fields["ofs"]) * fields["scale"]) @ ORIENTATIONS[fields["orientation"]].T


def _encode_gyr(H: Array, B: Array, R: Array) -> Fields:
    return {"ofs": single_precision(B), "orientation": orientation_number(R)}


def _decode_gyr(fields: Fields) -> tuple[Array, Array]:
    return np.array(ORIENTATIONS[fields["orientation"]]), fields["ofs"]


def _apply_gyr(fields: Fields, y: ArrayLike) -> Array:
    return (np.asarray(y) - fields["ofs"]) @ ORIENTATIONS[fields["orientation"]].T


def _gyr_form() -> Form:
    return Form(
        "R (y - OFF)",
        _encode_gyr,
        _decode_gyr,
        _apply_gyr,
        matrix="unit",
        raw=("radps",),
        unit="radps",
        board="after",
        group="board",
    )


ARDUPILOT_FORMS: dict[Kind, Form] = {
    "acc": Form(
        "R (SCAL (y - OFFS))",
        _encode_acc,
        _decode_acc,
        _apply_acc,
        matrix="diagonal",
        raw=("mps2",),
        unit="mps2",
        board="after",
        group="board",
        ranges=(
            Range("ofs", -3.5, 3.5, "m/s^2", shown="INS_ACCOFFS"),
            Range("scale", 0.8, 1.2, shown="INS_ACCSCAL"),
        ),
    ),
    "gyr": _gyr_form(),
    "mag": Form(
        "M (R y + OFS)",
        _encode_compass,
        _decode_compass,
        _apply_compass,
        matrix="symmetric",
        raw=("mgauss",),
        unit="mgauss",
        board="before",
        group="compass",
        ranges=(
            Range("ofs", -400, 400, "milligauss", hard=False, shown="COMPASS_OFS"),
            Range("ofs", -1800, 1800, "milligauss", shown="COMPASS_OFS (COMPASS_OFFS_MAX)"),
            Range("diagonal", 0.2, 5.0, shown="COMPASS_DIA"),
            Range("off", -1.0, 1.0, shown="COMPASS_ODI"),
        ),
    ),
}
PX4_FORMS: dict[Kind, Form] = {
    "acc": Form(
        "R (SCALE (y - OFF))",
        _encode_acc,
        _decode_acc,
        _apply_acc,
        matrix="diagonal",
        raw=("mps2",),
        unit="mps2",
        board="after",
        group="board",
        ranges=(Range("scale", 0.1, 3.0, shown="CAL_ACC0_SCALE"),),
    ),
    "gyr": _gyr_form(),
    "mag": Form(
        "R (M (y - OFF))",
        _encode_mag,
        _decode_mag,
        _apply_mag,
        matrix="symmetric",
        raw=("gauss",),
        unit="gauss",
        board="after",
        group="compass",
        ranges=(
            Range("ofs", -1.3, 1.3, "gauss", hard=False, shown="CAL_MAG0_OFF"),
            Range("diagonal", 0.1, 3.0, shown="CAL_MAG0_SCALE"),
        ),
    ),
}
Names = Mapping[Kind, Mapping[str, tuple[str, ...]]]


def _triple(pattern: str) -> tuple[str, ...]:
    return tuple(pattern.replace("?", a) for a in AXES)


ARDUPILOT_NAMES: Names = {
    "acc": {"ofs": _triple("INS_ACCOFFS_?"), "scale": _triple("INS_ACCSCAL_?"), "orientation": ("AHRS_ORIENTATION",)},
    "gyr": {"ofs": _triple("INS_GYROFFS_?"), "orientation": ("AHRS_ORIENTATION",)},
    "mag": {
        "ofs": _triple("COMPASS_OFS_?"),
        "diagonal": _triple("COMPASS_DIA_?"),
        "off": _triple("COMPASS_ODI_?"),
        "orientation": ("COMPASS_ORIENT",),
    },
}
PX4_NAMES: Names = {
    "acc": {"ofs": _triple("CAL_ACC0_?OFF"), "scale": _triple("CAL_ACC0_?SCALE"), "orientation": ("SENS_BOARD_ROT",)},
    "gyr": {"ofs": _triple("CAL_GYRO0_?OFF"), "orientation": ("SENS_BOARD_ROT",)},
    "mag": {
        "ofs": _triple("CAL_MAG0_?OFF"),
        "diagonal": _triple("CAL_MAG0_?SCALE"),
        "off": _triple("CAL_MAG0_?ODIAG"),
        "orientation": ("CAL_MAG0_ROT",),
    },
}


def parameters(page: Page, names: Names) -> dict[str, float]:
    """The parameters of a page by name. Orientation 0 is left out: it would overwrite what a vehicle has."""
    out: dict[str, float] = {}
    for kind, sensor in page.sensors.items():
        for field, keys in names[kind].items():
            values = np.atleast_1d(sensor.fields[field])
            if field == "orientation" and not values.any():
                continue
            out.update(zip(keys, map(float, values)))
    return out


def _fields_of(values: Mapping[str, float], names: Names, name: str) -> dict[Kind, Fields]:
    """The fields of each sensor whose offsets are there and not all at their default."""
    found: dict[Kind, Fields] = {}
    defaults = {"scale": 1.0, "diagonal": 1.0, "off": 0.0, "orientation": 0.0}
    for kind, fields in names.items():
        if not any(k in values for k in fields["ofs"]):
            continue
        sensor: dict[str, Any] = {}
        for field, keys in fields.items():
            if field == "ofs" and (missing := [k for k in keys if k not in values]):
                raise InputError(f"{name}: {missing[0]} is not there, though other axes are")
            got = np.array([values.get(k, defaults.get(field, 0.0)) for k in keys])
            if field == "orientation":
                number = int(got[0]) if got[0] > 0 else 0  # PX4: -1 means an internal sensor, turned with the board
                if number >= len(ORIENTATIONS):
                    raise InputError(f"{name}: {keys[0]} {number} is not read; orientations 0 to 37 are")
                sensor[field] = number
            else:
                sensor[field] = got
        if not np.any(sensor.get("diagonal", 1.0)):  # ArduPilot: all zero means "not calibrated", taken as one
            sensor["diagonal"] = np.ones(3)
        if not np.all(sensor.get("scale", 1.0)):
            raise InputError(f"{name}: a scale of {kind} is zero: the sensor was not calibrated")
        if "diagonal" in sensor and np.linalg.cond(symmetric(sensor["diagonal"], sensor["off"])) > 1e6:  # type: ignore[arg-type]
            raise InputError(f"{name}: the matrix of {kind} is singular")
        found[kind] = sensor
    if not found:
        raise InputError(f"{name}: holds none of {', '.join(f['ofs'][0] for f in names.values())}")
    return found


def _page(text: str, values: Mapping[str, float], names: Names, forms: Mapping[Kind, Form], name: str) -> Page:
    vectors = texts.vectors_in(text)
    return Page(
        {
            k: Sensor(f, forms[k].raw[0], forms[k].unit, vectors.get(k))
            for k, f in _fields_of(values, names, name).items()
        },
        *texts.about(text),
    )


_LINE = re.compile(
    rf"^[ \t]{{0,20}}([A-Z][A-Z0-9_]{{2,16}})[ \t,=:]{{1,20}}({texts.NUMBER})[ \t\r]{{0,20}}(?:[#@].*)?$", re.MULTILINE
)


def _values(lines: Iterable[re.Match[str]], name: str) -> dict[str, float]:
    """Parameters by name; one that is there twice with two values is refused."""
    values: dict[str, float] = {}
    for m in lines:
        if values.setdefault(m[1], float(m[2])) != float(m[2]):
            raise InputError(f"{name}: {m[1]} is there twice, with two values")
    return values


def _write_ardupilot(page: Page) -> bytes:
    out = texts.comment([*texts.heading(page), *texts.vector_lines(page)], "#")
    values = parameters(page, ARDUPILOT_NAMES)
    if "mag" in page.sensors:
        out += "# COMPASS_ORIENT holds for an external compass; an internal one turns with AHRS_ORIENTATION\n"
        values["COMPASS_SCALE"] = 1.0
    return (out + "".join(f"{k},{texts.short(v)}\n" for k, v in values.items())).encode()


def _read_ardupilot(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    text = texts.decode(data, name)
    values = _values(_LINE.finditer(text), name)
    page = _page(text, values, ARDUPILOT_NAMES, ARDUPILOT_FORMS, name)
    factor = values.get("COMPASS_SCALE", 1.0)
    if "mag" in page.sensors and 0.5 < factor < 2 and factor != 1.0:  # outside: ArduPilot takes 1
        fields = dict(page.sensors["mag"].fields)
        fields["diagonal"], fields["off"] = fields["diagonal"] * factor, fields["off"] * factor
        mag = replace(page.sensors["mag"], fields=fields)
        page = replace(page, sensors={**page.sensors, "mag": mag})
    return page


def _write_px4(page: Page) -> bytes:
    """As QGroundControl saves parameters: vehicle, component, name, value, type (9 float, 6 int), tab separated."""
    out = texts.comment([*texts.heading(page), *texts.vector_lines(page)], "#")
    out += "# CAL_..._ID must be that of your sensor: calibrate it once on the vehicle, then load this file\n"
    for key, value in parameters(page, PX4_NAMES).items():
        whole = key.endswith("_ROT")
        out += f"1\t1\t{key}\t{round(value) if whole else texts.short(value)}\t{6 if whole else 9}\n"
    return out.encode()


_QGC = re.compile(
    rf"^\d{{1,5}}[ \t]+\d{{1,5}}[ \t]+([A-Z][A-Z0-9_]{{2,16}})[ \t]+({texts.NUMBER})[ \t]+\d+[ \t\r]*$", re.MULTILINE
)


def _read_px4(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    text = texts.decode(data, name)
    lines = [*_QGC.finditer(text)] or [*_LINE.finditer(text)]
    return _page(text, _values(lines, name), PX4_NAMES, PX4_FORMS, name)


_FRD = "the node's frame must be the vehicle's: x forward, y right, z down"
ARDUPILOT = Target(
    "ardupilot",
    "ArduPilot parameters",
    ".param",
    ARDUPILOT_FORMS,
    _write_ardupilot,
    _read_ardupilot,
    1e-7,
    "AP_Compass_Backend.cpp, AP_InertialSensor_Backend.cpp, AP_InertialSensor_Params.cpp",
    remark=_FRD,
)
PX4 = Target(
    "px4",
    "PX4 parameters (QGroundControl)",
    ".params",
    PX4_FORMS,
    _write_px4,
    _read_px4,
    1e-7,
    "PX4 sensor_calibration: Magnetometer.hpp, Accelerometer.hpp, Gyroscope.hpp",
    remark=f"{_FRD}; CAL_..._ID must match your sensors",
)
