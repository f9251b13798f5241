"""imucal (Python), Ferraris calibration, as JSON and as HDF5.

Form        acc = R_a^-1 K_a^-1 (y - b_a); gyr = R_g^-1 K_g^-1 (y - K_ga acc - b_g)
Fields      K_a, R_a, b_a, K_g, R_g, b_g, K_ga, acc_unit, gyr_unit, from_acc_unit, from_gyr_unit, comment, cal_type,
            _format_version "2.0.0"; K = H^-1, R = identity, K_ga = 0
Carries     all of H and B of accelerometer and gyroscope, which it needs both; no magnetometer, no covariance
Units       accelerometer m/s^2, gyroscope deg/s; raw: the unit that is named in from_..._unit

From       imucal 2.6, calibration_info.py and ferraris_calibration_info.py; the tests calibrate with the package.
           A K_ga that is not zero has no place in a margcal file: it is kept in the settings and named.
"""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import InputError
from margcal.core.types import Array
from margcal.core.units import Kind
from margcal.files.exchange import texts
from margcal.files.exchange.target import Fields, Form, Page, Sensor, Target

FACTS = "imucal 2.6 itself"
_UNITS = {"m/s^2": "mps2", "m/s2": "mps2", "g": "g", "mg": "mg", "deg/s": "dps", "dps": "dps", "rad/s": "radps"}
_NAMES = {"mps2": "m/s^2", "dps": "deg/s", "radps": "rad/s"}


def _encode(H: Array, B: Array, R: Array) -> Fields:
    return {"K": np.linalg.inv(H), "R": np.eye(3), "b": np.array(B)}


def _decode(fields: Fields) -> tuple[Array, Array]:
    return np.linalg.inv(fields["K"] @ fields["R"]), fields["b"]


def _apply(fields: Fields, y: ArrayLike) -> Array:
    unscaled = np.linalg.inv(fields["R"]) @ np.linalg.inv(fields["K"])
    return (np.asarray(y) - fields["b"]) @ unscaled.T


FORMS: dict[Kind, Form] = {
    "acc": Form("R_a^-1 K_a^-1 (y - b_a)", _encode, _decode, _apply, unit="mps2"),
    "gyr": Form("R_g^-1 K_g^-1 (y - K_ga acc - b_g)", _encode, _decode, _apply, unit="dps"),
}


def _document(page: Page) -> dict[str, Any]:
    acc, gyr = page.sensors["acc"], page.sensors["gyr"]
    about = json.dumps(texts.json_about(page))
    return {
        "acc_unit": "m/s^2",
        "gyr_unit": "deg/s",
        "from_acc_unit": _NAMES.get(str(acc.raw_unit), acc.raw_unit),
        "from_gyr_unit": _NAMES.get(str(gyr.raw_unit), gyr.raw_unit),
        "comment": f"margcal {about}",
        **{f"{k}_a": acc.fields[k] for k in ("K", "R", "b")},
        **{f"{k}_g": gyr.fields[k] for k in ("K", "R", "b")},
        "K_ga": np.zeros((3, 3)),
        "cal_type": "Ferraris",
        "_format_version": "2.0.0",
    }


def _write_json(page: Page) -> bytes:
    return texts.json_bytes({k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in _document(page).items()})


def _page(document: dict[str, Any], name: str) -> Page:
    kind_of = document.get("cal_type")
    if kind_of not in ("Ferraris", "Turntable"):
        raise InputError(f"{name}: its cal_type is {str(kind_of)[:30]!r}; expected Ferraris or Turntable of imucal")
    if str(document.get("_format_version")) != "2.0.0":
        raise InputError(f"{name}: is of imucal's format {str(document.get('_format_version'))[:20]!r}; expected 2.0.0")
    found: dict[Kind, Fields] = {}
    for kind, letter in (("acc", "a"), ("gyr", "g")):
        found[kind] = {  # type: ignore[index]
            k: texts.array(document.get(f"{k}_{letter}"), shape, f"{k}_{letter}", name)
            for k, shape in (("K", (3, 3)), ("R", (3, 3)), ("b", (3,)))
        }
        for k in ("K", "R"):
            if np.linalg.cond(found[kind][k]) > 1e6:  # type: ignore[index]
                raise InputError(f"{name}: {k}_{letter} is singular")
    dropped: dict[Kind, str] = {}
    K_ga = texts.array(document.get("K_ga"), (3, 3), "K_ga", name)
    if K_ga.any():
        size = texts.short(float(np.abs(K_ga).max()))
        dropped["gyr"] = f"K_ga (what acceleration does to the gyroscope, up to {size}) has no place in a margcal file"
    return _with_units(texts.json_page(found, _about(document.get("comment")), dropped), document)


def _about(comment: Any) -> Any:
    if not isinstance(comment, str) or not comment.startswith("margcal {"):
        return None
    try:
        return json.loads(comment[len("margcal ") :])
    except (ValueError, RecursionError):
        return None


def _with_units(page: Page, document: dict[str, Any]) -> Page:
    sensors: dict[Kind, Sensor] = {}
    for kind, sensor in page.sensors.items():
        raw, unit = (document.get(f"{p}{kind}_unit") for p in ("from_", ""))
        raw = _UNITS.get(str(raw), str(raw)) if raw else None
        sensors[kind] = Sensor(sensor.fields, raw, _UNITS.get(str(unit), str(unit)), sensor.vectors, sensor.dropped)
    return Page(sensors, page.device, page.frame)


def _read_json(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    return _page(texts.json_object(data, name), name)


def _h5py() -> Any:
    try:
        import h5py
    except ImportError as error:
        raise InputError('HDF5 files need h5py: pip install "margcal[io]", or take JSON (imucal)') from error
    return h5py


def _write_hdf5(page: Page) -> bytes:
    buffer = io.BytesIO()
    with _h5py().File(buffer, "w") as file:
        for key, value in _document(page).items():
            file[key] = value
    return buffer.getvalue()


def _read_hdf5(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    document: dict[str, Any] = {}
    h5py = _h5py()
    try:
        with h5py.File(io.BytesIO(data), "r") as file:
            for key in file:
                item = file.get(key, getclass=True, getlink=False)
                if item is not h5py.Dataset or not isinstance(file.get(key, getlink=True), h5py.HardLink):
                    continue  # links into other files are not followed
                dataset = file[key]
                if h5py.check_string_dtype(dataset.dtype) is not None and dataset.shape == ():
                    document[key] = dataset.asstr()[()]
                elif dataset.size is not None and dataset.size <= 9 and dataset.dtype.kind == "f":
                    document[key] = dataset[()].tolist()
    except InputError:
        raise
    except Exception as error:  # the library raises whatever a damaged file makes it run into
        raise InputError(f"{name}: is no HDF5 file that can be read ({type(error).__name__})") from error
    return _page(document, name)


JSON = Target(
    "imucal",
    "imucal, JSON",
    ".json",
    FORMS,
    _write_json,
    _read_json,
    1e-12,
    FACTS,
    required=("acc", "gyr"),
    remark="imucal.CalibrationInfo.from_json_file(FILE).calibrate(acc, gyr, raw unit, raw unit)",
)
HDF5 = Target(
    "imucal-hdf5",
    "imucal, HDF5",
    ".h5",
    FORMS,
    _write_hdf5,
    _read_hdf5,
    1e-12,
    FACTS,
    required=("acc", "gyr"),
    binary=True,
    remark="imucal.CalibrationInfo.from_hdf5(FILE)",
)
