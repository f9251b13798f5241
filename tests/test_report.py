"""The report: everything said, nothing loaded, nothing run that came from the data, and numbers that reproduce."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from browser import CHROMIUM, Browser
from margcal.apps import report_svg, report_text
from margcal.apps.report import render, write_report
from margcal.apps.report_attitudes import up_name
from margcal.apps.report_code import c_code, python_code
from margcal.apps.report_data import attitudes, left_out, residuals
from margcal.apps.report_expected import around, enlargement, heading, towards
from margcal.apps.report_influence import influences
from margcal.apps.report_parameters import lines, standard_errors
from margcal.apps.report_sphere import sphere_data
from margcal.apps.report_text import NAMES, degrees
from margcal.core import so3
from margcal.core.errors import InputError
from margcal.core.types import Calibration, Fit, Issue, Kind, Poses, Recording, SensorModel, Stream, Turn
from margcal.files.poses_table import PoseTable
from margcal.methods.sensor_model import describe
from margcal.methods.uncertainty import expected_error
from margcal.workflow.calibrate import calibrate
from margcal.workflow.place import parse_at
from margcal.workflow.simulate import Simulation, simulate

ALL = [
    *("findings", "expected", "checks", "recorded", "attitudes", "sphere", "residuals", "influence"),
    *("parameters", "apply", "provenance"),
]
LOADED = ["findings", "expected", "checks", "parameters", "apply", "provenance"]
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\u202e\x1b[31m\"'&--><!--"
VOID = {"meta", "link", "br", "img", "input", "hr"}


class Page(HTMLParser):
    """Parses strictly: every tag that opens must close, in order."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.ids: list[str] = []
        self.scripts: list[str] = []
        self.text: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.ids += [v for k, v in attrs if k == "id" and v]
        if tag == "script":
            self.scripts.append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "script":
            self.scripts[-1] += data
        elif "style" not in self.open:
            self.text.append(data)

    @property
    def sections(self) -> list[str]:
        return [a["id"] or "" for tag, a in self.tags if tag == "section"]


# --- a calibration by hand: what `calibrate` returns, with the truth for an estimate -------------------


def _poses(simulation: Simulation) -> Poses:
    mean, sd, count = {}, {}, {}
    for kind, s in simulation.recording.streams.items():
        inside = [(s.t > a + 0.1) & (s.t < b - 0.1) for a, b in zip(simulation.start, simulation.stop)]
        mean[kind] = np.array([s.y[i].mean(axis=0) for i in inside])
        sd[kind] = np.array([s.y[i].std(axis=0) for i in inside])
        count[kind] = np.array([float(i.sum()) for i in inside])
    n = len(simulation.start)
    knocks = np.array([float(((simulation.knocks[:, 0] >= a) & (simulation.knocks[:, 0] < b)).any())
                       for a, b in zip(simulation.start, simulation.stop)])  # fmt: skip
    return Poses(simulation.start, simulation.stop, (0,) * n, mean, sd, count, 12 * knocks, R=simulation.nominal)


def _turns(simulation: Simulation) -> tuple[Turn, ...]:
    gyr = simulation.recording.gyr
    assert gyr is not None
    out = []
    for i, (a, b) in enumerate(zip(simulation.stop[:-1], simulation.start[1:])):
        inside = (gyr.t >= a) & (gyr.t <= b)
        out.append(Turn(i, i + 1, gyr.t[inside], gyr.y[inside], np.full(int(inside.sum()), 0.01)))
    return tuple(out)


def _covariance(model: SensorModel, relative: float = 1e-3) -> np.ndarray:
    A = np.random.default_rng(5).normal(size=(12, 12)) * relative
    size = np.r_[np.full(9, np.abs(model.H).max()), np.full(3, 1 / np.abs(model.H).max())]
    return (A @ A.T) * np.outer(size, size)


def _fit(model: SensorModel, residual: np.ndarray, **details: np.ndarray) -> Fit:
    return Fit(model, residual, 0.0, "by hand", cites="nowhere (1) <b>", details=details)


