"""The calibration file: JSON, versioned, validated on load with the place of every fault, the same bytes every time.

`structs` mirrors the calibration file of the conventions key by key; the JSON Schema beside this file is made
from it (`schema`).
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, fields
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from margcal.core.checking import printable
from margcal.core.errors import InputError
from margcal.core.types import Alignment, Array, Calibration, Issue, SensorModel
from margcal.core.units import KINDS

FORMAT = "margcal-calibration"
VERSION = 1
MAX_BYTES = 20_000_000
WORST_CONDITION = 20.0
"""Condition number of H above which no sensor was ever healthy: one axis hardly reads, or two are one."""
LARGEST = 1e60
"""No sensor's H, its inverse, or the vector that it senses is larger in any unit; beyond, squares overflow."""

_TRANSFORMS = ("offset_s", "drift_ppm", "marker_to_node", "lab_to_earth", "lever_arm_m")
_ALIGNMENT = (*_TRANSFORMS, *(f"{name}_se" for name in _TRANSFORMS))


@cache
def structs() -> Any:
    """The msgspec struct of a whole calibration file."""
    import msgspec
    from msgspec import Meta, defstruct

    def struct(name: str, keys: list[Any]) -> Any:
        return defstruct(name, keys, forbid_unknown_fields=True)

    vector = tuple[float, float, float]
    matrix = tuple[vector, vector, vector]
    row12: Any = Annotated[list[float], Meta(min_length=12, max_length=12)]
    matrix12: Any = Annotated[list[row12], Meta(min_length=12, max_length=12)]
    quaternion = tuple[float, float, float, float]
    positive: Any = Annotated[float, Meta(ge=0)]
    count: Any = Annotated[int, Meta(ge=0)]

    def sensor(name: str, unit: Any) -> Any:
        return struct(
            name,
            [
                ("H", matrix),
                ("B", vector),
                ("raw_unit", Annotated[str, Meta(min_length=1, max_length=40)]),
                ("unit", unit),
                ("covariance", matrix12 | None, None),
                ("residual_rms", positive | None, None),
                ("n_poses", count | None, None),
                ("method", str, ""),
                ("reference_vector", vector | None, None),
                ("expected_error_deg", positive | None, None),
                ("delay_s", float | None, None),
                ("delay_se_s", positive | None, None),
                ("temperature_degC", float | None, None),
            ],
        )

    issue = struct(
        "Issue",
        [
            ("code", str),
            ("level", Literal["note", "warn", "fail"]),
            ("sensor", Literal["acc", "gyr", "mag"] | None, None),
            ("text", str, ""),
            ("value", float | None, None),
            ("limit", float | None, None),
        ],
    )
    alignment = struct(
        "Alignment",
        [
            ("common_clock", bool),
            ("offset_s", float | None, None),
            ("drift_ppm", float | None, None),
            ("marker_to_node", quaternion | None, None),
            ("lab_to_earth", quaternion | None, None),
            ("lever_arm_m", vector | None, None),
            ("offset_s_se", positive | None, None),
            ("drift_ppm_se", positive | None, None),
            ("marker_to_node_se", vector | None, None),
            ("lab_to_earth_se", vector | None, None),
            ("lever_arm_m_se", vector | None, None),
        ],
    )
    file = struct("File", [("name", str), ("sha256", Annotated[str, Meta(pattern="^([0-9a-f]{64})?$")])])
    source = struct(
        "Source",
        [
            ("created", str | None, None),
            ("program", str | None, None),
            ("files", list[file], []),
            ("settings", dict[str, Any], {}),
        ],
    )
    absent = msgspec.UNSET
    optional = msgspec.UnsetType
    return struct(
        "CalibrationFile",
        [
            ("format", Literal["margcal-calibration"]),
            ("version", Literal[1]),
            ("device", str | None, None),
            ("frame", Annotated[str, Meta(min_length=1)], "housing"),
            ("verdict", Literal["pass", "warn", "fail"] | None, None),
            ("issues", list[issue], []),
            ("acc", sensor("Accelerometer", Literal["m/s^2"]) | optional, absent),
            ("gyr", sensor("Gyroscope", Literal["rad/s"]) | optional, absent),
            ("mag", sensor("Magnetometer", Literal["uT", "norm"]) | optional, absent),
            ("alignment", alignment | None, None),
            ("source", source, msgspec.field(default_factory=source)),
        ],
    )


