"""C export: compiled with gcc (C99) and g++ (C++17), run, and compared with NumPy; the interface that is promised."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from exchange_table import exported, imported, node
from margcal.apps.cli import run
from margcal.core.errors import DataError
from margcal.core.types import Calibration, SensorModel
from margcal.core.units import KINDS
from margcal.files.calfile import save
from margcal.files.exchange.c_code import apply_float32, literal
from margcal.files.exchange.c_fixed import apply_integers
from margcal.files.exchange.registry import find
from margcal.workflow.export import export
from margcal.workflow.export_check import READINGS, check_export

GCC = ["gcc", "-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror"]
GXX = ["g++", "-std=c++17", "-pedantic", "-Wall", "-Wextra", "-Werror", "-x", "c++"]
pytestmark = pytest.mark.skipif(not (shutil.which("gcc") and shutil.which("g++")), reason="needs gcc and g++")


def compiled(command: list[str], folder: Path, *sources: str, **files: bytes) -> Path:
    """The program that `command` makes of `sources` (main first) beside the header ``n.h``."""
    for name, data in files.items():
        (folder / f"{name}.h").write_bytes(data)
    names = []
    for k, text in enumerate(sources):
        (folder / f"s{k}.c").write_text(text)
        names.append(f"s{k}.c")
    done = subprocess.run([*command, *names, "-o", "p"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "p"


@pytest.mark.parametrize("name", ["c", "c-q15", "c-q31", "arduino", "fusion"])
@pytest.mark.parametrize("seed", [1, 2])
def test_ten_thousand_readings_come_out_as_in_numpy(name, seed):
    done = exported(node(seed), find(name))
    checks = {c.name: c for c in check_export(done, done.data)}
    compilers = ["g++"] if name == "arduino" else ["gcc", "g++"]
    for compiler in compilers:
        assert checks[compiler].passed, checks[compiler].text
        if name != "fusion":
            assert f"{READINGS} readings" in checks[compiler].text
            assert checks[compiler].value <= (0 if name.startswith("c-q") else 2)


def test_float32_is_near_float64():
    """What single precision costs: some 1e-7 of the vector's length, for counts of any size below 2^24."""
    calibration = node(3)
    done = exported(calibration, find("c"))
    rng = np.random.default_rng(1)
    for kind in KINDS:
        model = calibration.models[kind]
        u = rng.normal(size=(10_000, 3)) * {"acc": 10, "gyr": 5, "mag": 50}[kind]
        y = np.rint(model.invert(u))
        got = apply_float32(done.page.sensors[kind].fields, y)
        error = np.linalg.norm(got - model.apply(y), axis=1) / np.linalg.norm(model.apply(y), axis=1).max()
        assert error.max() < 5e-7


def test_contracted_products_differ_by_units_in_the_last_place_of_the_products(tmp_path):
    """With fused multiply-add (``-ffp-contract=fast -mfma``), where the processor has it."""
    if "fma" not in Path("/proc/cpuinfo").read_text():
        pytest.skip("this processor has no fused multiply-add")
    done = exported(node(4), find("c"))
    main = (
        '#include "n.h"\n#include <stdio.h>\nint main(void) { float y[3], u[3];\n'
        "while (fread(y, 4, 3, stdin) == 3) { margcal_mag(y, u); fwrite(u, 4, 3, stdout); }\n"
        "(void)margcal_acc; (void)margcal_gyr; return 0; }\n"
    )
    program = compiled([*GCC, "-O2", "-mfma", "-ffp-contract=fast"], tmp_path, main, n=done.data)
    y = (np.random.default_rng(2).normal(size=(10_000, 3)) * 400).astype("<f4")
    got = np.frombuffer(subprocess.run([program], input=y.tobytes(), capture_output=True).stdout, dtype="<f4")
    fields = done.page.sensors["mag"].fields
    want = apply_float32(fields, y)
    size = (np.abs(fields["H"])[None] * np.abs(y - fields["B"])[:, None, :]).sum(axis=2)
    ulps = np.abs(got.reshape(-1, 3) - want) / np.spacing(size.astype(np.float32))
    assert 0 < ulps.max() <= 2