CHECKS = [
    {"code": "expected-error", "sensor": k, "value": 0.123, "limit": 0.5, "level": "pass", "text": f"{k} is good"}
    for k in ("acc", "gyr", "mag")
]
CHECKS += [
    {"code": "residual", "sensor": "mag", "value": 0.034, "limit": 0.02, "level": "warn", "text": "iron"},
    {"code": "rests-remaining", "sensor": "acc", "value": 12.0, "limit": 10.0, "level": "pass", "text": "12 remain"},
    {"code": "housing-error", "sensor": None, "value": None, "limit": None, "level": "fail", "text": "<b>askew</b>"},
]
"""As `workflow.checks` leaves them in the settings."""


def _shift(model: SensorModel, n: int) -> np.ndarray:
    """Leave-one-out: rest 3 turns the frame by 1 degree about z, the others by 0.01."""
    angle = np.radians(np.where(np.arange(n) == 2, 1.0, 0.01))
    turned = angle[:, None, None] * (so3.skew([0.0, 0.0, 1.0]) @ model.H)
    return np.column_stack([turned.reshape(n, 9), np.zeros((n, 3))])


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return simulate(seed=3, n_poses=12, rest_s=2.0, knocks=2, mag_axes="board")


@pytest.fixture(scope="module")
def full(simulation: Simulation) -> Calibration:
    poses, turns = _poses(simulation), _turns(simulation)
    rng = np.random.default_rng(1)
    models: dict[str, Any] = {}
    fits: dict[Kind, Fit] = {}
    for kind, model in simulation.truth.models.items():
        n = len(turns) if kind == "gyr" else len(poses)
        residual = np.abs(rng.normal(size=n)) * 1e-3
        residual[4] = 8e-3
        models[kind] = replace(
            model, covariance=_covariance(model), residual_rms=2e-3, n_poses=len(poses), method="by hand",
            expected_error_deg=0.123, delay_s=0.0123 if kind == "mag" else None, delay_se_s=0.001,
        )  # fmt: skip
        fits[kind] = _fit(models[kind], residual, leave_one_out=_shift(model, len(poses)))
    return Calibration(
        **models,
        device="node7",
        issues=(
            Issue("sign-assumed", "note", "magnetometer: a note", "mag"),
            Issue("x", "warn", "look here", None, 3.0, 2.0),
        ),
        created="2026-11-20T10:12:00Z",
        program="margcal 9.9.9",
        files=(("session.parquet", "ab" * 32),),
        settings={
            "attitudes": "cube",
            "attitudes_text": "twelve rests, sure",
            "gravity": 9.80665,
            "at": [51.5, 0.1],
            "checks": CHECKS,
        },
        fits=fits,
        poses=poses,
        turns=turns,
        recordings=(simulation.recording,),
    )


def _alone(c: Calibration) -> Calibration:
    """What is left after save and load."""
    return replace(c, fits={}, poses=None, turns=(), recordings=())


def _without_magnetometer(c: Calibration) -> Calibration:
    assert c.poses is not None
    poses = replace(c.poses, mean={k: v for k, v in c.poses.mean.items() if k != "mag"})
    recordings = tuple(replace(r, mag=None) for r in c.recordings)
    return replace(
        c, mag=None, fits={k: f for k, f in c.fits.items() if k != "mag"}, poses=poses, recordings=recordings
    )


def _swing(c: Calibration) -> Calibration:
    """A magnetometer from continuous motion: a residual for every sample, no rests."""
    assert c.mag is not None
    n = len(c.recordings[0].streams["mag"].t)
    residual = np.random.default_rng(2).normal(size=n) * 1e-2
    none = np.zeros(0)
    empty = Poses(none, none, (), {}, {}, {}, none)
    return replace(c, acc=None, gyr=None, fits={"mag": _fit(c.mag, residual)}, poses=empty, turns=())


