"""MotionCal (PJRC) and magneto: an offset and a matrix, as people copy them from the window.

Form        W (y - V)
Fields      MotionCal: Magnetic Offset V, Magnetic Mapping W, Magnetic Field (strength); or the arrays mag_offsets,
            mag_softiron_matrix, mag_field_strength of Adafruit's sketches
            magneto: combined bias b, then the correction matrix A-1
Carries     all of H and B of one magnetometer; both programs themselves give a symmetric W, so their frame is the
            sensor's own axes turned by nobody knows what
Units       the text does not say. MotionCal works in uT

From       Adafruit's sketches with these arrays (x = raw - offset, then W x, row by row); magneto 1.2 prints b and
           A-1 with "h_calib = A-1 (h_raw - b)".
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import ArrayLike

from margcal.core.types import Array
from margcal.core.units import Kind
from margcal.files.exchange import texts
from margcal.files.exchange.target import Fields, Form, Page, Target


def _encode(H: Array, B: Array, R: Array) -> Fields:
    return {"V": np.array(B), "W": np.array(H)}


def _decode(fields: Fields) -> tuple[Array, Array]:
    return fields["W"], fields["V"]


def _apply(fields: Fields, y: ArrayLike) -> Array:
    d = np.asarray(y) - fields["V"]
    W = fields["W"]
    return np.column_stack([d[:, 0] * r[0] + d[:, 1] * r[1] + d[:, 2] * r[2] for r in W])


FORM = Form("W (y - V)", _encode, _decode, _apply)
MOTIONCAL_FORMS: dict[Kind, Form] = {"mag": FORM}
MAGNETO_FORMS: dict[Kind, Form] = {"mag": FORM, "acc": FORM}


def _block(fields: Fields, offset: str, matrix: str) -> str:
    rows = "\n".join(texts.row(r, texts.number, "  ") for r in fields["W"])
    return f"{offset}\n{texts.row(fields['V'], texts.number, '  ')}\n{matrix}\n{rows}\n"


def _write_motioncal(page: Page) -> bytes:
    (sensor,) = page.sensors.values()
    out = texts.comment([*texts.heading(page), *texts.vector_lines(page)], "#")
    out += _block(sensor.fields, "Magnetic Offset", "Magnetic Mapping")
    if page.field_uT:
        out += f"Magnetic Field\n{texts.number(page.field_uT)}\n"
    return out.encode()


def _write_magneto(page: Page) -> bytes:
    (sensor,) = page.sensors.values()
    out = texts.comment([*texts.heading(page), *texts.vector_lines(page)], "#")
    matrix = "Correction for combined scale factors, misalignments and soft iron (A-1):"
    return (out + _block(sensor.fields, "Combined bias (b):", matrix)).encode()


_OFFSET = (
    r"(?i)magnetic\s+offset\w*|mag_offsets?\s*\[\s*3\s*\]\s*=|mag_hardiron\s*\[\s*3\s*\]\s*=|combined\s+bias\s*\(b\)"
)
_MATRIX = r"(?i)magnetic\s+mapping|mag_softiron(?:_matrix)?\s*\[\s*[39]\s*\](?:\s*\[\s*3\s*\])?\s*=|\(A-1\)|\(A\^-1\)"


def _reader(known: tuple[Kind, ...]):
    def read(data: bytes, name: str, kinds: tuple[Kind, ...]) -> Page:
        text = texts.decode(data, name)
        code = re.sub(r"(?m)^[ \t]*(#|//).*$", "", text)
        code = re.sub(r"(?<=\d)[fF]\b", "", code)
        fields = {
            "V": texts.numbers_after(
                code, _OFFSET, 3, "the offset (Magnetic Offset, mag_offsets, combined bias)", name
            ),
            "W": texts.numbers_after(
                code, _MATRIX, 9, "the matrix (Magnetic Mapping, mag_softiron_matrix, A-1)", name
            ).reshape(3, 3),
        }
        ours: list[Kind] = [k for k in known if k in texts.units_in(text)]
        chosen: list[Kind] = [k for k in kinds if k in known]
        kind: Kind = "mag"
        if ours or len(chosen) == 1:
            kind = ours[0] if ours else chosen[0]
        found: dict[Kind, Fields] = {kind: fields}
        return texts.page_of(found, text)

    return read


MOTIONCAL = Target(
    "motioncal",
    "MotionCal text",
    ".txt",
    MOTIONCAL_FORMS,
    _write_motioncal,
    _reader(("mag",)),
    1e-12,
    "Adafruit's sketches with the values of MotionCal",
    single=True,
    remark="MotionCal has no file: this is the text of its window, which it cannot load; paste it into your sketch",
)
MAGNETO = Target(
    "magneto",
    "magneto text",
    ".txt",
    MAGNETO_FORMS,
    _write_magneto,
    _reader(("mag", "acc")),
    1e-12,
    "what magneto 1.2 prints",
    single=True,
    remark="one sensor a file: --sensors mag or acc",
)