def test_the_interface_is_the_one_promised(tmp_path):
    """The names and types of the conventions, in two files of one program, u being y; nothing else at file scope."""
    done = exported(node(5), find("c"))
    main = """#include "n.h"
    void other(const float y[3], float u[3]);
    #include <stdio.h>
    int main(void)
    {
        const float *h = ACC_H, *b = ACC_B;
        void (*f)(const float *, float *) = margcal_acc;
        float y[3] = {100.0f, 200.0f, 2000.0f}, u[3], v[3];
        int i;
        f(y, u);
        other(y, v);
        margcal_acc(y, y);
        for (i = 0; i < 3; i++) { if (u[i] != v[i] || u[i] != y[i]) return 1; }
        margcal_gyr(y, u);
        margcal_mag(y, u);
        if (sizeof(ACC_H) != 9 * sizeof(float) || sizeof(MAG_B) != 3 * sizeof(float)) { return 2; }
        return h != b && GYR_H[0] > 0 ? 0 : 3;
    }
    """
    second = """#include "n.h"
    void other(const float y[3], float u[3]);
    void other(const float y[3], float u[3]) { margcal_acc(y, u); }
    """
    for command in (GCC, GXX):
        program = compiled(command, tmp_path, main, second, n=done.data)
        assert subprocess.run([program]).returncode == 0
    (tmp_path / "empty.c").write_text('#define MARGCAL_SELF_TEST\n#include "n.h"\n')
    out = subprocess.run(
        ["gcc", "-E", "-P", "empty.c"], cwd=tmp_path, capture_output=True, text=True, check=True
    ).stdout
    declared = re.findall(r"^static (?:const|inline) \w+ (\w+)", out, re.M)
    assert declared and all(re.match(r"(ACC|GYR|MAG)_(H|B|TEST_RAW|TEST_OUT)$|margcal_\w+$", n) for n in declared)
    assert re.findall(r"^(?!static|\s|\{|\}|$).*", out, re.M) == []
    macros = subprocess.run(["gcc", "-dM", "-E", "empty.c"], cwd=tmp_path, capture_output=True, text=True, check=True)
    plain = subprocess.run(["gcc", "-dM", "-E", "-xc", "/dev/null"], capture_output=True, text=True, check=True)
    new = set(macros.stdout.splitlines()) - set(plain.stdout.splitlines())
    assert {m.split()[1] for m in new} == {"MARGCAL_SELF_TEST", "MARGCAL_N7_H"}


@pytest.mark.parametrize("name", ["c", "c-q15", "c-q31"])
def test_the_self_test_finds_a_changed_constant(name, tmp_path):
    done = exported(node(6), find(name))
    main = '#define MARGCAL_SELF_TEST\n#include "n.h"\nint main(void) { return margcal_self_test() > 0; }\n'
    assert subprocess.run([compiled(GCC, tmp_path, main, n=done.data)]).returncode == 0
    text = done.data.decode()
    first = re.search(r"GYR_H\[9\] = \{\s*([-\d.e]+)", text)
    broken = text[: first.start(1)] + str(type(eval(first[1]))(eval(first[1]) * 1.01)) + text[first.end(1) :]
    assert subprocess.run([compiled(GCC, tmp_path, main, n=broken.encode())]).returncode == 1


def test_a_file_that_is_wrong_fails_its_check():
    done = exported(node(7), find("c"))
    text = done.data.decode()
    for wrong, words in (
        (text.replace("ACC_H[1] * d1", "ACC_H[1] * d0"), "self test fails"),
        (text.replace("u[2] =", "u[3 - 1] = 1 +"), "self test fails"),
        (text.replace("static inline void margcal_mag", "static inline int margcal_mag"), "does not compile"),
        (re.sub(r"(ACC_B\[3\] = \{\s*-?)", r"\g<1>1", text), "read back"),
    ):
        assert wrong != text
        with pytest.raises(DataError, match=words):
            check_export(done, wrong.encode())