def _million(c: Calibration) -> Calibration:
    n = 1_000_000
    t, rng = np.arange(n) / 1000, np.random.default_rng(0)
    y = rng.normal(size=(n, 3)) * 300
    y[2000:3000] = np.nan
    y[5000, 0] = 1e308
    y[6000, 1] = np.inf
    acc, gyr, mag = Stream("acc", t, y, "count"), Stream("gyr", t, y, "count"), Stream("mag", t, y, "count")
    return replace(c, recordings=(Recording(acc, gyr, mag, source="million"),))


def _bare(c: Calibration) -> Calibration:
    """Nothing but H and B."""
    models: dict[str, Any] = {k: SensorModel(k, m.H, m.B, m.raw_unit, m.unit) for k, m in c.models.items()}
    return Calibration(**models)


CASES = {
    "full": (lambda c: c, ALL),
    "alone": (_alone, LOADED),
    "bare": (_bare, ["findings", "parameters", "apply", "provenance"]),
    "without-magnetometer": (_without_magnetometer, ALL),
    "accelerometer-only": (lambda c: replace(_without_magnetometer(c), gyr=None), ALL),
    "swing": (_swing, [s for s in ALL if s not in ("attitudes", "influence")]),
    "million-samples": (_million, ALL),
    "no-attitudes": (lambda c: replace(c, poses=replace(c.poses, R=None)), ALL),
    "nothing-calibrated": (
        lambda c: Calibration(
            verdict="fail", issues=(Issue("no-rests", "fail", "no rest found", "acc"),), recordings=c.recordings
        ),
        ["findings", "recorded", "provenance"],
    ),
    "three-recordings": (lambda c: replace(c, recordings=c.recordings * 3), ALL),
}


@pytest.mark.parametrize("name", CASES)
def test_page_is_whole_small_and_loads_nothing(name: str, full: Calibration) -> None:
    change, sections = CASES[name]
    text = render(change(full))
    page = Page(text)
    assert page.sections == sections
    assert len(page.ids) == len(set(page.ids))
    assert len(text.encode()) < 1_000_000
    assert "http:" not in text and "https:" not in text and "url(" not in text and "@import" not in text
    for tag, attributes in page.tags:
        assert tag not in {"img", "iframe", "object", "embed", "base", "form"}
        assert "src" not in attributes and "style" not in attributes
        assert not any(a.startswith("on") for a in attributes)
        if "href" in attributes:
            target = attributes["href"] or ""
            assert target == "data:," or target[1:] in page.ids
    assert not re.search(r"\b(nan|None|inf)\b", " ".join(page.text))


def test_same_calibration_same_page(full: Calibration) -> None:
    assert render(full) == render(full)


def test_policy_allows_these_very_scripts_and_styles_only(full: Calibration) -> None:
    import base64
    import hashlib

    text = render(full)
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy is not None
    rules = dict(r.strip().split(" ", 1) for r in policy.group(1).split(";"))
    assert rules["default-src"] == "'none'"
    code = Page(text).scripts[-1]
    style = text[text.index("<style>") + 7 : text.index("</style>")]
    for rule, content in (("script-src", code), ("style-src", style)):
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert rules[rule] == f"'sha256-{digest}'"


def test_hostile_names_are_inert(full: Calibration) -> None:
    tame = Page(render(full))
    assert full.acc is not None
    streams = full.recordings[0].streams
    hostile = replace(
        full,
        device=HOSTILE,
        frame=HOSTILE,
        created=HOSTILE,
        program=HOSTILE,
        verdict=None,
        acc=replace(full.acc, raw_unit=HOSTILE[:40], method=HOSTILE),
        issues=(Issue(HOSTILE, "warn", HOSTILE, None), Issue("y", "note", HOSTILE, "acc")),
        files=((HOSTILE, HOSTILE),),
        settings={HOSTILE: HOSTILE, "attitudes_text": HOSTILE, "gravity": HOSTILE, "attitudes": [HOSTILE]},
        fits={k: replace(f, cites=HOSTILE) for k, f in full.fits.items()},
        recordings=(replace(full.recordings[0], source=HOSTILE, acc=replace(streams["acc"], unit=HOSTILE)),),
    )
    text = render(hostile)
    page = Page(text)
    count = [tag for tag, _ in page.tags].count
    assert count("script") == [t for t, _ in tame.tags].count("script") == 2
    assert count("img") == 0
    assert "\u202e" not in text and "\x1b" not in text
    assert "<img" not in "".join(page.scripts) and "alert(1)" not in page.scripts[-1]
    data = json.loads(page.scripts[0])
    assert data["acc"]["raw_unit"].startswith("</script>")
    compile(python_code(hostile), "snippet", "exec")
    assert all(len(line.split("//")) <= 2 and not line.endswith("\\") for line in c_code(hostile).splitlines())