def schema() -> bytes:
    """The JSON Schema (draft 2020-12) of a calibration file, as shipped in ``calibration.schema.json``."""
    import msgspec

    text = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "margcal calibration file"}
    return (json.dumps(text | msgspec.json.schema(structs()), indent=2) + "\n").encode()


def load(path: str | os.PathLike[str]) -> Calibration:
    """The calibration in the file `path`.

    Raises
    ------
    InputError
        The file cannot be read, or as `loads`.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError as error:
        raise InputError(f"{printable(path)}: there is no such file") from error
    except OSError as error:
        raise InputError(f"{printable(path)}: cannot be read ({error.strerror})") from error
    return loads(data, printable(Path(path).name))


def loads(data: bytes, name: str = "calibration") -> Calibration:
    """The calibration in `data`; messages call it `name`.

    Raises
    ------
    InputError
        Not JSON, another format or version, duplicate or unknown keys, numbers that are not finite, wrong
        shapes, H singular or with a condition number above 20, a covariance that is none.
    """
    import msgspec

    if len(data) > MAX_BYTES:
        raise InputError(f"{name}: is larger than {MAX_BYTES // 1_000_000} MB; this is no calibration file")
    data = data.removeprefix(b"\xef\xbb\xbf")
    try:
        plain = _plain(data, name)
        _check_version(plain, name)
        file = msgspec.convert(plain, structs(), strict=True)
    except RecursionError as error:
        raise InputError(f"{name}: is nested too deeply; this is no calibration file") from error
    except msgspec.ValidationError as error:
        raise InputError(f"{name}: {_in_words(str(error))}") from error
    return _calibration(file, name)


def _plain(data: bytes, name: str) -> Any:
    """`data` as plain Python values; what is no JSON, or JSON that two readers would read differently, is refused."""

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [k for k, _ in pairs]
        twice = next((k for k in keys if keys.count(k) > 1), None) if len(set(keys)) < len(keys) else None
        if twice is not None:
            raise InputError(f"{name}: the key {printable(twice)!r} is there twice in one object; remove one")
        return dict(pairs)

    def refuse(word: str) -> float:
        raise InputError(f"{name}: {word} is not a number that JSON knows; a calibration holds finite numbers")

    def finite(text: str) -> float:
        value = float(text)
        if not math.isfinite(value):
            raise InputError(f"{name}: the number {printable(text, 30)} is too large")
        return value

    def whole(text: str) -> int | float:
        if len(text) > 300:
            raise InputError(f"{name}: a number of {len(text)} digits ({text[:10]}...); this is no calibration")
        return int(text)

    try:
        text = data.decode("utf-8")
        plain = json.loads(text, object_pairs_hook=unique, parse_constant=refuse, parse_float=finite, parse_int=whole)
        if "\\u" in text:
            json.dumps(plain, ensure_ascii=False).encode()
        return plain
    except UnicodeEncodeError as error:
        raise InputError(
            f"{name}: holds half a character (\\u{ord(error.object[error.start]):04x}), which is no text; "
            "write it whole"
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(f"{name}: is not UTF-8 text at byte {error.start}; this is no JSON file") from error
    except json.JSONDecodeError as error:
        raise InputError(
            f"{name}: is not JSON at line {error.lineno}, column {error.colno}: {error.msg.lower()}"
        ) from error


def _check_version(plain: Any, name: str) -> None:
    found = plain.get("format") if isinstance(plain, dict) else None
    if found != FORMAT:
        shown = f"its format is {printable(found)!r}" if found is not None else 'it has no "format"'
        raise InputError(f'{name}: is no margcal calibration file: {shown}; expected "format": "{FORMAT}"')
    version = plain.get("version")
    if isinstance(version, int) and not isinstance(version, bool) and version > VERSION:
        raise InputError(
            f"{name}: is of version {version}, this margcal reads up to version {VERSION}; it needs a newer margcal"
        )
    if version != VERSION or isinstance(version, bool) or not isinstance(version, int):
        raise InputError(f"{name}: version {printable(version)!r} is not known; expected {VERSION} - at `$.version`")


def _in_words(message: str) -> str:
    """msgspec's message with the mend for what people do most."""
    if missing := re.search(r"missing required field `(\w+)`", message):
        return f"{message}; add the key {missing[1]!r}"
    if unknown := re.search(r"unknown field `(.*?)`", message):
        return f"{printable(message)}; remove the key {printable(unknown[1])!r} or correct its spelling"
    return printable(message)


