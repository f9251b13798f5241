"""Is an exported file right? Everything is read back from its bytes and computed again in the target's own way.

C code is compiled with the compilers that are there (gcc as C99, g++ as C++17, all warnings being errors) and run on
10 000 readings; imufusion and imucal are asked themselves where they are installed; for the others the target's own
formula, which is written down apart from the conversion, is applied to the fields that were read back.
"""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from margcal.core.errors import DataError
from margcal.core.types import Array
from margcal.core.units import Kind
from margcal.files.exchange.c_code import apply_float32
from margcal.files.exchange.c_fixed import RAW_BITS, apply_integers
from margcal.workflow.export import Export

READINGS = 10_000
ULPS = 2.0
SECONDS = 60

_FLAGS = ["-Wall", "-Wextra", "-Werror", "-O2", "-ffp-contract=off"]
_COMPILERS = {
    "gcc": ["gcc", "-std=c99", "-pedantic", "-x", "c"],
    "g++": ["g++", "-std=c++17", "-pedantic", "-x", "c++"],
}


@dataclass(frozen=True)
class Check:
    """One thing that was looked at: `value` against `limit`, in words; `passed` is None where it could not be done."""

    name: str
    passed: bool | None
    text: str
    value: float | None = None
    limit: float | None = None


def check_export(export: Export, data: bytes) -> tuple[Check, ...]:
    """What comes of reading `data` (the bytes of the written file) and applying it.

    Raises
    ------
    DataError
        A check failed: the file is not what the calibration says.
    """
    target = export.target
    page = target.read(data, f"the {target.name} file", tuple(export.models))
    found = [_read_back(export, page.sensors), _vectors(export, page.sensors)]
    if target.name in ("c", "c-q15", "c-q31", "arduino"):
        found += [_compiled(export, data, compiler) for compiler in _compilers(target.name)]
    elif target.name == "fusion":
        found += [_syntax(data, compiler) for compiler in ("gcc", "g++")]
    elif target.name in ("imufusion", "imucal", "imucal-hdf5"):
        found.append(_by_package(export, data))
    if failed := [c for c in found if c.passed is False]:
        raise DataError(f"the {target.name} file is wrong: {'; '.join(c.text for c in failed)}; please report this")
    return tuple(found)


def _read_back(export: Export, sensors: Any) -> Check:
    worst = 0.0
    for kind, sensor in export.page.sensors.items():
        form = export.target.forms[kind]
        (H, B), (H2, B2) = form.decode(sensor.fields), form.decode(sensors[kind].fields)
        worst = max(worst, _relative(H2, H), _relative(B2, B))
    limit = export.target.exact
    text = f"read back: H and B within {worst:.1e} of what was written (limit {limit:.0e})"
    return Check("read-back", worst <= limit, text, worst, limit)


def _relative(a: Array, b: Array) -> float:
    return float(np.abs(a - b).max() / max(float(np.abs(b).max()), 1e-300))


def _vectors(export: Export, sensors: Any) -> Check:
    """The ten vectors in the file (or of the export, where it holds none) by the target's formula from its fields."""
    worst = 0.0
    for kind, sensor in export.page.sensors.items():
        if (vectors := sensors[kind].vectors or sensor.vectors) is None:
            continue
        y, u = vectors
        worst = max(worst, _relative(export.target.forms[kind].apply(sensors[kind].fields, y), u))
    limit = max(export.target.exact, 2e-8)  # the vectors are written in nine digits
    return Check(
        "vectors", worst <= limit, f"ten vectors a sensor: within {worst:.1e}, by the target's formula", worst, limit
    )


# --- C ------------------------------------------------------------------------------------------------

_ARDUINO = """
struct SerialLine {
    void begin(long) {}
    int available() { return 0; }
    float parseFloat() { return 0.0f; }
    template <typename T> void print(T) {}
    template <typename T> void print(T, int) {}
    void println() {}
};
static SerialLine Serial;
"""
_FUSION = """
typedef union { float array[3]; struct { float x; float y; float z; } axis; } FusionVector;
typedef union { float array[3][3]; struct { float xx, xy, xz, yx, yy, yz, zx, zy, zz; } element; } FusionMatrix;
"""