def test_python_snippet_is_apply(full: Calibration) -> None:
    """To rounding: NumPy may add the three products of a row in another order, or fused, as the compiled kernel does
    not. Two units in the last place of the largest product, which cancellation may leave as more of the sum."""
    rng = np.random.default_rng(8)
    raw = {f"{k}_raw": rng.normal(size=(20, 3)) * 500 for k in full.models}
    names: dict = dict(raw)
    exec(python_code(full), names)
    for kind, model in full.models.items():
        products = model.H * (raw[f"{kind}_raw"] - model.B)[:, None, :]
        bound = 2 * np.spacing(np.abs(products).max(axis=-1))
        assert np.all(np.abs(names[kind] - model.apply(raw[f"{kind}_raw"])) <= bound)
    one = {f"{k}_raw": raw[f"{k}_raw"][0] for k in full.models}
    exec(python_code(full), one)
    np.testing.assert_allclose(one["acc"], full.models["acc"].apply(one["acc_raw"]), rtol=1e-12)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no C compiler (gcc) here")
def test_c_snippet_is_apply_in_single_precision(full: Calibration, tmp_path: Path) -> None:
    raw = np.round(np.random.default_rng(9).normal(size=(50, 3)) * 500)
    calls = "".join(f"margcal_{k}(y, u); put(u); " for k in full.models)
    calls += "margcal_acc(y, y); put(y);"  # in place
    (tmp_path / "a.c").write_text(
        f"#include <stdio.h>\n{c_code(full)}\nstatic void put(const float *u) "
        '{ printf("%.9g %.9g %.9g\\n", u[0], u[1], u[2]); }\n'
        'int main(void) { float y[3], u[3]; while (scanf("%f %f %f", y, y + 1, y + 2) == 3) {'
        + calls
        + "} return 0; }\n"
    )
    build = ["gcc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-o", str(tmp_path / "a"), str(tmp_path / "a.c")]
    subprocess.run(build, check=True, capture_output=True)
    text = "\n".join(" ".join(map(str, y)) for y in raw.tolist())
    out = subprocess.run([tmp_path / "a"], input=text, text=True, capture_output=True, check=True).stdout
    got = np.array(out.split(), dtype=float).reshape(len(raw), len(full.models) + 1, 3)
    for k, model in enumerate([*full.models.values(), full.models["acc"]]):
        want = model.apply(raw)
        np.testing.assert_allclose(got[:, k], want, atol=2e-6 * np.abs(want).max())


def test_code_in_the_page_is_the_code(full: Calibration) -> None:
    import html

    text = render(full)
    for name, code in (("python-code", python_code(full)), ("c-code", c_code(full))):
        found = re.search(rf'<pre id="{name}"[^>]*>(.*?)</pre>', text, re.S)
        assert found is not None
        assert html.unescape(found.group(1)) == code


def test_worked_example_is_right(full: Calibration) -> None:
    row = re.search(r'<th scope="row">Magnetometer</th><td><span class="num">\((.*?)\).*?\((.*?)\)', render(full))
    assert row is not None
    y, u = (np.array([float(v.replace("−", "-")) for v in g.split(", ")]) for g in row.groups())
    assert full.mag is not None
    np.testing.assert_allclose(u, full.mag.apply(y), rtol=1e-5)


