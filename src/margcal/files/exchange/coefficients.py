"""A scale and an offset an axis: qmt, GGIR, actipy.

qmt         Form      gain y - bias                       magnetometer, uT; gain = s, bias = s B
            Fields    gain, bias (return values of calibrateMagnetometerSimple; JSON of ours, it has no file)
GGIR        Form      scale (y + offset)                  accelerometer, g in and out; offset = -B
            Fields    CSV for backup.cal.coef: filename, scale.x.., offset.x.., temperature.offset.x.. (0)
actipy      Form      intercept + slope y                 accelerometer, g in and out; intercept = -s B
            Fields    CalibxIntercept.., CalibxSlope.. (keys of its info dictionary, as JSON)
Carries     bias and a scale an axis; no misalignment, one sensor each

From       qmt 0.2, functions/calibration.py. GGIR, g.calibrate and g.getmeta: ``scale(x, center = -offset,
           scale = 1/scale)``, which in R is (x + offset) scale; its manual names the columns. actipy, processing.py.
           A temperature term that is not zero is refused: a margcal file has one temperature.
"""

from __future__ import annotations

import csv
import io
import re
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.checking import printable
from margcal.core.errors import DataError, InputError
from margcal.core.types import Array
from margcal.core.units import Kind
from margcal.files.exchange import texts
from margcal.files.exchange.target import Fields, Form, Page, Sensor, Target, plain

AXES = "xyz"


def _encode_qmt(H: Array, B: Array, R: Array) -> Fields:
    return {"gain": np.diag(H).copy(), "bias": np.diag(H) * B}


def _decode_qmt(fields: Fields) -> tuple[Array, Array]:
    return np.diag(fields["gain"]), fields["bias"] / fields["gain"]


def _apply_qmt(fields: Fields, y: ArrayLike) -> Array:
    return fields["gain"] * np.asarray(y) - fields["bias"]


def _encode_ggir(H: Array, B: Array, R: Array) -> Fields:
    return {"scale": np.diag(H).copy(), "offset": -np.array(B)}


def _decode_ggir(fields: Fields) -> tuple[Array, Array]:
    return np.diag(fields["scale"]), -fields["offset"]


def _apply_ggir(fields: Fields, y: ArrayLike) -> Array:
    """R's ``scale(y, center = -offset, scale = 1/scale)``: subtract the centre, divide by the scale."""
    return (np.asarray(y) - (-fields["offset"])) / (1 / fields["scale"])


def _encode_actipy(H: Array, B: Array, R: Array) -> Fields:
    return {"slope": np.diag(H).copy(), "intercept": -np.diag(H) * B}


def _decode_actipy(fields: Fields) -> tuple[Array, Array]:
    return np.diag(fields["slope"]), -fields["intercept"] / fields["slope"]


def _apply_actipy(fields: Fields, y: ArrayLike) -> Array:
    return fields["intercept"] + fields["slope"] * np.asarray(y)


QMT_FORMS: dict[Kind, Form] = {
    "mag": Form("gain y - bias", _encode_qmt, _decode_qmt, _apply_qmt, matrix="diagonal"),
}
GGIR_FORMS: dict[Kind, Form] = {
    "acc": Form("scale (y + offset)", _encode_ggir, _decode_ggir, _apply_ggir, matrix="diagonal", raw=("g",), unit="g"),
}
ACTIPY_FORMS: dict[Kind, Form] = {
    "acc": Form(
        "intercept + slope y", _encode_actipy, _decode_actipy, _apply_actipy, matrix="diagonal", raw=("g",), unit="g"
    ),
}


def _nonzero(scale: Array, what: str, name: str) -> Array:
    if not scale.all():
        raise InputError(f"{name}: {what} is zero on an axis")
    return scale


def _write_qmt(page: Page) -> bytes:
    fields = page.sensors["mag"].fields
    return texts.json_bytes({k: fields[k].tolist() for k in ("gain", "bias")} | {"margcal": texts.json_about(page)})