def _compilers(name: str) -> tuple[str, ...]:
    return ("g++",) if name == "arduino" else ("gcc", "g++")


def _main(kinds: list[Kind], raw: str, out: str, self_test: bool) -> str:
    """A program that turns raw readings on stdin into calibrated ones on stdout, sensor by sensor."""
    body = ""
    for kind in kinds:
        body += f"    for (n = 0; n < {READINGS}; n++) {{\n        {raw} y[3];\n        {out} u[3];\n"
        body += "        if (fread(y, sizeof(y[0]), 3, stdin) != 3) return 2;\n"
        body += (
            f"        margcal_{kind}(y, u);\n        if (fwrite(u, sizeof(u[0]), 3, stdout) != 3) return 3;\n    }}\n"
        )
    test = "    if (margcal_self_test() != 0) return 4;\n" if self_test else ""
    return f"#include <stdio.h>\nint main(void)\n{{\n    int n;\n{test}{body}    return 0;\n}}\n"


def _compiled(export: Export, data: bytes, compiler: str) -> Check:
    if shutil.which(compiler) is None:
        return Check(compiler, None, f"{compiler} is not installed: not compiled")
    kinds = list(export.page.sensors)
    fixed = export.target.name.startswith("c-q")
    readings = {k: _readings(export, k, np.random.default_rng(i)) for i, k in enumerate(kinds)}
    out_type = (
        np.dtype(f"<i{(int(export.page.sensors[kinds[0]].fields['bits']) + 1) // 8}") if fixed else np.dtype("<f4")
    )
    c_out = f"int{8 * out_type.itemsize}_t" if fixed else "float"
    sketch = export.target.name == "arduino"
    main = _main(kinds, "int32_t" if fixed else "float", c_out, not sketch)
    files = {"export.h": data, "arduino.h": _ARDUINO.encode()}
    head = '#include "arduino.h"\n' if sketch else "#define MARGCAL_SELF_TEST\n"
    given = b"".join(readings[k].astype("<i4" if fixed else "<f4").tobytes() for k in kinds)
    answer, complaint = _run(compiler, f'{head}#include "export.h"\n{main}', files, given)
    if answer is None:
        return Check(compiler, False, f"{compiler}: {complaint}")
    got = np.frombuffer(answer, dtype=out_type).reshape(len(kinds), READINGS, 3)
    worst = 0.0
    for k, kind in enumerate(kinds):
        fields = export.page.sensors[kind].fields
        if fixed:
            worst = max(worst, float(np.abs(got[k] - apply_integers(fields, readings[kind])).max()))
        else:
            want = apply_float32(fields, readings[kind]).astype(np.float32)
            worst = max(worst, float((np.abs(got[k].astype(np.float64) - want) / np.spacing(np.abs(want))).max()))
    unit, limit = ("LSB", 0.0) if fixed else ("ulp", ULPS)
    text = f"{compiler}: compiled without a warning, {READINGS} readings a sensor within {worst:g} {unit} of NumPy"
    return Check(compiler, worst <= limit, text, worst, limit)


def _readings(export: Export, kind: Kind, rng: np.random.Generator) -> Array:
    """Raw readings of vectors in all directions, up to four times the usual length; integers for fixed point."""
    model = export.models[kind]
    direction = rng.normal(size=(READINGS, 3))
    u = (
        direction
        / np.linalg.norm(direction, axis=1, keepdims=True)
        * model.magnitude
        * rng.uniform(0, 4, (READINGS, 1))
    )
    y = (u @ np.linalg.inv(model.H).T + model.B).astype(np.float32).astype(np.float64)
    fields = export.page.sensors[kind].fields
    if "bits" not in fields:
        return y
    top = 2 ** (RAW_BITS[fields["bits"]] - 1)
    y = np.clip(np.rint(y), -top, top - 1)
    y[:8] = np.array(np.meshgrid(*[[-top, top - 1]] * 3)).reshape(3, 8).T  # the corners, where it would overflow
    return y