# --- parameters --------------------------------------------------------------------------------------


def test_standard_errors_match_simulated_scatter(full: Calibration) -> None:
    model = full.models["mag"]
    assert model.covariance is not None
    C = model.covariance * 1e-4
    se = standard_errors(replace(model, covariance=C))
    assert se is not None
    p = np.r_[model.H.ravel(), model.B]
    draws = np.random.default_rng(4).multivariate_normal(p, C, size=300)
    about = [describe(replace(model, H=d[:9].reshape(3, 3), B=d[9:], covariance=None)) for d in draws]
    for column, values in (
        (slice(0, 3), [a.bias for a in about]),
        (slice(3, 6), [a.scale_factor for a in about]),
        (slice(6, 9), [list(a.non_orthogonality_deg.values()) for a in about]),
        (slice(9, 12), [list(a.mounting_deg.values()) for a in about]),
        (slice(15, 24), [np.ravel(np.array(a.soft_iron)) for a in about]),
    ):
        np.testing.assert_allclose(np.std(values, axis=0), se[column], rtol=0.2)


def test_a_figure_without_variance_has_no_error(full: Calibration) -> None:
    model = full.models["gyr"]
    assert model.covariance is not None
    C = model.covariance.copy()
    C[9:] = C[:, 9:] = 0
    bias, scale = lines(replace(model, covariance=C))[:2]
    assert np.isnan(bias.se).all() and np.isfinite(scale.se).all()
    assert all(np.isnan(line.se).all() for line in lines(replace(model, covariance=None)))


def test_board_axes_are_told_in_words(full: Calibration) -> None:
    text = next(line.meaning for line in lines(full.models["mag"]) if line.name == "Mounting")
    assert "x along +y, y along +x, z along −z" in text


# --- what is drawn -----------------------------------------------------------------------------------


def test_worst_rest_and_turn_are_named(full: Calibration) -> None:
    text = " ".join(Page(render(full)).text)
    assert "at rest 5, which stands out" in text
    assert "at turn 5–6" in text


def test_residuals_are_tied_to_rests_that_were_read(full: Calibration) -> None:
    assert full.poses is not None
    mean = {k: v.copy() for k, v in full.poses.mean.items()}
    mean["acc"][2] = np.nan
    fit = replace(full.fits["acc"], residual=np.delete(full.fits["acc"].residual, 2))
    c = replace(full, poses=replace(full.poses, mean=mean), fits={"acc": fit})
    found = residuals(c, "acc")
    assert found is not None and found.labels[:3] == ("1", "2", "4") and found.labels[found.worst] == "5"
    np.testing.assert_allclose(found.value, 1e3 * fit.residual)  # mm/s^2


def test_without_fits_the_magnitude_is_the_residual(full: Calibration) -> None:
    found = residuals(replace(full, fits={}), "acc")
    assert found is not None and not found.from_fit and len(found.value) == 12
    assert found.rms < 60  # the truth, on noisy means: some mm/s^2
    assert residuals(replace(full, fits={}), "gyr") is None


def test_attitudes_without_labels_have_the_right_up(full: Calibration) -> None:
    assert full.poses is not None and full.poses.R is not None
    R, headings = attitudes(replace(full, poses=replace(full.poses, R=None)))
    assert R is not None and not headings
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12)
    assert [up_name(r) for r in R] == [up_name(r) for r in full.poses.R]


def test_up_names() -> None:
    assert up_name(np.eye(3)) == "+z up"
    assert up_name(so3.exp([np.pi, 0, 0])) == "−z up"
    assert up_name(so3.exp([0, np.radians(40), 0])) == "+z 40° from up"


def test_sphere_data_maps_to_the_unit_sphere(full: Calibration) -> None:
    data = sphere_data(full)
    assert set(data) == {"acc", "mag"}
    for kind, model in full.models.items():
        if kind == "gyr":
            continue
        one = data[kind]
        u = model.apply(np.array(one["rests"])) / one["magnitude"]
        np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1, atol=5e-3)
        assert 1000 < len(one["samples"]) <= 3000


