"""The files that `fuzz.py` feeds to the readers and to the calibration file: good ones, and how they are damaged.

A case is a pure function of (target, seed, number): `case_of` gives its files as name -> bytes, so that every crash
can be made again. A fifth of the cases cuts a good file at 0, 1, ... 99 % of its length; the others flip bits, drop,
repeat and move pieces, put in tokens that have broken readers before, or damage the structure (cells, columns,
types, keys, nesting) and write it out whole.
"""

from __future__ import annotations

import gzip
import io
import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

Rng = np.random.Generator
Files = dict[str, bytes]

AXES = ("+x", "-x", "+y", "-y", "+z", "-z")

# fmt: off
TOKENS = (
    "NaN", "nan", "inf", "-Infinity", "1e999", "-1e999", "1e308", "4.9e-324", "1e-400", "-0", "0x1p3", "1_000", "1,234",
    "1.234,5", "+1", "1e", "0e0", ".5", "5.", "--1", "9" * 400, "1" * 5000, "9223372036854775808", "1e5", "True",
    "None", "null", "a" * 20_000, ";", ",", "\t", ";;", '"', '""', "'", '"a', "\\", "\n", "\r", "\r\n", "\n\n", "#",
    "//", "/*", " ", "\0", "\x1b[2J", "\ufeff", "\u2028", "\u0660", "\ud7ff", "\U0001f600", "=1+1", "@SUM(A1)",
    "<script>", "{}", "../../x", "%s%n", "[]", "t_s", "acc_x_g", "mag_x_", "ref_qw", "qw", "up", "+x", "start_s",
    "1970-01-01T00:00:00Z", "12:30", "0.1.2",
)
"""What has broken readers before, among it what they take for structure."""

NUMBERS = (
    "", "", "nan", "0", "-0", "1", "-1", "0.5", "1e3", "-1e9", "1e18", "1e155", "1e308", "-1e308", "5e-324", "1e-300",
    "9007199254740993", "1e2", "+7", " 8 ", "1.", ".5", "1700000000.25", "0.99999", "1.04", "-5e-8",
)
"""What a reader takes for a number, or for a missing one: these go deeper than what it refuses."""

BYTES = (
    b"\0", b"\xff\xfe", b"\xfe\xff", b"\xef\xbb\xbf", b"\xff", b"\xc3", b"\x1f\x8b", b"PAR1", b"PK\x03\x04",
    b"\xed\xa0\x80",
)
# fmt: on


def case_of(target: str, seed: int, number: int) -> Files:
    """The files of one case; a single file is the input itself, several lie in a folder that is the input."""
    rng = np.random.default_rng([seed, sorted(TARGETS).index(target), number])
    return TARGETS[target](rng, number)


# --- damage to bytes ----------------------------------------------------------------------------------


def _flip(data: bytes, rng: Rng) -> bytes:
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        out[rng.integers(len(out))] ^= 1 << int(rng.integers(8))
    return bytes(out)


def _overwrite(data: bytes, rng: Rng) -> bytes:
    at, n = _piece(data, rng)
    filler = (rng.bytes(n), b"\0" * n, b"\xff" * n)[rng.integers(3)]
    return data[:at] + filler + data[at + n :]


def _drop(data: bytes, rng: Rng) -> bytes:
    at, n = _piece(data, rng)
    return data[:at] + data[at + n :]


def _repeat(data: bytes, rng: Rng) -> bytes:
    at, n = _piece(data, rng)
    return data[:at] + data[at : at + n] * int(rng.integers(2, 20)) + data[at + n :]


def _move(data: bytes, rng: Rng) -> bytes:
    at, n = _piece(data, rng)
    rest = data[:at] + data[at + n :]
    to = int(rng.integers(len(rest) + 1))
    return rest[:to] + data[at : at + n] + rest[to:]


def _insert(data: bytes, rng: Rng) -> bytes:
    at = int(rng.integers(len(data) + 1))
    return data[:at] + _token(rng) + data[at:]


