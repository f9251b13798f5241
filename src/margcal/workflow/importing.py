"""A calibration from another program's file.

Its numbers become ``u = H (y - B)`` in SI units; what the file does not say (which sensor, raw unit, calibrated unit)
must be told, what it does not hold is absent. Nothing is known of how good the numbers are: no covariance, no verdict.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from margcal.core.checking import printable
from margcal.core.errors import DataError, InputError, UsageError
from margcal.core.types import Array, Calibration, Issue, SensorModel
from margcal.core.units import KINDS, SI_COLUMN, SI_UNIT, UNITS, Kind
from margcal.files.calfile import check_model
from margcal.files.exchange import texts
from margcal.files.exchange.registry import find
from margcal.files.exchange.target import MAX_BYTES, Form, Page, Sensor, Target

VECTORS_AGREE = 1e-6
"""Relative error of test vectors: digits and float32 make 1e-7, a changed number far more."""
UNKNOWN_FRAME = "unknown"
_UNIT_NAMES = {"m/s^2": "mps2", "m/s2": "mps2", "rad/s": "radps", "deg/s": "dps", "G": "gauss"}


def import_calibration(
    data: bytes,
    name: str,
    source: Target | str,
    *,
    sensors: Sequence[Kind] = (),
    units: Mapping[str, str] | None = None,
    unit: Mapping[str, str] | None = None,
    scale: Mapping[str, float] | None = None,
    device: str | None = None,
    frame: str | None = None,
) -> Calibration:
    """The calibration in `data`, a file of the kind `source`.

    Parameters
    ----------
    data, name : bytes, str
        The file, and what messages call it.
    source : Target or str
        A name in `files.exchange.registry.TARGETS`.
    sensors : kinds
        Which sensor the file is of, where it does not say; otherwise only these are taken.
    units : mapping of kind to unit
        Of the raw readings, where the file does not say.
    unit : mapping of kind to unit
        Of the calibrated vector, where the file does not say.
    scale : mapping of kind to float
        SI units (uT) a count: what the other program's driver multiplied counts by. The calibration then takes counts.

    Raises
    ------
    InputError
        The file cannot be understood, or does not say what must be told.
    DataError
        A sensor that was asked for is not in it.
    """
    source = find(source) if isinstance(source, str) else source
    if len(data) > MAX_BYTES:
        raise InputError(f"{name}: is larger than {MAX_BYTES // 1000} kB; this is no calibration")
    for option, given in (("--units", units), ("--unit", unit), ("--scale", scale)):
        if wrong := [k for k in given or () if k not in KINDS]:
            raise UsageError(f"{option}: {printable(wrong[0], 40)!r} is no sensor; acc, gyr and mag are")
    page = source.read(data, name, tuple(sensors))
    if absent := [k for k in sensors if k not in page.sensors]:
        raise DataError(f"{name}: {absent[0]} is not in it; it holds {', '.join(page.sensors)}")
    cut = [k for k in texts.announced(data.decode("utf-8", "replace")) if k not in page.sensors]
    if cut and not sensors:
        raise InputError(
            f"{name}: names {cut[0]} but does not hold its numbers: it was cut or damaged; export it again, or, "
            f"if you took it out yourself, give --sensors {','.join(page.sensors)}"
        )
    models, issues = {}, []
    for kind in KINDS:
        sensor = page.sensors.get(kind)
        if sensor is None or (sensors and kind not in sensors):
            continue
        told = {k: (v or {}).get(kind) for k, v in (("raw", units), ("unit", unit), ("scale", scale))}
        models[kind] = _model(kind, sensor, source.forms[kind], told, name, source.name)
        issues += _issues(kind, sensor, source)
    along_raw_axes = any(source.forms[k].nominal for k in models)
    where = frame or (UNKNOWN_FRAME if along_raw_axes else _frame(page))
    if where == UNKNOWN_FRAME:
        text = "the file does not say along which axes it calibrates; name them with --frame if you know"
        issues.append(Issue("frame-unknown", "note", text))
    return Calibration(
        **models,
        device=device if device is not None else page.device,
        frame=where,
        issues=tuple(issues),
        settings={
            "imported_from": source.name,
            "formulas": {k: source.forms[k].formula for k in models},
            "told": {k: dict(v) for k, v in (("units", units), ("unit", unit), ("scale", scale)) if v},
        },
    )


def _frame(page: Page) -> str:
    """The frame that a file of margcal's names; others do not say. A turned one (--move-frame) is turned back."""
    return page.frame.split(",")[0] if page.frame else UNKNOWN_FRAME