def test_envelope_keeps_every_extreme() -> None:
    t = np.arange(100_000) / 1000
    y = np.sin(t)
    y[31_415], y[70_000] = 40.0, -30.0
    y[50_000:52_000] = np.nan
    x, low, high = report_svg.envelope(t, y, report_svg.Scale(0.0, 100.0), 500)
    assert np.nanmax(high) == 40.0 and np.nanmin(low) == -30.0
    assert np.isnan(low[251:259]).all()
    np.testing.assert_allclose(x[np.nanargmax(high)], 0.31415, atol=1 / 500)


def test_numbers_read_well() -> None:
    assert report_text.number(-0.00001234) == "−1.234×10⁻⁵"
    assert report_text.number(float("nan")) == "–"
    assert report_text.fixed(-0.0004, 2) == "0.00"
    assert report_text.plus_minus(12.3456, 0.012).endswith('12.346</span> <span class="se">± 0.012</span>')
    assert report_svg.tick_labels([-0.5, 0.0, 0.5]) == ["−0.5", "0.0", "0.5"]


def test_data_block_cannot_be_left() -> None:
    block = report_text.data_block("x", {"a": HOSTILE})
    inside = block[block.index(">") + 1 : block.rindex("<")]
    assert not set("<>&") & set(inside)
    assert json.loads(inside) == {"a": HOSTILE}


def test_verdict_comes_first(full: Calibration) -> None:
    """Then its reasons, then the figures; notes further down."""
    text = render(replace(full, verdict="warn"))
    places = [
        text.index(s) for s in ("Usable, with warnings", "Look here", 'class="cards"', 'id="findings"', ": a note")
    ]
    assert places == sorted(places)
    assert text.count("Look here") == 1


@pytest.mark.parametrize(
    "verdict, says, says_not",
    [
        ("pass", "No check raises a doubt", "What speaks against"),
        ("warn", "What speaks against it:", "No check raises"),
        ("fail", "do not apply them", "are calibrated"),
    ],
)
def test_verdict_in_words(full: Calibration, verdict: Any, says: str, says_not: str) -> None:
    text = " ".join(Page(render(replace(full, verdict=verdict))).text)
    assert says in text and says_not not in text


# --- how far to trust it -----------------------------------------------------------------------------


def test_expected_errors_are_those_of_the_covariance(full: Calibration) -> None:
    body = render(full)
    for kind, model in full.models.items():
        assert model.covariance is not None
        size = float(np.linalg.norm(model.reference_vector)) if kind != "gyr" else 1.0
        e = expected_error(kind, model.H, model.covariance, size)
        row = re.search(rf'<th scope="row">{NAMES[kind].capitalize()}</th><td>(.*?)</td><td>(.*?)<', body)
        assert row is not None
        assert row.groups() == (degrees(e.direction_deg), degrees(e.worst_direction_deg) + " ")


def test_heading_is_a_limit_without_the_fit(full: Calibration) -> None:
    """The covariance between the two sensors is the fit's; from a file there is an upper limit."""
    known = replace(full.fits["mag"], details={"covariance_with_acc": np.zeros((12, 12))})
    error, dip, limit = heading(replace(full, fits={"mag": known})) or (0.0, 0.0, True)
    assert not limit and dip == pytest.approx(66.5, abs=0.1)
    worst, _, limit = heading(_alone(full)) or (0.0, 0.0, False)
    assert limit and worst > error > 0
    assert "upper limit" in render(_alone(full))
    assert heading(_without_magnetometer(full)) is None


def test_a_node_that_nothing_is_known_of_gets_no_ellipses(full: Calibration) -> None:
    assert full.acc is not None and full.acc.covariance is not None
    lost = replace(full.acc, covariance=1e8 * full.acc.covariance, expected_error_deg=4000.0)
    text = render(replace(full, acc=lost, gyr=None, mag=None))
    assert "not determined" in text and "do not determine" in text and 'class="balls"' not in text