def _prefix(data: bytes, rng: Rng) -> bytes:
    return BYTES[rng.integers(len(BYTES))] + data


def _piece(data: bytes, rng: Rng) -> tuple[int, int]:
    """Start and length of a piece, mostly short."""
    return int(rng.integers(len(data))), int(2 ** rng.uniform(0, 9))


def _token(rng: Rng) -> bytes:
    if rng.integers(4) == 0:
        return BYTES[rng.integers(len(BYTES))]
    return TOKENS[rng.integers(len(TOKENS))].encode()


_DAMAGE: tuple[Callable[[bytes, Rng], bytes], ...] = (
    _flip,
    _overwrite,
    _drop,
    _repeat,
    _move,
    _insert,
    _insert,
    _prefix,
)


def _damaged(data: bytes, rng: Rng) -> bytes:
    for _ in range(int(rng.integers(1, 4))):
        data = _DAMAGE[rng.integers(len(_DAMAGE))](data, rng) if data else data
    return data


def _cut(data: bytes, rng: Rng, number: int) -> bytes:
    """`data` cut at a percentage that goes through 0 to 99 with the number of the case."""
    return data[: int(len(data) * (number // 5 % 100 + rng.random()) / 100)]


# --- text tables --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Text:
    """A text table: rows of cells, and how they become bytes."""

    rows: tuple[tuple[str, ...], ...]
    suffix: str = ".csv"
    delimiter: str = ","
    decimal: str = "."
    encoding: str = "utf-8"
    end: str = "\n"
    quote: bool = False
    before: str = ""

    def encode(self, rows: Iterable[Iterable[str]] | None = None) -> bytes:
        """The table with other `rows`, as bytes; not yet packed where it is a gzip file."""
        rows = self.rows if rows is None else rows
        cells = [[f'"{c}"' if self.quote else c.replace(".", self.decimal) for c in row] for row in rows]
        text = self.before + "".join(self.delimiter.join(row) + self.end for row in cells)
        return text.encode(self.encoding, errors="replace")

    def pack(self, data: bytes) -> bytes:
        return gzip.compress(data, 1, mtime=0) if self.suffix.endswith(".gz") else data


# fmt: off
_HEAD = (
    "t_s", "acc_x_count", "acc_y_count", "acc_z_count", "gyr_x_dps", "gyr_y_dps", "gyr_z_dps", "mag_x_uT", "mag_y_uT",
    "mag_z_uT", "temp_degC", "ref_qw", "ref_qx", "ref_qy", "ref_qz", "ref_p_x_mm", "ref_p_y_mm", "ref_p_z_mm", "note",
)
# fmt: on


def _recording_rows(wide: bool) -> tuple[tuple[str, ...], ...]:
    rng = np.random.default_rng(1)
    rows: list[tuple[str, ...]] = [_HEAD if wide else _HEAD[:4]]
    for k in range(24):
        q = rng.normal(size=4)
        numbers = [k / 100, *rng.normal(size=9) * 100, 21.5, *q / np.linalg.norm(q), *rng.normal(size=3) * 1e3]
        cells = [f"{x:.6g}" for x in numbers]
        rows.append((*cells, "a\u00e9 b") if wide else tuple(cells[:4]))
    return tuple(rows)


@cache
def _recordings() -> tuple[Text, ...]:
    wide, narrow = _recording_rows(True), _recording_rows(False)
    return (
        Text(wide),
        Text(narrow),
        Text(narrow, delimiter=";", decimal=","),
        Text(wide, suffix=".tsv", delimiter="\t", encoding="cp1252"),
        Text(narrow, suffix=".txt", quote=True, end="\r\n"),
        Text(narrow, encoding="utf-16"),
        Text(wide, encoding="utf-16-be"),
        Text(narrow, end="\r", encoding="utf-8-sig"),
        Text(narrow, before="# logger 3\n// second, comment\n\n"),
        Text(wide, suffix=".csv.gz"),
    )


@cache
def _poses() -> tuple[Text, ...]:
    rng = np.random.default_rng(2)
    quaternions: list[tuple[str, ...]] = [("qw", "qx", "qy", "qz", "start_s", "stop_s", "file")]
    faces = [("up", "front", "note")]
    for k in range(12):
        q = rng.normal(size=4)
        quaternions.append((*(f"{x:.6g}" for x in q / np.linalg.norm(q)), f"{3 * k}.5", f"{3 * k + 2}", "a.csv"))
        up = k % 6
        faces.append((AXES[up], ("+y", "'+z", "x")[up // 2], "text"))
    return (
        Text(tuple(quaternions)),
        Text(tuple(faces)),
        Text(tuple(quaternions), delimiter=";", decimal=","),
        Text(tuple(faces), suffix=".tsv", delimiter="\t", encoding="utf-16"),
    )


def _text_case(seeds: tuple[Text, ...], rng: Rng, number: int, name: str) -> Files:
    seed = seeds[number // 500 % len(seeds)] if number % 5 == 0 else seeds[rng.integers(len(seeds))]
    if number % 5 == 0:
        return {name + seed.suffix: _cut(seed.pack(seed.encode()), rng, number)}
    rows = [list(row) for row in seed.rows]
    structure = rng.integers(4)
    if structure:
        for _ in range(1 + int(rng.exponential(1.0))):
            _damage_rows(rows, rng)
    data = seed.encode(rows)
    if structure and rng.integers(6):
        return {name + seed.suffix: seed.pack(data)}
    if rng.integers(2):  # damage inside the packing as often as outside
        return {name + seed.suffix: seed.pack(_damaged(data, rng))}
    return {name + seed.suffix: _damaged(seed.pack(data), rng)}


def _damage_rows(rows: list[list[str]], rng: Rng) -> None:
    """One change to the table as a table."""
    row = rows[rng.integers(len(rows))]
    column = int(rng.integers(max(len(rows[0]), 1)))
    number = rng.integers(3) > 0
    token = NUMBERS[rng.integers(len(NUMBERS))] if number else _token(rng).decode(errors="replace")
    what = rng.integers(12)
    if what == 0 and rows[0]:
        rows[0][column] = token if rng.integers(2) else rows[0][rng.integers(len(rows[0]))]
    elif what == 1:
        for each in rows:
            del each[column : column + 1]
    elif what == 2:
        for each in rows[1:]:
            each[column : column + 1] = [token]
    elif what == 3:
        rows.insert(int(rng.integers(len(rows))), [token] * (len(rows[0]) if rng.integers(2) else 7))
    elif what == 4:
        rows[:] = [rows[0], *(rows[k] for k in rng.permutation(np.arange(1, len(rows))))]
    elif what == 5:
        rows[:] = rows[: int(rng.integers(1, len(rows) + 1))] * int(rng.integers(1, 4))
    elif what in (6, 7):
        _rescale(rows[1:], 0 if what == 6 else column, rng)
    elif row:
        for _ in range(int(2 ** rng.uniform(0, 4))):
            row = rows[rng.integers(len(rows))] or row
            row[rng.integers(len(row))] = token if rng.integers(5) else row[0] + token


def _rescale(rows: list[list[str]], column: int, rng: Rng) -> None:
    """Another unit, another origin, or fewer digits, in one column."""
    factor = float(rng.choice([0.0, -1.0, 1e-320, 1e-9, 1e3, 1e9, 1e300, 1.0]))
    offset = float(rng.choice([0.0, 1.7e9, -1e300, 1e16]))
    digits = int(rng.choice([2, 6, 17]))
    for row in rows:
        if column < len(row):
            try:
                row[column] = f"{float(row[column]) * factor + offset:.{digits}g}"
            except ValueError:
                continue


# --- Parquet ------------------------------------------------------------------------------------------


def _parquet_bytes(columns: dict[str, Any], **options: Any) -> bytes:
    import pyarrow as pa
    import pyarrow.parquet as pq

    sink = io.BytesIO()
    arrays = [v if isinstance(v, pa.Array) else pa.array(v) for v in columns.values()]
    pq.write_table(pa.Table.from_arrays(arrays, names=list(columns)), sink, **options)
    return sink.getvalue()


def _good_columns(n: int = 40) -> dict[str, Any]:
    rng = np.random.default_rng(3)
    columns: dict[str, Any] = {"t_s": [k / 100 for k in range(n)]}
    for name in _HEAD[1:10]:
        columns[name] = (rng.normal(size=n) * 100).tolist()
    return columns | {"note": ["text"] * n}


@cache
def _parquets() -> tuple[bytes, ...]:
    import pyarrow as pa

    good = _good_columns()
    whole = {k: pa.array([int(x) for x in v], pa.int16()) if "count" in k else v for k, v in good.items()}
    gaps = {k: [None if i % 3 else x for i, x in enumerate(v)] if "mag" in k else v for k, v in good.items()}
    return (
        _parquet_bytes(good, compression="zstd"),
        _parquet_bytes(whole, compression="snappy", row_group_size=7, use_dictionary=True),
        _parquet_bytes(gaps, compression="none", use_dictionary=False),
        _parquet_bytes(dict(list(good.items())[:4]), compression="gzip", data_page_version="2.0"),
    )


def _odd_array(rng: Rng, n: int) -> Any:
    """A column of a type or with values that a table of readings should not have."""
    import decimal

    import pyarrow as pa

    text = [TOKENS[rng.integers(len(TOKENS))] for _ in range(n)]
    choices: tuple[Callable[[], Any], ...] = (
        lambda: pa.array(text),
        lambda: pa.array([t.encode() for t in text]),
        lambda: pa.array(text).dictionary_encode(),
        lambda: pa.nulls(n),
        lambda: pa.array([[1.0, 2.0]] * n),
        lambda: pa.array([{"a": 1, "b": "x"}] * n),
        lambda: pa.array([decimal.Decimal("1.5")] * n),
        lambda: pa.array([2**62 + k for k in range(n)], pa.timestamp("ns")),
        lambda: pa.array([-(2**63), *range(n - 1)]),
        lambda: pa.array([2**64 - 1] * n, pa.uint64()),
        lambda: pa.array(np.array([*[6e4] * (n - 1), np.inf], dtype=np.float16)[:n]),
        lambda: pa.array([float(rng.choice([np.nan, np.inf, -np.inf, 1e308, -1e308, 5e-324]))] * n),
        lambda: pa.array(rng.choice([np.nan, np.inf, 1e300, 0.0, 1.0], n)),
        lambda: pa.array([None, *[True] * (n - 1)]),
        lambda: pa.array([k // 3600 for k in range(n)], pa.date32()),
        lambda: pa.array([0.0] * n, pa.float32()),
    )
    return choices[rng.integers(len(choices))]()


def _odd_table(rng: Rng) -> bytes:
    """A whole Parquet file that holds something else than a recording."""
    n = int(rng.choice([0, 1, 2, 3, 40]))
    good = {k: v[:n] for k, v in _good_columns().items()}
    names = list(good)
    for _ in range(int(rng.integers(1, 5)) if n else 1):
        name = names[rng.integers(len(names))]
        if rng.integers(4) == 0:
            name = TOKENS[rng.integers(len(TOKENS))]
        good[name] = _odd_array(rng, n) if n else good.get(name, [])
    return _parquet_bytes(good)


def _parquet_case(rng: Rng, number: int) -> Files:
    seeds = _parquets()
    if number % 5 == 0:
        return {"recording.parquet": _cut(seeds[number // 500 % len(seeds)], rng, number)}
    if rng.integers(5) < 2:
        return {"recording.parquet": _odd_table(rng)}
    data = seeds[rng.integers(len(seeds))]
    if rng.integers(2):  # the footer, where the structure is described
        head = int(0.5 * len(data))
        return {"recording.parquet": data[:head] + _damaged(data[head:], rng)}
    return {"recording.parquet": _damaged(data, rng)}


# --- folders ------------------------------------------------------------------------------------------


def _folder_case(rng: Rng, number: int) -> Files:
    """Two or three tables, one or two of them damaged, some with names that are no table's."""
    rows = _recording_rows(True)

    def part(columns: slice) -> Text:
        return Text(tuple((r[0], *r[columns]) for r in rows))

    parts = {"acc.csv": part(slice(1, 4)), "gyr.csv": part(slice(4, 7)), "mag.csv": part(slice(7, 10))}
    files = {name: text.encode() for name, text in parts.items()}
    for _ in range(int(rng.integers(1, 3))):
        name = list(parts)[rng.integers(3)]
        files[name] = next(iter(_text_case((parts[name],), rng, number, "x").values()))
    if rng.integers(4) == 0:
        files["ref.parquet"] = _parquet_case(rng, number)["recording.parquet"]
    if rng.integers(4) == 0:
        odd = ("notes.txt", ".hidden.csv", "a.CSV", "cal.json", "x.pq", "\u00e9.csv.gz")[rng.integers(6)]
        files[odd] = files["acc.csv"] if rng.integers(2) else rng.bytes(50)
    if rng.integers(8) == 0:
        del files[list(files)[rng.integers(len(files))]]
    return files


# --- the calibration file -----------------------------------------------------------------------------

_ODD_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2, 1.5, "", "1.0", "acc", "pass", [], {}, [[]], [None], {"a": 1}),
    *(
        float("nan"),
        float("inf"),
        1e308,
        -1e308,
        5e-324,
        2**53 + 1,
        2**63,
        -(2**63),
        10**400,
        "\ud800",
        "\0",
        "a" * 5000,
    ),
    *([1.0, 2.0], [1.0, 2.0, 3.0], [1.0, 2.0, 3.0, 4.0], [[0.0] * 3] * 3, [[1.0] * 3] * 3, [[1.0] * 12] * 12),
    *([[1e200, 0, 0], [0, 1e200, 0], [0, 0, 1e200]], [[1e-200, 0, 0], [0, 1e-200, 0], [0, 0, 1e-200]]),
)


def calibration_document() -> dict[str, Any]:
    """A calibration file with every key, as plain values."""
    rng = np.random.default_rng(4)
    document: dict[str, Any] = {"format": "margcal-calibration", "version": 1, "device": "node 7", "frame": "housing"}
    document |= {"verdict": "warn", "issues": [_issue("acc"), _issue(None)]}
    for kind, unit in (("acc", "m/s^2"), ("gyr", "rad/s"), ("mag", "uT")):
        half = rng.normal(size=(12, 12))
        document[kind] = {
            "H": (0.01 * (np.eye(3) + 0.05 * rng.normal(size=(3, 3)))).tolist(),
            "B": rng.normal(size=3).tolist(),
            "raw_unit": "count",
            "unit": unit,
            "covariance": (1e-8 * half @ half.T).tolist(),
            "residual_rms": 0.01,
            "n_poses": 24,
            "method": "gls-ml",
            "reference_vector": [0.0, 0.1, 9.8],
            "expected_error_deg": 0.2,
            "delay_s": 0.004,
            "delay_se_s": 1e-4,
            "temperature_degC": 21.5,
        }
    document["alignment"] = {"common_clock": False, "offset_s": 0.1, "drift_ppm": 3.0, "marker_to_node": [1.0, 0, 0, 0]}
    file = {"name": "walk.csv", "sha256": "0" * 64}
    settings = {"poses": "cube", "gravity": 9.80665, "more": {"list": [1, 2.5, None, True]}}
    document["source"] = {
        "created": "2026-11-22T00:00:00Z",
        "program": "margcal",
        "files": [file],
        "settings": settings,
    }
    return document


def _issue(sensor: str | None) -> dict[str, Any]:
    return {"code": "few-poses", "level": "warn", "sensor": sensor, "text": "too few", "value": 5.0, "limit": 6.0}


def _places(value: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) of a document, those of short containers as often as those of long ones."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    found = []
    for key, inner in items:
        found.append((value, key))
        found += _places(inner)
    return found


def _damage_document(document: dict[str, Any], rng: Rng) -> None:
    """One change to the tree: something gone, renamed, moved, scaled, of another type, or a string that is odd."""
    places = _places(document)
    if not places:
        return
    named = [p for p in places if isinstance(p[0], dict)] or places  # matrices have most places, keys most meaning
    pool = named if rng.integers(3) else places
    container, key = pool[rng.integers(len(pool))]
    value, what = container[key], rng.integers(9)
    if what == 0:
        del container[key]
    elif what == 1 and isinstance(container, dict):
        container[TOKENS[rng.integers(len(TOKENS))]] = value
    elif what == 2:
        other, place = places[rng.integers(len(places))]
        container[key] = json.loads(json.dumps(other[place]))
    elif what in (3, 4) and isinstance(value, (int, float, list)):
        container[key] = _scaled(
            value, 10.0 ** int(rng.integers(-320, 309) if rng.integers(3) else rng.integers(-3, 4))
        )
    elif what in (5, 6) and isinstance(value, str):
        container[key] = _token(rng).decode(errors="replace")
    else:
        container[key] = _ODD_VALUES[rng.integers(len(_ODD_VALUES))]


def _scaled(value: Any, factor: float) -> Any:
    if isinstance(value, list):
        return [_scaled(v, factor) for v in value]
    return float(np.float64(value) * factor) if isinstance(value, (int, float)) and abs(value) < 1e300 else value


def _calibration_case(rng: Rng, number: int) -> Files:
    document = calibration_document()
    if rng.integers(3) == 0:
        for key in ("gyr", "mag", "alignment", "issues"):
            del document[key]
    what = rng.integers(10) if number % 5 else -1
    if what >= 2:
        for _ in range(1 + int(rng.exponential(1.0))):
            _damage_document(document, rng)
    text = json.dumps(document, indent=2 if rng.integers(2) else None, ensure_ascii=bool(rng.integers(2)))
    data = text.encode("utf-8", errors="surrogatepass")
    if what == -1:
        data = _cut(data, rng, number)
    elif what == 0:
        data = _damaged(data, rng)
    elif what == 1:
        data = _spliced(text, rng)
    return {"cal.json": data}


def _spliced(text: str, rng: Rng) -> bytes:
    """Structure that no tree of values holds: deep nesting, keys twice, tokens in place of a value."""
    depth = int(10 ** rng.uniform(1, 5))
    opened, closed = ("[", "]") if rng.integers(2) else ('{"a":', "}")
    whole = bool(rng.integers(2))
    choices = (
        opened * depth + ("1" + closed * depth if whole else ""),
        '{"issues": [' + '{"code": "x", "level": "note"},' * 2000 + "null]}",
        '"version": 1, "version": 1,',
        '"source": {"settings": ' + opened * depth + "1" + closed * depth + "},",
        _token(rng).decode(errors="replace"),
    )
    piece = choices[rng.integers(len(choices))]
    ends = [k + 1 for k, c in enumerate(text) if c in "{:,["]
    at = ends[rng.integers(len(ends))]
    drop = int(rng.integers(0, 3)) * int(rng.integers(1, 20))
    return (text[:at] + piece + text[at + drop :]).encode("utf-8", errors="replace")


TARGETS: dict[str, Callable[[Rng, int], Files]] = {
    "csv": lambda rng, number: _text_case(_recordings(), rng, number, "recording"),
    "parquet": _parquet_case,
    "folder": _folder_case,
    "poses": lambda rng, number: _text_case(_poses(), rng, number, "poses"),
    "apply": lambda rng, number: (
        _parquet_case(rng, number) if number % 3 == 0 else _text_case(_recordings(), rng, number, "recording")
    ),
    "calibration": _calibration_case,
}
"""What is fuzzed: three readers of recordings, the poses table, the stream behind `apply`, the calibration file."""
