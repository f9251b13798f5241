"""C header and Arduino sketch, floating point. The names are margcal's own (README, "C export").

Form        u = H (y - B), float32: d = y - B, then u_i = (H_i0 d_0 + H_i1 d_1) + H_i2 d_2
Fields      ACC_H[9] row by row, ACC_B[3] (GYR_, MAG_); margcal_acc(y, u)
Carries     all of H and B, in float32
Units       as in the calibration

The order of the sums is the order of the C expression, so that NumPy in float32 gives the same bits wherever the
compiler does not contract products and sums into one operation (gcc: -ffp-contract=off; x86-64 without -march has
none). Where it does, results differ by up to two units in the last place of |H_i0 d_0| + |H_i1 d_1| + |H_i2 d_2|.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import InputError
from margcal.core.types import Array
from margcal.core.units import KINDS, Kind
from margcal.files.exchange import texts
from margcal.files.exchange.target import Fields, Form, Page, Target, identifier, single_precision

FACTS = "margcal's own format"


def literal(x: float) -> str:
    """`x` as a float constant of C: nine digits, a point or an exponent, and ``f``."""
    text = f"{float(x):.9g}"
    return (text if "." in text or "e" in text else text + ".0") + "f"


def _encode(H: Array, B: Array, R: Array) -> Fields:
    return {"H": single_precision(H), "B": single_precision(B)}


def _decode(fields: Fields) -> tuple[Array, Array]:
    return fields["H"], fields["B"]


def apply_float32(fields: Fields, y: ArrayLike) -> Array:
    """What the C function computes, in float32 and in its order of operations; returned as float64."""
    H, B = (np.asarray(fields[k]).astype(np.float32) for k in ("H", "B"))
    d = np.asarray(y, dtype=np.float32) - B
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        u = (H[:, 0] * d[:, :1] + H[:, 1] * d[:, 1:2]) + H[:, 2] * d[:, 2:]
    return u.astype(np.float64)


FORM = Form("H (y - B)", _encode, _decode, apply_float32)
FORMS: dict[Kind, Form] = dict.fromkeys(KINDS, FORM)


def constant(type_: str, name: str, values: ArrayLike, form: Any = literal, per_line: int = 3) -> str:
    """``static const TYPE NAME[n] = {...};`` with `per_line` values a line."""
    cells = [form(v) for v in np.asarray(values).ravel()]
    rows = [", ".join(cells[k : k + per_line]) for k in range(0, len(cells), per_line)]
    body = (",\n" + " " * 4).join(rows)
    return f"static const {type_} {name}[{len(cells)}] = {{\n    {body}}};\n"


def _function(kind: Kind) -> str:
    p = kind.upper()
    sums = [
        f"    u[{i}] = {p}_H[{3 * i}] * d0 + {p}_H[{3 * i + 1}] * d1 + {p}_H[{3 * i + 2}] * d2;\n" for i in range(3)
    ]
    return (
        f"static inline void margcal_{kind}(const float y[3], float u[3])\n{{\n"
        + "".join(f"    const float d{i} = y[{i}] - {p}_B[{i}];\n" for i in range(3))
        + "".join(sums)
        + "}\n"
    )


def _sensor(kind: Kind, fields: Fields) -> str:
    p = kind.upper()
    return constant("float", f"{p}_H", fields["H"]) + constant("float", f"{p}_B", fields["B"]) + "\n" + _function(kind)


def self_test(page: Page, type_out: str, wrong: Callable[[Array], str]) -> str:
    """Test vectors and ``margcal_self_test``, compiled only where MARGCAL_SELF_TEST is defined.

    `wrong`: from the expected values of a sensor (10, 3) the C condition, of ``u[i]`` and ``want``, for a wrong one.
    """
    tests = {k: s.vectors for k, s in page.sensors.items() if s.vectors is not None}
    raw_type = type_out if type_out == "float" else "int32_t"
    out = "\n#ifdef MARGCAL_SELF_TEST\n/* Ten raw readings of each sensor and what they calibrate to. */\n"
    for kind, (y, u) in tests.items():
        form = literal if type_out == "float" else (lambda v: str(round(float(v))))
        out += constant(raw_type, f"{kind.upper()}_TEST_RAW", y, form)
        out += constant(type_out, f"{kind.upper()}_TEST_OUT", u, form)
    out += "\n/* The number of test values that come out wrong: 0 if this file was compiled as it is meant. */\n"
    out += "static inline int margcal_self_test(void)\n{\n    int wrong = 0;\n    int n, i;\n"
    for kind, (_, u) in tests.items():
        p = kind.upper()
        out += f"    for (n = 0; n < 10; n++) {{\n        {type_out} u[3];\n"
        out += f"        margcal_{kind}(&{p}_TEST_RAW[3 * n], u);\n        for (i = 0; i < 3; i++) {{\n"
        out += f"            const {type_out} want = {p}_TEST_OUT[3 * n + i];\n"
        out += f"            wrong += {wrong(u)};\n        }}\n    }}\n"
    return out + "    return wrong;\n}\n#endif\n"


def guard(page: Page) -> str:
    return f"MARGCAL_{identifier(page.device or 'node')}_H"


def block_comment(lines: Sequence[str]) -> str:
    """`lines`, which hold nothing but what `plain` leaves, as one comment."""
    return "/*\n" + "".join(f" * {line}".rstrip() + "\n" for line in lines) + " */\n"


def _off(u: Array) -> str:
    """Off by 1e-5 of the largest value: more than any order of float32 operations makes, far less than a slip."""
    limit = literal(1e-5 * float(np.abs(u).max()))
    return f"(u[i] - want > {limit} || want - u[i] > {limit})"


def _write_header(page: Page) -> bytes:
    lines = [*texts.heading(page), "u = H (y - B), row by row; float32"]
    out = block_comment(lines) + f"#ifndef {guard(page)}\n#define {guard(page)}\n"
    for kind, sensor in page.sensors.items():
        out += "\n" + _sensor(kind, sensor.fields)
    return (out + self_test(page, "float", _off) + "\n#endif\n").encode()


def _write_sketch(page: Page) -> bytes:
    """A sketch that reads raw values from the serial line and prints calibrated ones: paste your sensor's read in."""
    lines = [
        *texts.heading(page),
        "Replace readSensor() by your driver. It must give raw readings in the units named above.",
    ]
    out = block_comment(lines)
    for kind, sensor in page.sensors.items():
        out += "\n" + _sensor(kind, sensor.fields)
    out += "\n/* Raw readings of one instant; returns false if there are none yet. */\n"
    arguments = ", ".join(f"float {k}[3]" for k in page.sensors)
    out += f"static bool readSensor({arguments})\n{{\n"
    for kind in page.sensors:
        out += f"    for (int i = 0; i < 3; i++) {{\n        {kind}[i] = Serial.parseFloat();\n    }}\n"
    out += "    return true;\n}\n\nvoid setup()\n{\n    Serial.begin(115200);\n}\n\nvoid loop()\n{\n"
    out += "".join(f"    float {k}_raw[3], {k}_cal[3];\n" for k in page.sensors)
    out += "    if (Serial.available() == 0 || !readSensor(" + ", ".join(f"{k}_raw" for k in page.sensors) + ")) {\n"
    out += "        return;\n    }\n"
    for kind in page.sensors:
        out += f"    margcal_{kind}({kind}_raw, {kind}_cal);\n"
        out += f"    for (int i = 0; i < 3; i++) {{\n        Serial.print({kind}_cal[i], 6);\n"
        out += "        Serial.print('\\t');\n    }\n"
    out += "    Serial.println();\n}\n\n" + block_comment(texts.vector_lines(page) or ["no test vectors"])
    return out.encode()