@pytest.mark.parametrize("sd", [3e-7, 1e-3, 0.11, 0.7])
def test_ellipses_are_enlarged_by_a_round_factor(sd: float) -> None:
    factor = enlargement(sd)
    assert 0.08 <= factor * sd <= 0.2 + 1e-9
    assert f"{factor:.0e}"[0] in "125"


def test_ellipses_stand_in_26_directions(full: Calibration) -> None:
    u = around()
    assert len(np.unique(u, axis=0)) == 26
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1)
    assert render(full).count('class="ellipse') == 26 * 3
    assert towards((0.7, 0.0, -0.7)) == "+x −z" and towards((0.1, -0.99, 0.1)) == "−y"


def test_checks_stand_beside_their_limits(full: Calibration) -> None:
    page = Page(render(full))
    text = " ".join(page.text)
    assert "4 of 6 passed" in text
    for part in ("3.4 %", "≤ 2 %", "≥ 10", "≤ 0.5°"):
        assert part in text, part
    assert "askew" not in text  # its words are in a title
    assert any(a.get("title") == "<b>askew</b>" for _, a in page.tags)


@pytest.mark.parametrize(
    "checks", ["no", {}, [1, None], [{"code": 3, "level": "pass"}], [{"code": HOSTILE, "level": "warn", "value": "1"}]]
)
def test_checks_of_anybodys_file(full: Calibration, checks: Any) -> None:
    text = render(replace(full, settings={"checks": checks}))
    assert "<img" not in text
    Page(text)


def test_most_influential_rest_is_named(full: Calibration) -> None:
    found = influences(full)
    assert [f.kind for f in found] == list(full.models)
    for f in found:
        assert f.largest == 3
        assert f.value[2] == pytest.approx(np.sqrt(2 / 3), rel=1e-3)  # one degree about one axis, over the sphere
    text = " ".join(Page(render(full)).text)
    assert "Most influential: rest 3." in text and "leans on it" in text


def test_left_out_rests_are_drawn_as_left_out(full: Calibration) -> None:
    fits = dict(full.fits)
    residual = fits["mag"].residual.copy()
    residual[[4, 7]] = np.nan
    fits["mag"] = replace(fits["mag"], residual=residual)
    turn = "turn from rest 5 to 6 ends 31.0 degrees from where the rests lie; it was left out"
    issues = (
        Issue("turn-left-out", "warn", turn, "gyr"),
        Issue("label-left-out", "warn", "rest 9 lay 89.6 degrees from", None),
    )
    c = replace(full, fits=fits, issues=issues)
    mag, gyr = residuals(c, "mag"), residuals(c, "gyr")
    assert mag is not None and gyr is not None
    assert mag.labels == tuple(str(i + 1) for i in range(12))
    assert [t for t, out in zip(mag.labels, mag.out) if out] == ["5", "8"]
    assert np.isfinite(mag.rms) and mag.labels[mag.worst] not in ("5", "8")
    assert [t for t, out in zip(gyr.labels, gyr.out) if out] == ["5–6"] and gyr.rms < 8e-3 * np.degrees(1)
    out = {f.kind: f.out for f in influences(c)}
    assert out == {"acc": {9}, "gyr": {9}, "mag": {5, 8, 9}}
    text = render(c)
    assert text.count('class="left-out"') == 3
    assert text.count('<li class="framed">') == 1
    assert "rest 5 (its magnetometer), rest 8 (its magnetometer) and rest 9 (its attitude)" in text
    assert not re.search(r"\bnan\b", " ".join(Page(text).text))