def _syntax(data: bytes, compiler: str) -> Check:
    """The declarations compile beside the types of Fusion's headers (FusionMath.h)."""
    if shutil.which(compiler) is None:
        return Check(compiler, None, f"{compiler} is not installed: not compiled")
    source = '#include "types.h"\n#include "export.h"\nint main(void)\n{\n    return 0;\n}\n'
    answer, complaint = _run(compiler, source, {"export.h": data, "types.h": _FUSION.encode()}, b"")
    return Check(compiler, answer is not None, f"{compiler}: {complaint or 'compiled without a warning'}")


def _run(compiler: str, source: str, files: dict[str, bytes], given: bytes) -> tuple[bytes | None, str]:
    """What the compiled `source` writes when given `given`, or None and why not."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        for name, content in files.items():
            (place / name).write_bytes(content)
        (place / "main.c").write_text(source)
        command = [*_COMPILERS[compiler], *_FLAGS, "main.c", "-o", "program"]
        try:
            done = subprocess.run(command, cwd=place, capture_output=True, timeout=SECONDS)
            if done.returncode:
                return None, f"does not compile: {done.stderr.decode(errors='replace').strip().splitlines()[0]}"
            ran = subprocess.run([str(place / "program")], input=given, capture_output=True, timeout=SECONDS)
        except (OSError, subprocess.TimeoutExpired) as error:
            return None, f"could not be run ({type(error).__name__})"
    if ran.returncode == 4:
        return None, "its self test fails"
    return (None, f"the program ended with {ran.returncode}") if ran.returncode else (ran.stdout, "")


# --- other people's packages --------------------------------------------------------------------------


def _by_package(export: Export, data: bytes) -> Check:
    """The ten vectors as the package itself calibrates them."""
    package = export.target.name.split("-")[0]
    if package not in sys.modules and importlib.util.find_spec(package) is None:
        return Check(package, None, f"{package} is not installed: not asked")
    worst = 0.0
    answers = _imufusion(export) if package == "imufusion" else _imucal(export, data)
    for kind, u in answers.items():
        vectors = export.page.sensors[kind].vectors
        if vectors is not None:
            worst = max(worst, _relative(u, vectors[1]))
    limit = 1e-5 if package == "imufusion" else 1e-9
    text = f"{package} itself: ten vectors a sensor within {worst:.1e}"
    return Check(package, worst <= limit, text, worst, limit)


def _imufusion(export: Export) -> dict[Kind, Array]:
    import imufusion

    out: dict[Kind, Array] = {}
    for kind, sensor in export.page.sensors.items():
        if sensor.vectors is None:
            continue
        model = imufusion.model_magnetic if kind == "mag" else imufusion.model_inertial
        arguments = {k: np.asarray(v, dtype=np.float32) for k, v in sensor.fields.items()}
        out[kind] = np.array([model(y.astype(np.float32), **arguments) for y in sensor.vectors[0]], dtype=np.float64)
    return out


def _imucal(export: Export, data: bytes) -> dict[Kind, Array]:
    import imucal

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"export{export.target.suffix}"
        path.write_bytes(data)
        hdf5 = export.target.suffix == ".h5"
        loaded: Any = imucal.CalibrationInfo.from_hdf5(path) if hdf5 else imucal.CalibrationInfo.from_json_file(path)
    acc, gyr = (export.page.sensors[k].vectors for k in ("acc", "gyr"))
    if acc is None or gyr is None:
        return {}
    a, g = loaded.calibrate(acc[0], gyr[0], loaded.from_acc_unit, loaded.from_gyr_unit)
    return {"acc": a, "gyr": g}
