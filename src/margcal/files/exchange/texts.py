"""What text formats share: remarks as comments, test vectors, numbers that read back, and reading them again."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.checking import printable
from margcal.core.errors import InputError
from margcal.core.types import Array
from margcal.core.units import KINDS, Kind
from margcal.files.calfile import _plain as parse_json
from margcal.files.exchange.target import Page, Sensor, plain

NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
_UNITS = re.compile(r"margcal units: (acc|gyr|mag) takes ([\w^.-]{1,40}) gives ([\w^.-]{1,40})")


def decode(data: bytes, name: str) -> str:
    """`data` as text.

    Raises
    ------
    InputError
        If it is not UTF-8.
    """
    try:
        return data.removeprefix(b"\xef\xbb\xbf").decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{name}: is not UTF-8 text at byte {error.start}; this is another kind of file") from error


def number(x: float) -> str:
    """`x` in the fewest digits that read back to the same float64."""
    return repr(float(x))


def short(x: float) -> str:
    """`x` in nine digits, which read back to the same float32."""
    return f"{float(x):.9g}"


def row(values: ArrayLike, form: Any = number, between: str = ", ") -> str:
    return between.join(form(v) for v in np.asarray(values, dtype=np.float64).ravel())


def unit_name(unit: str | None) -> str:
    """`unit` as it stands in the unit line of a file: one word."""
    return re.sub(r"[^\w^.-]", "_", plain(unit or "unknown", 40))


def heading(page: Page) -> list[str]:
    """The lines with which every text file of ours begins, without comment marks."""
    lines = [f"margcal: calibration of {plain(page.device or 'a node', 80)}; frame: {plain(page.frame or '-', 40)}"]
    for kind, sensor in page.sensors.items():
        lines.append(
            f"margcal units: {kind} takes {unit_name(sensor.raw_unit)} gives {unit_name(sensor.unit)}",
        )
    return lines + [plain(r, 400) for r in page.remarks]


def vector_lines(page: Page) -> list[str]:
    """The test vectors as lines, without comment marks."""
    lines = []
    for kind, sensor in page.sensors.items():
        if sensor.vectors is None:
            continue
        lines.append(f"test vectors, {kind}: three raw readings, then what this file makes of them")
        lines += [f"  {row(y, number, ' ')} : {row(u, short, ' ')}" for y, u in zip(*sensor.vectors)]
    return lines


def comment(lines: Iterable[str], mark: str) -> str:
    return "".join(f"{mark} {line}".rstrip() + "\n" for line in lines)


_VECTORS = re.compile(rf"[ *#%]*((?:{NUMBER} ){{2}}{NUMBER}) : ((?:{NUMBER} ){{2}}{NUMBER})\s*$")


def units_in(text: str) -> dict[Kind, tuple[str, str]]:
    """Raw and calibrated unit of each sensor from the unit lines of a file of ours; empty for others."""
    return {k: (m[2], m[3]) for m in _UNITS.finditer(text) for k in KINDS if m[1] == k}


def announced(text: str) -> list[Kind]:
    """The sensors that the unit lines of a file of ours name; a name or remark within a line is none."""
    found = re.findall(r"^[ *#%/]{0,8}margcal units: (acc|gyr|mag) takes", text, re.MULTILINE)
    return [k for k in KINDS if k in found]


def vectors_in(text: str) -> dict[Kind, tuple[Array, Array]]:
    """Test vectors from the comments of a file of ours."""
    found: dict[Kind, list[tuple[list[float], list[float]]]] = {}
    kind: Kind | None = None
    for line in text.splitlines():
        if m := re.search(r"test vectors, (acc|gyr|mag):", line):
            kind = next(k for k in KINDS if k == m[1])
        elif kind and len(line) < 300 and (m := _VECTORS.match(line)):
            found.setdefault(kind, []).append(([float(v) for v in m[1].split()], [float(v) for v in m[2].split()]))
    return {k: (np.array([y for y, _ in v]), np.array([u for _, u in v])) for k, v in found.items()}


def page_of(fields: Mapping[Kind, Mapping[str, Any]], text: str, dropped: Mapping[Kind, str] | None = None) -> Page:
    """A page of `fields`, with units and vectors from the comments in `text` where they are ours."""
    units, vectors = units_in(text), vectors_in(text)
    sensors: dict[Kind, Sensor] = {
        k: Sensor(f, *units.get(k, (None, None)), vectors=vectors.get(k), dropped=(dropped or {}).get(k, ""))
        for k, f in fields.items()
    }
    return Page(sensors, *about(text))


def about(text: str) -> tuple[str | None, str | None]:
    """Device and frame from the first line of a file of ours; None in others."""
    hit = re.search(r"margcal: calibration of (.{1,80}?); frame: (.{1,80}?)[ \t]*$", text, re.MULTILINE)
    return (hit[1], hit[2]) if hit else (None, None)


def array(value: Any, shape: tuple[int, ...], what: str, name: str) -> Array:
    """`value` from a file as finite numbers of `shape`.

    Raises
    ------
    InputError
    """
    try:
        found = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        found = np.empty(0)
    if found.shape != shape or not np.isfinite(found).all():
        wanted = " x ".join(map(str, shape))
        raise InputError(f"{name}: {printable(what, 60)} is not {wanted} finite numbers")
    return found


def numbers_after(text: str, label: str, count: int, what: str, name: str) -> Array:
    """The `count` numbers that follow `label` (a regular expression) in `text`."""
    hit = re.search(label, text)
    if not hit:
        raise InputError(f"{name}: {what} is not there; is this the right --from?")
    found = re.findall(rf"(?<![\w.]){NUMBER}", text[hit.end() : hit.end() + 4000])[:count]
    if len(found) < count:
        raise InputError(f"{name}: {what} has {len(found)} numbers; expected {count}")
    return array([float(v) for v in found], (count,), what, name)


def json_object(data: bytes, name: str) -> dict[str, Any]:
    """The JSON object in `data`; duplicate keys, NaN and nesting without end are refused."""
    try:
        value = parse_json(data.removeprefix(b"\xef\xbb\xbf"), name)
    except RecursionError as error:
        raise InputError(f"{name}: is nested too deeply; this is no calibration") from error
    if not isinstance(value, dict):
        raise InputError(f"{name}: holds no JSON object")
    return value


def json_bytes(value: Any) -> bytes:
    """JSON with a key a line and lists of numbers on one line."""
    text = json.dumps(value, indent=1, ensure_ascii=True)
    flat = re.sub(r"\[\n\s+([^\[\]{}\"]*?)\n\s+\]", lambda m: "[" + re.sub(r"\s*\n\s*", " ", m[1]) + "]", text)
    return (flat + "\n").encode()


def json_about(page: Page) -> dict[str, Any]:
    """What a JSON file says beside the calibration: whose it is, units, remarks, test vectors."""
    said: dict[str, Any] = {"device": page.device, "frame": page.frame, "remarks": list(page.remarks)}
    said["units"] = {k: {"raw": s.raw_unit, "calibrated": s.unit} for k, s in page.sensors.items()}
    said["test_vectors"] = {
        k: {"raw": s.vectors[0].tolist(), "calibrated": s.vectors[1].tolist()}
        for k, s in page.sensors.items()
        if s.vectors is not None
    }
    return said


def json_page(fields: Mapping[Kind, Mapping[str, Any]], given: Any, dropped: Mapping[Kind, str] | None = None) -> Page:
    """A page of `fields` with what `json_about` wrote, as far as it is there and in order."""
    said = given if isinstance(given, dict) else {}
    units, tests = _object(said, "units"), _object(said, "test_vectors")
    sensors: dict[Kind, Sensor] = {}
    for kind, f in fields.items():
        pair = _object(units, kind)
        raw, unit = (pair.get(k) if isinstance(pair.get(k), str) else None for k in ("raw", "calibrated"))
        sensors[kind] = Sensor(f, raw, unit, _json_vectors(tests.get(kind)), (dropped or {}).get(kind, ""))
    device, frame = (said.get(k) if isinstance(said.get(k), str) else None for k in ("device", "frame"))
    return Page(sensors, device, frame)


def _object(value: dict[str, Any], key: str) -> dict[str, Any]:
    found = value.get(key)
    return found if isinstance(found, dict) else {}


def _json_vectors(value: Any) -> tuple[Array, Array] | None:
    try:
        raw, out = (np.asarray(value[k], dtype=np.float64) for k in ("raw", "calibrated"))
    except (TypeError, KeyError, ValueError):
        return None
    return (raw, out) if raw.ndim == 2 and raw.shape == out.shape and raw.shape[1] == 3 else None