def test_a_mirrored_magnetometer_has_the_heading_and_influence_of_a_plain_one() -> None:
    """Its H changes sign after the fit: what is told of errors must follow."""
    place = parse_at("51.5,-0.1,2026.5")
    found = []
    for axes in (None, np.diag([1.0, 1.0, -1.0])):
        simulated = simulate(seed=8, n_poses=12, rest_s=1.5, mag_axes=axes, place=place, noise=0.1, quantise=False)
        c = calibrate(simulated.recording, poses="cube", place=place)
        assert c.mag is not None and np.sign(np.linalg.det(c.mag.H)) == (1 if axes is None else -1)
        error, _, limit = heading(c) or (0.0, 0.0, True)
        assert not limit
        found.append((error, next(f.value for f in influences(c) if f.kind == "mag")))
    assert found[1][0] == pytest.approx(found[0][0], rel=0.1)
    np.testing.assert_allclose(found[1][1], found[0][1], rtol=0.3, atol=0.005)


def test_a_wrong_label_and_a_disturbed_rest_from_data_to_page() -> None:
    """The numbers are read from the words of the issues: these must keep naming the rest."""
    simulated = simulate(seed=4, n_poses=18, rest_s=2.0, wrong_label=3, disturbed=11)
    table = PoseTable(q=so3.quat_from_matrix(simulated.nominal))
    c = calibrate(simulated.recording, poses=table, level=True)
    assert left_out(c, "label-left-out") == {(4,)} and left_out(c, "pose-left-out") == {(12,)}
    found = residuals(c, "mag")
    assert found is not None and [t for t, out in zip(found.labels, found.out) if out] == ["12"]
    page = render(c)
    assert "Left out:</strong> rest 4 (its attitude) and rest 12 (its magnetometer)" in page
    assert page.count('<li class="framed">') == 1
    error, _, limit = heading(c) or (0.0, 0.0, True)
    assert 0 < error < 1 and not limit


def test_written_whole_and_never_over_something(full: Calibration, tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_report(full, path)
    assert path.read_text(encoding="utf-8") == render(full)
    with pytest.raises(InputError, match="exists"):
        write_report(full, path)
    write_report(_bare(full), path, overwrite=True)
    assert path.read_text(encoding="utf-8") == render(_bare(full))
    assert os.listdir(tmp_path) == ["report.html"]


# --- in a browser ------------------------------------------------------------------------------------

_INK = """(() => [...document.querySelectorAll("canvas")].map(c => {
    const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
    const seen = new Set(); let n = 0;
    for (let i = 0; i < d.length; i += 4) {
        if (d[i + 3] > 100) { n++; seen.add(d[i] >> 4 << 8 | d[i + 1] >> 4 << 4 | d[i + 2] >> 4); }
    }
    return [n, seen.size];
}))()"""


@pytest.mark.skipif(not Path(CHROMIUM).exists(), reason=f"no browser at {CHROMIUM}")
def test_opens_offline_in_a_browser(full: Calibration, tmp_path: Path) -> None:
    page, evil = tmp_path / "report.html", tmp_path / "evil.html"
    write_report(full, page)
    write_report(replace(full, device=HOSTILE, issues=(Issue("x", "fail", HOSTILE),)), evil)
    with Browser(tmp_path / "profile") as browser:
        for width, dark in ((1280, False), (390, True)):
            browser.open(page, width=width, dark=dark)
            assert browser.complaints() == []
            assert [u for u in browser.requests() if not u.startswith(("file:", "data:"))] == []
            assert len(browser.requests()) <= 2
            assert browser.evaluate("document.documentElement.scrollWidth") <= width
            ink = browser.evaluate(_INK)
            assert len(ink) == 2 and all(n > 2000 and colours > 5 for n, colours in ink)
        before = browser.evaluate("document.querySelector('canvas.cal').toDataURL()")
        browser.evaluate(
            "document.querySelector('canvas.cal').dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowLeft'})),"
            "new Promise(r => setTimeout(() => requestAnimationFrame(() => r(1)), 50))"
        )
        assert browser.evaluate("document.querySelector('canvas.cal').toDataURL()") != before
        assert browser.evaluate("document.querySelectorAll('button.copy:not([hidden])').length") == 2
        browser.open(evil)
        assert browser.complaints() == []
        assert browser.evaluate("document.querySelectorAll('img, script:not([type])').length") == 1
        browser.open(page, scripts=False)  # still pictures instead
        assert browser.complaints() == []