def _calibration(file: Any, name: str) -> Calibration:
    import msgspec

    models = {}
    for kind in KINDS:
        sensor = getattr(file, kind)
        if sensor is msgspec.UNSET:
            continue
        values = {f: getattr(sensor, f) for f in sensor.__struct_fields__}
        models[kind] = SensorModel(kind=kind, **values)  # type: ignore[arg-type]
        check_model(models[kind], name)
    alignment = None
    if file.alignment is not None:
        values = {f: getattr(file.alignment, f) for f in file.alignment.__struct_fields__}
        alignment = Alignment(values.pop("common_clock"), {k: v for k, v in values.items() if v is not None})
    return Calibration(
        **models,
        device=file.device,
        frame=file.frame,
        verdict=file.verdict,
        issues=tuple(Issue(**{f: getattr(i, f) for f in i.__struct_fields__}) for i in file.issues),
        alignment=alignment,
        created=file.source.created,
        program=file.source.program,
        files=tuple((f.name, f.sha256) for f in file.source.files),
        settings=file.source.settings,
    )


def check_model(model: SensorModel, name: str) -> None:
    """Refuse a model that cannot be a sensor's: H singular or nearly so, a covariance that is none.

    Raises
    ------
    InputError
        With the JSON path.
    """
    where = f"$.{model.kind}"
    if model.H.shape != (3, 3) or model.B.shape != (3,):
        raise InputError(f"{name}: H is {model.H.shape} and B {model.B.shape}; a file holds one node - at `{where}`")
    for field in ("H", "B", "covariance", "reference_vector"):
        value = getattr(model, field)
        if value is not None and not np.isfinite(value).all():
            raise InputError(f"{name}: {field} holds values that are not finite - at `{where}.{field}`")
    largest, _, smallest = np.linalg.svd(model.H, compute_uv=False)
    if largest > LARGEST or 0 < largest < 1 / LARGEST:
        raise InputError(f"{name}: H is of size {largest:.3g}, which is no sensor's in any unit - at `{where}.H`")
    if smallest <= 1e-14 * largest:
        raise InputError(f"{name}: H is singular: it maps all readings into a plane - at `{where}.H`")
    if largest > WORST_CONDITION * smallest:
        raise InputError(
            f"{name}: H has condition number {largest / smallest:.3g}, more than {WORST_CONDITION:g}: one axis hardly "
            f"reads, or two axes are nearly one; calibrate again - at `{where}.H`"
        )
    vector = model.reference_vector
    if vector is not None and np.abs(vector).max() > LARGEST:
        raise InputError(f"{name}: is larger than any field or gravity - at `{where}.reference_vector`")
    if model.covariance is not None and (fault := _covariance_fault(model.covariance)):
        raise InputError(f"{name}: covariance {fault} - at `{where}.covariance`")


def _covariance_fault(P: Array) -> str | None:
    """Why the matrix is no covariance, judged free of units (as correlations); None if it is one."""
    variance = np.diag(P)
    if np.abs(P).max() > LARGEST**2:
        return "holds values that are too large for one"
    if (variance < 0).any():
        return f"has a negative variance in row {int(np.argmin(variance)) + 1}"
    sd = np.sqrt(variance)
    scale = np.where(sd > 0, sd, 1.0)
    with np.errstate(over="ignore"):
        correlation = P / scale[:, None] / scale
    if not np.isfinite(correlation).all():
        return "is not positive semidefinite"
    if (correlation[sd == 0] != 0).any():
        return "has a variance of zero with covariances that are not"
    if np.abs(correlation - correlation.T).max() > 1e-6:
        return "is not symmetric"
    if np.linalg.eigvalsh(correlation).min() < -1e-6:
        return "is not positive semidefinite"
    return None


