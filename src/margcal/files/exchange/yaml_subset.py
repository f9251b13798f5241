"""The part of YAML that calibration files are written in, and nothing else.

Mappings and sequences by indentation, ``[...]`` lists (over several lines too), numbers, words, quoted strings,
comments. Tags, anchors, aliases, merges, block scalars and flow mappings are refused with their line: no file of the
programs concerned needs them, and they are how YAML is abused.
"""

from __future__ import annotations

import re
from typing import Any

from margcal.core.checking import printable
from margcal.core.errors import InputError

DEEPEST = 12

_NUMBER = re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)([eE][-+]?\d+)?")
_KEY = re.compile(r"([A-Za-z_][\w./ -]{0,100}?|\"[^\"\\]{0,100}\"|'[^']{0,100}') {0,20}:(?: +(.*))?$")
_QUOTED = re.compile(r"\"([^\"\\]*)\"|'([^']*)'")

Line = tuple[int, int, str]
"""Number in the file, indentation, text without indentation and comment."""


def load(text: str, name: str) -> Any:
    """The document in `text`; messages call it `name`.

    Raises
    ------
    InputError
        With the line that is not of this part of YAML.
    """
    lines = _lines(text, name)
    if not lines:
        raise InputError(f"{name}: is empty; expected YAML")
    value, rest = _block(lines, 0, lines[0][1], name, 0)
    if rest != len(lines):
        raise _wrong(name, lines[rest], "its indentation fits nothing above")
    return value


def _wrong(name: str, line: Line, why: str) -> InputError:
    return InputError(f"{name}: line {line[0]}: {why}: {printable(line[2], 60)!r}")


def _lines(text: str, name: str) -> list[Line]:
    found: list[Line] = []
    for number, raw in enumerate(text.splitlines(), 1):
        body = _without_comment(raw).rstrip()
        stripped = body.lstrip(" ")
        if not stripped or stripped in ("---", "...") or (not found and stripped.startswith("%YAML")):
            continue
        if stripped.startswith("\t"):
            raise InputError(f"{name}: line {number}: indented with a tab; YAML takes spaces")
        found.append((number, len(body) - len(stripped), stripped))
    return _joined(found, name)


def _without_comment(raw: str) -> str:
    quote = ""
    for k, c in enumerate(raw):
        if quote:
            quote = "" if c == quote else quote
        elif c in "\"'":
            quote = c
        elif c == "#" and (k == 0 or raw[k - 1] in " \t"):
            return raw[:k]
    return raw


def _joined(lines: list[Line], name: str) -> list[Line]:
    """Lists in brackets that run over several lines on one."""
    out: list[Line] = []
    depth = 0
    for line in lines:
        opens = line[2].count("[") - line[2].count("]")
        if depth > 0:
            first = out[-1]
            out[-1] = (first[0], first[1], f"{first[2]} {line[2]}")
        else:
            out.append(line)
        depth += opens
        if depth < 0:
            raise _wrong(name, line, "a bracket is closed that was not opened")
    if depth:
        raise _wrong(name, out[-1], "a bracket is not closed")
    return out


def _block(lines: list[Line], at: int, indent: int, name: str, depth: int) -> tuple[Any, int]:
    if depth > DEEPEST:
        raise _wrong(name, lines[at], "nested too deeply")
    if lines[at][2].startswith("- ") or lines[at][2] == "-":
        return _sequence(lines, at, indent, name, depth)
    if _KEY.match(lines[at][2]):
        return _mapping(lines, at, indent, name, depth)
    return _scalar(lines[at][2], name, lines[at]), at + 1


def _mapping(lines: list[Line], at: int, indent: int, name: str, depth: int) -> tuple[dict[str, Any], int]:
    out: dict[str, Any] = {}
    while at < len(lines) and lines[at][1] == indent:
        line = lines[at]
        hit = _KEY.match(line[2])
        if not hit:
            raise _wrong(name, line, "expected 'key: value'")
        key = hit[1].strip("\"'")
        if key in out:
            raise _wrong(name, line, "the key is there twice")
        if hit[2]:
            out[key], at = _scalar(hit[2], name, line), at + 1
            continue
        at += 1
        sequence = at < len(lines) and lines[at][1] == indent and lines[at][2].startswith("-")
        if at < len(lines) and (lines[at][1] > indent or sequence):
            out[key], at = _block(lines, at, lines[at][1], name, depth + 1)
        else:
            out[key] = None
    return out, at


def _sequence(lines: list[Line], at: int, indent: int, name: str, depth: int) -> tuple[list[Any], int]:
    out: list[Any] = []
    while at < len(lines) and lines[at][1] == indent and (lines[at][2].startswith("- ") or lines[at][2] == "-"):
        number, _, text = lines[at]
        inner = text[1:].lstrip(" ")
        if inner:
            # "- - 1" and "- key: 1": what follows the dash is a line of its own, further in
            lines[at] = (number, indent + len(text) - len(inner), inner)
            value, at = _block(lines, at, lines[at][1], name, depth + 1)
        elif at + 1 < len(lines) and lines[at + 1][1] > indent:
            value, at = _block(lines, at + 1, lines[at + 1][1], name, depth + 1)
        else:
            value, at = None, at + 1
        out.append(value)
    return out, at


def _scalar(text: str, name: str, line: Line) -> Any:
    text = text.strip()
    if text[0] == "[":
        value, end = _flow(text, 0, name, line, 0)
        if text[end:].strip():
            raise _wrong(name, line, "something follows the list")
        return value
    if _NUMBER.fullmatch(text):
        return float(text)
    if quoted := _QUOTED.fullmatch(text):
        return quoted[1] if quoted[1] is not None else quoted[2]
    if text[0] in "!&*{}|>%@`\"'":
        raise _wrong(name, line, "this kind of YAML value is not read")
    return {"true": True, "false": False, "null": None, "~": None}.get(text.lower(), text)


def _flow(text: str, at: int, name: str, line: Line, depth: int) -> tuple[list[Any], int]:
    """The list whose bracket opens at `at`, and the place after it."""
    if depth > DEEPEST:
        raise _wrong(name, line, "nested too deeply")
    out: list[Any] = []
    at += 1
    while True:
        while at < len(text) and text[at] in " ,":
            at += 1
        if at >= len(text):
            raise _wrong(name, line, "a bracket is not closed")
        if text[at] == "]":
            return out, at + 1
        if text[at] == "[":
            value, at = _flow(text, at, name, line, depth + 1)
        else:
            end = min(k for k in (text.find(",", at), text.find("]", at), len(text)) if k >= 0)
            value, at = _scalar(text[at:end], name, line), end
        out.append(value)