def test_a_check_that_fails_leaves_no_file(tmp_path, monkeypatch, capsys):
    cal = tmp_path / "cal.json"
    save(node(7), cal)
    monkeypatch.setattr("margcal.workflow.export_check.apply_float32", lambda fields, y: apply_float32(fields, y) + 1)
    assert run(["export", str(cal), "--to", "c", "-o", str(tmp_path / "n.h"), "--check"]) == 3
    assert "the c file is wrong" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["cal.json"]
    monkeypatch.undo()
    assert run(["export", str(cal), "--to", "c", "-o", str(tmp_path / "n.h"), "--check", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert {c["name"]: c["value"] for c in shown["checks"]}["gcc"] <= 2


@pytest.mark.parametrize(("name", "bits"), [("c-q15", 16), ("c-q31", 20)])
@pytest.mark.parametrize("seed", range(3))
def test_fixed_point_never_overflows_and_is_as_fine_as_said(name, bits, seed):
    rng = np.random.default_rng(seed)
    H = 10.0 ** rng.uniform(-6, 3) * (np.eye(3) + rng.uniform(-0.5, 0.5, (3, 3)))
    B = rng.uniform(-1, 1, 3) * 2 ** (bits - 2)
    calibration = Calibration(acc=SensorModel("acc", H, B))
    done = export(calibration, find(name), max_loss_deg=10)
    fields = done.page.sensors["acc"].fields
    top = 2 ** (bits - 1)
    corners = np.array(np.meshgrid(*[[-top, top - 1]] * 3)).reshape(3, 8).T
    y = np.vstack([corners, rng.integers(-top, top, (5000, 3))])
    exact = (y - B) @ H.T
    got = apply_integers(fields, y) * fields["lsb"]
    span = np.abs(exact).max()
    # half a step, and what rounding the largest elements of H (2^-bits of it) and B (2^-fraction) makes of a reading
    mantissa = 2.0 ** -int(fields["bits"]) * 3 * np.abs(H).max() * 2 * top
    bias = 3 * np.abs(H).max() * 2.0 ** -(int(fields["fraction"]) + 1)
    assert np.abs(got - exact).max() <= 0.51 * fields["lsb"] + mantissa + bias
    assert fields["lsb"] <= 4 * span / 2.0 ** int(fields["bits"])
    assert np.abs(apply_integers(fields, y)).max() < 2 ** int(fields["bits"])


def test_fixed_point_says_its_step_and_refuses_what_it_cannot_hold():
    done = exported(node(1), find("c-q15"))
    loss = {x.kind: x for x in done.losses}["mag"]
    assert loss.step == done.page.sensors["mag"].fields["lsb"]
    # rounding two components at right angles to the vector, each with variance step^2 / 12
    u = np.random.default_rng(1).normal(size=(20_000, 3))
    u *= np.hypot(18.5, 45.6) / np.linalg.norm(u, axis=1, keepdims=True)
    rounded = np.rint(u / loss.step) * loss.step
    angle = np.arctan2(np.linalg.norm(np.cross(u, rounded), axis=1), np.sum(u * rounded, axis=1))
    assert np.degrees(np.sqrt(np.mean(angle**2))) == pytest.approx(loss.step_deg, rel=0.03)
    assert f"results come in steps of {loss.step:.6g} uT" in done.data.decode()
    far = replace(node(1), acc=replace(node(1).acc, B=np.array([40_000.0, 0, 0])))
    with pytest.raises(DataError, match="bias of 40000 counts is beyond; take c-q31 or the float header"):
        export(far, find("c-q15"))
    assert export(far, find("c-q31")).losses
    coarse = Calibration(mag=SensorModel("mag", 0.15 * np.eye(3), np.zeros(3), reference_vector=[0, 0, 2.0]))
    with pytest.raises(DataError, match="deg from rounding"):
        export(coarse, find("c-q15"))


def test_constants_are_constants_of_c():
    for x in (0.0, -0.0, 1.0, 400.0, 1e-30, -1.5e20, 1 / 3, 123456789.0, np.float32(0.1)):
        text = literal(x)
        assert re.fullmatch(r"-?\d+(\.\d*)?(e[-+]\d+)?f", text) and re.search(r"[.e]", text)
        assert np.float32(text[:-1]) == np.float32(x)


@pytest.mark.parametrize(
    "device", ["*/ #error no", "??/", "a\\", "x\n#error no", "/* nested", "// comment \\", "\u202e"]
)
def test_hostile_names_still_compile(device, tmp_path):
    main = '#define MARGCAL_SELF_TEST\n#include "n.h"\nint main(void) { return margcal_self_test(); }\n'
    data = exported(node(8, device=device), find("c")).data
    for command in (GCC, GXX):
        assert subprocess.run([compiled([*command, "-trigraphs"], tmp_path, main, n=data)]).returncode == 0


def test_headers_come_back_to_the_last_bit_of_float32():
    for name in ("c", "arduino"):
        calibration = node(9)
        back = imported(exported(calibration, find(name)).data, find(name))
        for kind in KINDS:
            np.testing.assert_array_equal(back.models[kind].H, calibration.models[kind].H.astype(np.float32))
            np.testing.assert_array_equal(back.models[kind].B, calibration.models[kind].B.astype(np.float32))