_CONSTANT = re.compile(
    r"\b(?:const\s+)?(?:float|double)\s+(ACC|GYR|MAG)_([HB]) {0,9}\[(\d{1,3})\] {0,9}=\s{0,9}\{([^{}]{0,2000})\}"
)


def constants_in(text: str, pattern: re.Pattern[str], name: str) -> dict[Kind, dict[str, Array]]:
    """The H and B constants in C code, by sensor."""
    found: dict[Kind, dict[str, Array]] = {}
    for m in pattern.finditer(text):
        kind: Kind = next(k for k in KINDS if k == m[1].lower())
        count = 9 if m[2] == "H" else 3
        cells = [c.strip().rstrip("fFlL") for c in m[4].split(",") if c.strip()]
        try:
            values = [float(c) for c in cells]
        except ValueError as error:
            raise InputError(f"{name}: {m[1]}_{m[2]} holds something that is no number") from error
        if m[2] in found.get(kind, {}):
            raise InputError(f"{name}: {m[1]}_{m[2]} is there twice")
        array = texts.array(values, (count,), f"{m[1]}_{m[2]}", name)
        found.setdefault(kind, {})[m[2]] = array.reshape(3, 3) if count == 9 else array
    for kind, fields in found.items():
        if missing := {"H", "B"} - set(fields):
            raise InputError(f"{name}: {kind.upper()}_{missing.pop()} is not there")
    if not found:
        raise InputError(f"{name}: holds no ACC_H, GYR_H or MAG_H; expected a header written by margcal export")
    return found


def test_vectors_in(text: str) -> dict[Kind, tuple[Array, Array]]:
    """The constants ACC_TEST_RAW and ACC_TEST_OUT of C code."""
    pattern = re.compile(r"\b(ACC|GYR|MAG)_TEST_(RAW|OUT)\s*\[30\] {0,9}=\s{0,9}\{([^{}]{0,2000})\}")
    found: dict[str, dict[str, Array]] = {}
    for m in pattern.finditer(text):
        values = [float(v) for v in re.findall(texts.NUMBER, m[3])]
        if len(values) == 30:
            found.setdefault(m[1].lower(), {})[m[2]] = np.array(values).reshape(10, 3)
    return {k: (found[k]["RAW"], found[k]["OUT"]) for k in KINDS if len(found.get(k, {})) == 2}


def _read(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
    text = texts.decode(data, name)
    found = constants_in(text, _CONSTANT, name)
    floats: dict[Kind, Fields] = {k: {f: single_precision(v) for f, v in fields.items()} for k, fields in found.items()}
    page = texts.page_of(floats, text)
    return with_vectors(page, test_vectors_in(text))


def with_vectors(page: Page, vectors: dict[Kind, tuple[Array, Array]]) -> Page:
    sensors = {k: replace(s, vectors=vectors.get(k, s.vectors)) for k, s in page.sensors.items()}
    return replace(page, sensors=sensors)


HEADER = Target("c", "C header, float", ".h", FORMS, _write_header, _read, 6e-8, FACTS)
SKETCH = Target(
    "arduino",
    "Arduino sketch",
    ".ino",
    FORMS,
    _write_sketch,
    _read,
    6e-8,
    FACTS,
    remark="readSensor() takes numbers from the serial line; replace it by your driver",
)
