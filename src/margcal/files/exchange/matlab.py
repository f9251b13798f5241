"""MATLAB: the results of magcal and accelcal, as a .mat file or as a script.

Form        magnetometer (magcal): (D - b) A; accelerometer and gyroscope (accelcal): D A + b; readings are rows
Fields      mag_A, mag_b, mag_expmfs; acc_A, acc_b; gyr_A, gyr_b
            (so A = H^T, and b = B for the magnetometer, b = -H B transposed for the others)
Carries     all of H and B; magcal itself only ever gives a symmetric A
Units       as in the calibration; expmfs is the expected field strength

From       MathWorks, reference pages of magcal ("C = (D-b)*A") and accelcal ("C = U*A + b"), both read.
           Reading is `mat5`'s: objects, structures, functions and cells are refused, as is a file above 256 kB.
"""

from __future__ import annotations

import io
import re
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import InputError
from margcal.core.types import Array
from margcal.core.units import KINDS, Kind
from margcal.files.exchange import mat5, texts
from margcal.files.exchange.target import Fields, Form, Page, Sensor, Target

FACTS = "MathWorks reference pages of magcal and accelcal"
LARGEST_MAT = 256_000


def _encode_magcal(H: Array, B: Array, R: Array) -> Fields:
    return {"A": H.T.copy(), "b": np.array(B)}


def _decode_magcal(fields: Fields) -> tuple[Array, Array]:
    return fields["A"].T, fields["b"]


def _apply_magcal(fields: Fields, y: ArrayLike) -> Array:
    return (np.asarray(y) - fields["b"]) @ fields["A"]


def _encode_accelcal(H: Array, B: Array, R: Array) -> Fields:
    return {"A": H.T.copy(), "b": -H @ B}


def _decode_accelcal(fields: Fields) -> tuple[Array, Array]:
    H = fields["A"].T
    return H, -np.linalg.solve(H, fields["b"])


def _apply_accelcal(fields: Fields, y: ArrayLike) -> Array:
    return np.asarray(y) @ fields["A"] + fields["b"]


_ACCELCAL = Form("D A + b", _encode_accelcal, _decode_accelcal, _apply_accelcal)
FORMS: dict[Kind, Form] = {
    "acc": _ACCELCAL,
    "gyr": _ACCELCAL,
    "mag": Form("(D - b) A", _encode_magcal, _decode_magcal, _apply_magcal),
}


def _variables(page: Page) -> dict[str, Any]:
    """The variables of a page by name, matrices as matrices and vectors as rows."""
    out: dict[str, Any] = {}
    for kind, sensor in page.sensors.items():
        out[f"{kind}_A"] = sensor.fields["A"]
        out[f"{kind}_b"] = sensor.fields["b"].reshape(1, 3)
        if kind == "mag" and page.field_uT:
            out["mag_expmfs"] = np.array([[page.field_uT]])
        if sensor.vectors is not None:
            out[f"{kind}_test_raw"], out[f"{kind}_test_out"] = sensor.vectors
    return out


def _write_mat(page: Page) -> bytes:
    from scipy.io import savemat

    buffer = io.BytesIO()
    notes = "\n".join(texts.heading(page))
    savemat(buffer, {**_variables(page), "margcal_notes": notes}, format="5", do_compression=False)
    data = buffer.getvalue()
    # the first 116 bytes are free text, in which scipy puts the time: same calibration, same bytes
    return b"MATLAB 5.0 MAT-file, written by margcal".ljust(116) + data[116:]


def _read_mat(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    if len(data) > LARGEST_MAT:
        raise InputError(f"{name}: is larger than {LARGEST_MAT // 1000} kB; a calibration has a dozen numbers a sensor")
    found = mat5.read(data, name)
    variables: dict[str, Any] = {}
    for key, variable in found.items():
        if not re.fullmatch(r"((acc|gyr|mag)_)?(A|b|expmfs|test_raw|test_out)", key):
            continue
        if not isinstance(variable.value, np.ndarray):
            raise InputError(f"{name}: {key} is of class {variable.kind}; expected a matrix of numbers")
        variables[key] = variable.value
    notes = found["margcal_notes"].value if "margcal_notes" in found else ""
    return _page(variables, notes if isinstance(notes, str) else "", name, kinds)


def _page(variables: dict[str, Any], notes: str, name: str, kinds: tuple[Kind, ...]) -> Page:
    if "A" in variables:  # as magcal and accelcal return them: the file does not say of which sensor
        kind = _sole_kind(variables, kinds, name)
        variables = {f"{kind}_{k}": v for k, v in variables.items() if k in ("A", "b")}
    units = texts.units_in(notes)
    sensors: dict[Kind, Sensor] = {}
    for kind in KINDS:
        if f"{kind}_A" not in variables:
            continue
        fields = {
            "A": texts.array(variables[f"{kind}_A"], (3, 3), f"{kind}_A", name),
            "b": texts.array(np.ravel(variables.get(f"{kind}_b", ())), (3,), f"{kind}_b", name),
        }
        vectors = None
        if f"{kind}_test_raw" in variables and f"{kind}_test_out" in variables:
            raw, out = (
                texts.array(variables[f"{kind}_test_{k}"], (10, 3), "test vectors", name) for k in ("raw", "out")
            )
            vectors = (raw, out)
        sensors[kind] = Sensor(fields, *units.get(kind, (None, None)), vectors=vectors)
    if not sensors:
        raise InputError(
            f"{name}: holds neither A and b nor acc_A, gyr_A or mag_A; was it saved from magcal or accelcal?"
        )
    return Page(sensors, *texts.about(notes))


def _sole_kind(variables: dict[str, Any], kinds: tuple[Kind, ...], name: str) -> Kind:
    if len(kinds) == 1:
        return kinds[0]
    if "expmfs" in variables:
        return "mag"
    raise InputError(
        f"{name}: A and b without expmfs may be magcal's or accelcal's; give --sensors mag or --sensors acc"
    )


def _write_script(page: Page) -> bytes:
    out = texts.comment(texts.heading(page), "%")
    out += "% magnetometer: (D - mag_b) * mag_A; others: D * acc_A + acc_b; readings are rows\n"
    for name, value in _variables(page).items():
        rows = [texts.row(r, texts.number, ", ") for r in np.atleast_2d(value)]
        out += f"{name} = [" + (";\n    ").join(rows) + "];\n"
    return out.encode()


_ASSIGNMENT = re.compile(r"^[ \t]*([A-Za-z]\w{0,60})[ \t]*=[ \t]*(\[[^\]]{0,4000}\]|[-+.\deE]{1,40})", re.MULTILINE)


def _read_script(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    text = texts.decode(data, name)
    code = re.sub(r"\.\.\.[^\n]*\n", " ", re.sub(r"%[^\n]*", "", text))
    variables: dict[str, Any] = {}
    for m in _ASSIGNMENT.finditer(code):
        rows = [r for r in re.split(r"[;\n]", m[2].strip("[]")) if r.strip()]
        try:
            matrix = np.array([[float(v) for v in re.split(r"[,\s]+", r.strip()) if v] for r in rows])
        except ValueError:
            continue  # an expression, which is not for us to evaluate
        variables[m[1]] = matrix
    return _page(variables, text, name, kinds)


MAT = Target("matlab", "MATLAB .mat file", ".mat", FORMS, _write_mat, _read_mat, 1e-12, FACTS, binary=True)
SCRIPT = Target("matlab-text", "MATLAB script", ".m", FORMS, _write_script, _read_script, 1e-12, FACTS)