def _read_qmt(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    document = texts.json_object(data, name)
    fields = {k: texts.array(document.get(k), (3,), k, name) for k in ("gain", "bias")}
    _nonzero(fields["gain"], "gain", name)
    return texts.json_page({"mag": fields}, document.get("margcal"))


def _write_ggir(page: Page) -> bytes:
    fields = page.sensors["acc"].fields
    header = ["filename", *(f"{k}.{a}" for k in ("scale", "offset", "temperature.offset") for a in AXES)]
    # a name as one cell that is no formula: no commas, no = + - @ at its beginning
    device = re.sub(r"[^A-Za-z0-9_. -]", "_", plain(page.device or "node", 80)).lstrip("- ")
    row = [device or "node", *map(texts.number, [*fields["scale"], *fields["offset"], 0.0, 0.0, 0.0])]
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows([header, row])
    return buffer.getvalue().encode()


def _read_ggir(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    try:
        table = csv.DictReader(io.StringIO(texts.decode(data, name)))
        rows = [r for r in table if r]
    except csv.Error as error:
        raise InputError(f"{name}: is no CSV table ({error})") from error
    header = [h.strip().lower() for h in table.fieldnames or ()]
    if twice := [h for h in header if header.count(h) > 1]:
        raise InputError(f"{name}: column {printable(twice[0], 60)!r} is there twice; keep one")
    if len(rows) != 1:
        raise InputError(f"{name}: has {len(rows)} rows; one is one calibration: keep the row of your device")
    if None in rows[0] or None in rows[0].values():
        raise InputError(f"{name}: the row has not as many cells as the header; it was cut or damaged")
    lower = {str(k).strip().lower(): v for k, v in rows[0].items() if k}
    fields: dict[str, Array] = {}
    for key in ("scale", "offset", "temperature.offset"):
        cells = [lower.get(f"{key}.{a}") for a in AXES]
        if key.startswith("temp") and not any(cells):
            continue
        try:
            values = [float(c or "nan") for c in cells]
        except (TypeError, ValueError):
            values = [float("nan")]
        fields[key] = texts.array(values, (3,), f"{key}.x, .y, .z", name)
    _refuse_temperature(fields.pop("temperature.offset", np.zeros(3)), name)
    _nonzero(fields["scale"], "scale", name)
    return Page({"acc": Sensor(fields, "g", "g")})


def _refuse_temperature(term: Array, name: str) -> None:
    if term.any():
        raise DataError(
            f"{name}: has a temperature term ({', '.join(map(texts.short, term))}), which a margcal file cannot "
            "hold; fold it into the offset at your temperature first"
        )


def _write_actipy(page: Page) -> bytes:
    f = page.sensors["acc"].fields
    values = {f"Calib{a}Intercept": float(v) for a, v in zip(AXES, f["intercept"])}
    values |= {f"Calib{a}Slope": float(v) for a, v in zip(AXES, f["slope"])}
    return texts.json_bytes({**values, "margcal": texts.json_about(page)})


def _read_actipy(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    lower: dict[str, Any] = {re.sub(r"^calib", "Calib", k): v for k, v in texts.json_object(data, name).items()}

    def triple(what: str, default: Any = None) -> Array:
        values = [lower.get(f"Calib{a}{what}", default) for a in AXES]
        return texts.array(values, (3,), f"CalibxYz{what}".replace("xYz", "x"), name)

    fields = {"intercept": triple("Intercept"), "slope": _nonzero(triple("Slope"), "slope", name)}
    _refuse_temperature(triple("SlopeT", 0.0), name)
    page = texts.json_page({"acc": fields}, lower.get("margcal"))
    vectors = page.sensors["acc"].vectors
    return Page({"acc": Sensor(fields, "g", "g", vectors)}, page.device, page.frame)


QMT = Target("qmt", "qmt gain and bias, JSON", ".json", QMT_FORMS, _write_qmt, _read_qmt, 1e-12, "qmt 0.2 itself")
GGIR = Target(
    "ggir",
    "GGIR coefficients, CSV",
    ".csv",
    GGIR_FORMS,
    _write_ggir,
    _read_ggir,
    1e-12,
    "GGIR, g.calibrate.R, g.getmeta.R",
    vectors=False,
    remark="for backup.cal.coef; put your recording's name into the column filename",
)
ACTIPY = Target(
    "actipy",
    "actipy coefficients, JSON",
    ".json",
    ACTIPY_FORMS,
    _write_actipy,
    _read_actipy,
    1e-12,
    "actipy, processing.py",
)
