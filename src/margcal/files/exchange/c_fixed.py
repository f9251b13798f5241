"""C header in fixed point, for processors without floating point. The names are margcal's own.

Form        d = (y << F) - B_q;   u_q = round(sum_j H_q[i][j] d_j / 2^S), rounded half away from zero and saturated;
            u = u_q LSB, with LSB a power of two
Fields      ACC_H[9] (int16_t or int32_t), ACC_B[3] (int32_t, in 2^-F counts), ACC_SHIFT, ACC_LSB; margcal_acc(y, u)
Ranges      raw readings are integers: 16 bits with Q15, 20 bits with Q31; |B| below the same limit
Carries     all of H and B; H to 2^-16 (Q15) or 2^-32 (Q31) of its largest element
Units       raw: count. Calibrated: that of the calibration, times LSB

H_q are the mantissas of H with one common exponent; LSB is the smallest power of two with which no raw reading
overflows. Products and sums are 64 bits wide and cannot overflow: 32 + 29 + 2 bits.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.errors import DataError, InputError
from margcal.core.types import Array
from margcal.core.units import KINDS, Kind
from margcal.files.exchange import texts
from margcal.files.exchange.c_code import block_comment, constant, constants_in, guard, self_test, with_vectors
from margcal.files.exchange.c_code import test_vectors_in as vectors_of
from margcal.files.exchange.target import Fields, Form, Page, Target

RAW_BITS = {15: 16, 31: 20}
FRACTION = {15: 4, 31: 8}
"""Binary places of B: sixteenths of a count with Q15, 1/256 with Q31."""


def _encode(H: Array, B: Array, bits: int) -> Fields:
    largest_raw = 2 ** (RAW_BITS[bits] - 1)
    if np.abs(B).max() >= largest_raw:
        raise DataError(
            f"fixed point takes readings of {RAW_BITS[bits]} bits, and a bias of {np.abs(B).max():.6g} counts is "
            f"beyond; take {'c-q31 or ' if bits == 15 else ''}the float header (--to c)"
        )
    F = FRACTION[bits]
    reach = (np.abs(H) @ (largest_raw + np.abs(B))).max()
    lsb = 2.0 ** math.ceil(math.log2(reach / (2.0**bits - 1)))
    _, exponent = math.frexp(float(np.abs(H).max()) / lsb)  # largest element below 2^exponent
    shift = bits - exponent + F
    if np.rint(np.abs(H / lsb).max() * 2.0 ** (shift - F)) > 2**bits - 1:
        shift -= 1
    if not 1 <= shift <= 62:
        raise DataError("H is too large or too small for fixed point; take the float header (--to c)")
    mantissa = np.rint(H / lsb * 2.0 ** (shift - F))
    return {"H": mantissa, "B": np.rint(B * 2.0**F), "shift": shift, "lsb": lsb, "fraction": F, "bits": bits}


def _decode(fields: Fields) -> tuple[Array, Array]:
    scale = fields["lsb"] * 2.0 ** (fields["fraction"] - fields["shift"])
    return np.asarray(fields["H"]) * scale, np.asarray(fields["B"]) / 2.0 ** fields["fraction"]


def apply_integers(fields: Fields, y: ArrayLike) -> Array:
    """What the C function returns (n, 3), integers of `lsb`, for raw readings that are integers (n, 3)."""
    H, B = (np.asarray(fields[k]).astype(np.int64) for k in ("H", "B"))
    d = (np.asarray(y).astype(np.int64) << int(fields["fraction"])) - B
    total = d @ H.T
    half = np.int64(1) << (int(fields["shift"]) - 1)
    magnitude = (np.abs(total) + half) >> int(fields["shift"])
    top = 2 ** int(fields["bits"]) - 1
    return np.clip(np.sign(total) * magnitude, -top - 1, top).astype(np.float64)


def _apply(fields: Fields, y: Array) -> Array:
    return apply_integers(fields, np.rint(y)) * fields["lsb"]


def _forms(bits: int) -> dict[Kind, Form]:
    def encode(H: Array, B: Array, R: Array) -> Fields:
        return _encode(H, B, bits)

    def step(fields: Fields) -> float:
        return fields["lsb"]

    formula = "LSB round(H_q (2^F y - B_q) / 2^S)"
    return dict.fromkeys(KINDS, Form(formula, encode, _decode, _apply, raw=("count",), step=step))


def _function(kind: Kind, fields: Fields) -> str:
    p, bits = kind.upper(), int(fields["bits"])
    type_ = f"int{bits + 1}_t"
    top = 2**bits - 1
    return (
        f"static inline void margcal_{kind}(const int32_t y[3], {type_} u[3])\n{{\n    int i;\n"
        + "".join(
            f"    const int64_t d{i} = (int64_t)y[{i}] * {2 ** fields['fraction']} - {p}_B[{i}];\n" for i in range(3)
        )
        + "    for (i = 0; i < 3; i++) {\n"
        + f"        const int64_t sum = {p}_H[3 * i] * d0 + {p}_H[3 * i + 1] * d1 + {p}_H[3 * i + 2] * d2;\n"
        + f"        const int64_t half = (int64_t)1 << ({p}_SHIFT - 1);\n"
        + f"        const int64_t size = ((sum < 0 ? -sum : sum) + half) >> {p}_SHIFT;\n"
        + "        const int64_t value = sum < 0 ? -size : size;\n"
        + f"        u[i] = ({type_})(value > {top} ? {top} : value < -{top} - 1 ? -{top} - 1 : value);\n    }}\n}}\n"
    )


def _write(page: Page) -> bytes:
    bits = int(next(iter(page.sensors.values())).fields["bits"])
    lines = [*texts.heading(page), f"fixed point, Q{bits}: calibrated value = u times LSB, raw readings are integers"]
    out = block_comment(lines) + f"#ifndef {guard(page)}\n#define {guard(page)}\n\n#include <stdint.h>\n"
    for kind, sensor in page.sensors.items():
        p, f = kind.upper(), sensor.fields
        whole = _whole
        out += f"\n#define {p}_LSB {f['lsb']!r} /* = 2^{round(math.log2(f['lsb']))} */\n"
        out += f"#define {p}_SHIFT {f['shift']}\n#define {p}_FRACTION {f['fraction']}\n"
        out += constant(f"int{bits + 1}_t", f"{p}_H", f["H"], whole) + constant("int32_t", f"{p}_B", f["B"], whole)
        out += "\n" + _function(kind, f)
    return (out + self_test(_in_lsb(page), f"int{bits + 1}_t", lambda _: "(u[i] != want)") + "\n#endif\n").encode()


def _whole(v: float) -> str:
    return str(round(float(v)))


def _in_lsb(page: Page) -> Page:
    return with_vectors(
        page,
        {k: (s.vectors[0], s.vectors[1] / s.fields["lsb"]) for k, s in page.sensors.items() if s.vectors is not None},
    )


_CONSTANT = re.compile(r"\bint(?:16|32)_t\s+(ACC|GYR|MAG)_([HB]) {0,9}\[(\d{1,3})\] {0,9}=\s{0,9}\{([^{}]{0,2000})\}")


def _reader(bits: int):
    def read(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
        text = texts.decode(data, name)
        if f"int{bits + 1}_t u[3]" not in text:
            raise InputError(f"{name}: is no header of margcal's in Q{bits}")
        found: dict[Kind, dict[str, Any]] = {}
        for kind, constants in constants_in(text, _CONSTANT, name).items():
            fields: dict[str, Any] = {**constants, "bits": bits}
            for key, number, kind_of in (
                ("LSB", texts.NUMBER, float),
                ("SHIFT", r"\d{1,2}", int),
                ("FRACTION", r"\d{1,2}", int),
            ):
                hit = re.search(rf"#define {kind.upper()}_{key} ({number})(?!\S)", text)
                if not hit:
                    raise InputError(f"{name}: {kind.upper()}_{key} is not there")
                fields[key.lower()] = kind_of(hit[1])
            if not (
                1 <= fields["shift"] <= 62
                and 0 <= fields["fraction"] <= 16
                and 0 < fields["lsb"] < 1e30
                and math.frexp(fields["lsb"])[0] == 0.5
            ):
                raise InputError(f"{name}: {kind.upper()}_SHIFT, _FRACTION or _LSB is not what margcal writes")
            found[kind] = fields
        page = texts.page_of(found, text)
        tests: dict[Kind, tuple[Array, Array]] = {
            k: (y, u * float(found[k]["lsb"])) for k, (y, u) in vectors_of(text).items() if k in found
        }
        return with_vectors(page, tests)

    return read


Q15 = Target(
    "c-q15",
    "C header, fixed point Q15",
    ".h",
    _forms(15),
    _write,
    _reader(15),
    4e-5,
    "margcal's own format",
    remark="for raw readings that are integers of 16 bits",
)
Q31 = Target(
    "c-q31",
    "C header, fixed point Q31",
    ".h",
    _forms(31),
    _write,
    _reader(31),
    2e-5,
    "margcal's own format",
    remark="for raw readings that are integers of 20 bits",
)