def dumps(calibration: Calibration) -> bytes:
    """The calibration file: same calibration, same bytes (see `source.created`), numbers that read back exactly.

    Raises
    ------
    InputError
        What `loads` would refuse.
    """
    for model in calibration.models.values():
        check_model(model, "calibration")
    return (_json(_document(calibration), 0) + "\n").encode(errors="replace")


def save(calibration: Calibration, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write the calibration file, whole or not at all.

    Raises
    ------
    InputError
        The file exists (without `overwrite`) or cannot be written.
    """
    from margcal.files.atomic import atomic_path

    data = dumps(calibration)
    with atomic_path(path, overwrite=overwrite) as temporary:
        temporary.write_bytes(data)


def digests(paths: Iterable[str | os.PathLike[str]]) -> tuple[tuple[str, str], ...]:
    """(name, SHA-256) of each file, for `Calibration.files`."""
    found = []
    for path in paths:
        with open(path, "rb") as file:
            found.append((Path(path).name, hashlib.file_digest(file, "sha256").hexdigest()))
    return tuple(found)


def created_now() -> str:
    """UTC time in ISO 8601, to the second; SOURCE_DATE_EPOCH is honoured."""
    from datetime import UTC, datetime

    epoch = os.environ.get("SOURCE_DATE_EPOCH", "")
    moment = datetime.fromtimestamp(int(epoch), UTC) if epoch.isdigit() else datetime.now(UTC)
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


def program_now() -> str:
    """``margcal x.y.z``."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return f"margcal {version('margcal')}"
    except PackageNotFoundError:
        return "margcal"


def _document(calibration: Calibration) -> dict[str, Any]:
    """The file as plain values, keys in the order of the conventions."""
    issue_order = ("code", "level", "sensor", "text", "value", "limit")
    document: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "device": calibration.device,
        "frame": calibration.frame,
        "verdict": calibration.verdict,
        "issues": [{k: asdict(i)[k] for k in issue_order} for i in calibration.issues],
    }
    for kind, model in calibration.models.items():
        names = [f.name for f in fields(SensorModel) if f.name != "kind"]  # in the order of the file
        document[kind] = {name: getattr(model, name) for name in names}
    document["alignment"] = _alignment(calibration.alignment)
    document["source"] = {
        "created": calibration.created or created_now(),
        "program": calibration.program or program_now(),
        "files": [{"name": n, "sha256": d} for n, d in calibration.files],
        "settings": dict(calibration.settings),
    }
    return document


def _alignment(alignment: Alignment | None) -> dict[str, Any] | None:
    if alignment is None:
        return None
    values = dict(alignment.values)
    known = {name: values.pop(name) for name in _ALIGNMENT if name in values}  # one order, whatever the caller's
    return {"common_clock": alignment.common_clock, **known, **values}


def _json(value: Any, depth: int) -> str:
    """JSON of `value`: objects a key a line, arrays of plain values on one line."""
    pad = "  " * (depth + 1)
    if isinstance(value, Mapping):
        items = [f"{pad}{json.dumps(str(k))}: {_json(v, depth + 1)}" for k, v in value.items()]
        return "{\n" + ",\n".join(items) + "\n" + "  " * depth + "}" if items else "{}"
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        items = [_json(v, depth + 1) for v in value]
        if not any(isinstance(v, (list, tuple, Mapping, np.ndarray)) for v in value):
            return "[" + ", ".join(items) + "]"
        return "[\n" + ",\n".join(pad + i for i in items) + "\n" + "  " * depth + "]"
    return _scalar(value)


def _scalar(value: Any) -> str:
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"calibration: a value is {value}; a calibration file holds finite numbers")
    if value is None or isinstance(value, (bool, int, float, str)):
        return json.dumps(value, ensure_ascii=False)
    return json.dumps(str(value), ensure_ascii=False)