def _model(kind: Kind, sensor: Sensor, form: Form, told: Mapping[str, Any], name: str, source: str) -> SensorModel:
    H, B = _decoded(sensor, form, name, kind)
    _check_vectors(sensor, form, name, kind)
    raw = _told_or_said(told["raw"], sensor.raw_unit, f"{name}: {kind}: raw unit", f"--units {kind}=count")
    scale = told["scale"]
    if form.nominal:
        if not scale:
            raise InputError(
                f"{name}: {source} files hold the bias of {kind} only; say the scale, --scale {kind}=... "
                f"({_si_name(kind)} a count)"
            )
        H, unit = H * scale, _si(kind)
    else:
        unit = _told_or_said(
            told["unit"],
            sensor.unit or form.unit or None,
            f"{name}: {kind}: calibrated unit",
            f"--unit {kind}={_si(kind)}",
        )
        if scale:
            factor = UNITS[kind].get(raw)
            if factor is None:
                raise UsageError(
                    f"--scale {kind}: the file's readings are in {printable(raw, 40)} already; leave it out"
                )
            H, B, raw = H * (scale / factor), B * (factor / scale), "count"
    H, final = _to_si(kind, H, unit, name)
    model = SensorModel(kind, H, B, raw_unit=raw[:40], unit=final, method=f"imported ({source})")
    check_model(model, name)
    return model


def _decoded(sensor: Sensor, form: Form, name: str, kind: Kind) -> tuple[Array, Array]:
    try:
        H, B = form.decode(sensor.fields)
    except np.linalg.LinAlgError as error:
        raise InputError(f"{name}: the matrix of {kind} is singular") from error
    if not (np.isfinite(H).all() and np.isfinite(B).all()):
        raise InputError(f"{name}: the numbers of {kind} do not make a calibration (a division by zero)")
    return np.ascontiguousarray(H), np.ascontiguousarray(B)


def _check_vectors(sensor: Sensor, form: Form, name: str, kind: Kind) -> None:
    """Test vectors that a file of margcal's carries must come out of its numbers, or it was cut or changed.

    Raises
    ------
    InputError
    """
    if sensor.vectors is None:
        return
    y, u = sensor.vectors
    with np.errstate(all="ignore"):
        error = np.abs(form.apply(sensor.fields, y) - u).max()
    if not error <= VECTORS_AGREE * np.abs(u).max():
        raise InputError(
            f"{name}: {kind}: its numbers do not give its own test vectors: it was changed or damaged; export it "
            "again, or remove the test vectors if you changed it on purpose"
        )


def _si(kind: Kind) -> str:
    return SI_COLUMN[SI_UNIT[kind]]


def _si_name(kind: Kind) -> str:
    return SI_UNIT[kind]


def _told_or_said(told: str | None, said: str | None, what: str, option: str) -> str:
    told = _UNIT_NAMES.get(told, told) if told else None
    if said is None and told is None:
        raise InputError(f"{what} is not in the file; give {option} or whichever it is")
    if said is not None and told is not None and said != told:
        raise InputError(f"{what} is {printable(said, 40)} according to the file, {printable(told, 40)} as told")
    return str(said if told is None else told)


def _to_si(kind: Kind, H: Array, unit: str, name: str) -> tuple[Array, str]:
    unit = _UNIT_NAMES.get(unit, unit)
    if unit == "norm" and kind == "mag":
        return H, "norm"
    factor = UNITS[kind].get(unit)
    if factor is None:
        known = ", ".join(u for u, f in UNITS[kind].items() if f or u == "norm")
        raise InputError(f"{name}: {kind}: {printable(unit, 40)!r} is no unit of a calibrated vector; expected {known}")
    return H * factor, SI_UNIT[kind]


def _issues(kind: Kind, sensor: Sensor, source: Target) -> list[Issue]:
    found = []
    if sensor.dropped:
        found.append(Issue("term-dropped", "warn", f"{kind}: {sensor.dropped}; it was left out", kind))
    if source.forms[kind].nominal:
        text = f"{kind}: {source.name} files hold the bias only; H is the scale that was told, along the raw axes"
        found.append(Issue("nominal-scale", "warn", text, kind))
    if not source.forms[kind].bias:
        text = f"{kind}: {source.name} files hold no bias; B is zero, calibrate it or have your filter estimate it"
        found.append(Issue("bias-missing", "warn", text, kind))
    return found
