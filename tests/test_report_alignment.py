"""The report of a calibration against motion capture: the figures are those of the alignment, the words are true."""

from __future__ import annotations

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from browser import CHROMIUM, Browser
from margcal.apps.report import render, write_report
from margcal.apps.report_alignment import figures_of, frame_pictures, masked, motion_residuals, orientation, timing
from margcal.apps.report_alignment_frames import frames, heading_words, rotation, turned, vector
from margcal.apps.report_alignment_plots import BINS, floored, rms, span_of
from margcal.apps.report_attitudes import view
from margcal.apps.report_svg import Scale, trace
from margcal.core import so3
from margcal.core.types import Alignment, Calibration
from margcal.files.calfile import load, save
from margcal.workflow.align import align
from margcal.workflow.align_job import AlignFigures, MocapAlignment
from margcal.workflow.mocap_simulation import MocapSimulation, simulate_mocap
from test_report import HOSTILE, Page

NEW = ["timing", "frames", "orientation", "motion", "masked"]
NEVER = {"attitudes", "residuals", "influence"}


@pytest.fixture(scope="module")
def simulation() -> MocapSimulation:
    return simulate_mocap(
        seed=3,
        duration_s=30,
        acceleration_rms=1.0,
        gaps=3,
        offset_s=0.137,
        drift_ppm=400,
        delays_s={"mag": 0.011},
        unit="si",
    )


@pytest.fixture(scope="module")
def aligned(simulation: MocapSimulation) -> Calibration:
    return align(simulation.recording, simulation.reference, common_clock=False)


@pytest.fixture(scope="module")
def figures(aligned: Calibration) -> AlignFigures:
    found = figures_of(aligned)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def page(aligned: Calibration) -> str:
    return render(aligned)


def _with_figures(calibration: Calibration, **changes: object) -> Calibration:
    alignment = calibration.alignment
    assert isinstance(alignment, MocapAlignment) and alignment.figures is not None
    return replace(calibration, alignment=replace(alignment, figures=replace(alignment.figures, **changes)))


def _section(page: str, name: str) -> str:
    found = re.search(rf'<section id="{name}".*?</section>', page, re.S)
    assert found is not None, name
    return found.group()


def _text(html: str) -> str:
    return " ".join(re.sub(r"<[^>]+>", " ", html.replace("−", "-")).split()).replace(" °", "°")


def _cells(html: str, row: str) -> list[str]:
    """The cells of the table row that begins with these words."""
    found = re.search(rf'<tr><th scope="row">{re.escape(row)}.*?</tr>', html, re.S)
    assert found is not None, row
    return [_text(c) for c in re.findall(r"<td>(.*?)</td>", found.group(), re.S)]


# --- the page ------------------------------------------------------------------------------------------


def test_sections_of_an_alignment_and_none_of_rests(aligned: Calibration, page: str) -> None:
    parsed = Page(page)
    assert [s for s in parsed.sections if s in NEW] == NEW
    assert not NEVER & set(parsed.sections)
    assert {"recorded", "sphere", "parameters", "checks"} <= set(parsed.sections)
    assert len(parsed.ids) == len(set(parsed.ids))
    assert not re.search(r"\b(nan|inf|None)\b", " ".join(parsed.text))
    assert '"acc"' not in _section(page, "sphere")  # an accelerometer that is moved reads no sphere
    assert "lay still" not in _section(page, "recorded")
    assert render(aligned) == page


def test_a_loaded_file_shows_the_values_without_curves(aligned: Calibration, page: str, tmp_path: Path) -> None:
    save(aligned, tmp_path / "c.json")
    loaded = load(tmp_path / "c.json")
    assert type(loaded.alignment) is Alignment
    after = render(loaded)
    assert [s for s in Page(after).sections if s in NEW] == ["timing", "frames", "masked"]
    assert _section(after, "frames") == _section(page, "frames")
    assert _cells(after, "Clock offset") == _cells(page, "Clock offset")
    assert "margcal align" in _section(after, "findings")
    assert figures_of(loaded) is None and "<svg" not in _section(after, "timing")


# --- timing --------------------------------------------------------------------------------------------


def test_timing_is_that_of_the_alignment_and_of_the_truth(aligned: Calibration) -> None:
    body = timing(aligned)
    for row, truth, floor in (("Clock offset", 137.0, 0.05), ("Clock drift", 400.0, 1.0)):
        value, se = map(float, re.findall(r"[-\d.]+", _cells(body, row)[0])[:2])
        assert abs(value - truth) < 4 * se + floor
    assert "slow by 24 ms a minute" in _text(body)  # t_ref gains 400 us in a second of t_node
    delay, se = map(float, re.findall(r"[-\d.]+", _cells(body, "Delay of the magnetometer")[0]))
    assert abs(delay - 11.0) < 4 * se
    assert "after those of the gyroscope" in _cells(body, "Delay of the magnetometer")[1]
    assert "cannot be told from the offset" in _cells(body, "Delay of the gyroscope")[1]


def test_words_of_drift_and_delay_turn_with_the_sign(aligned: Calibration) -> None:
    alignment = aligned.alignment
    assert alignment is not None and aligned.mag is not None
    turned_round = replace(
        aligned,
        alignment=Alignment(False, {**alignment.values, "drift_ppm": -50.0}),
        mag=replace(aligned.mag, delay_s=-0.02, delay_se_s=0.001),
    )
    text = _text(timing(turned_round))
    assert "fast by 3 ms a minute" in text and "come 20 ms before those of the gyroscope" in text
    unknown = replace(turned_round, mag=replace(aligned.mag, delay_s=0.0, delay_se_s=None))
    assert "taken to be the gyroscope's" in _text(timing(unknown)).replace("&#x27;", "'")


def test_common_clock_has_delays_of_every_sensor() -> None:
    s = simulate_mocap(seed=5, duration_s=30, delays_s={"gyr": 0.0045, "acc": 0.0045, "mag": 0.015}, unit="si")
    found = align(s.recording, s.reference, common_clock=True, orientation=False)
    page = render(found)
    assert "no offset, no drift" in _text(_section(page, "timing"))
    delay, se = map(float, re.findall(r"[-\d.]+", _cells(page, "Delay of the gyroscope")[0]))
    assert abs(delay - 4.5) < 4 * se + 0.05
    assert "orientation" not in Page(page).sections
    assert "after those of the optics" in _cells(page, "Delay of the magnetometer")[1]


def test_correlation_has_its_peak_at_the_line(aligned: Calibration, figures: AlignFigures) -> None:
    body = timing(aligned)
    at = figures.lags[np.argmax(figures.correlation)]
    line = re.search(r'<svg x="([\d.]+)%" overflow="visible"><line class="taken"', body)
    assert line is not None
    span = figures.lags[-1] - figures.lags[0]
    assert abs(float(line.group(1)) / 100 - (at - figures.lags[0]) / span) < 0.03 / span
    across, value = Scale(figures.lags[0], figures.lags[-1]), Scale(0.0, 1.04)
    assert trace(figures.lags, figures.correlation, across, value, BINS) in body


def test_a_share_is_not_rounded_up_to_the_whole() -> None:
    assert floored(0.99999, 4) == "0.9999" and floored(1.0, 2) == "1.00" and floored(float("nan"), 2) == "–"


# --- frames --------------------------------------------------------------------------------------------


def test_frames_are_told_as_they_were_simulated(aligned: Calibration, simulation: MocapSimulation) -> None:
    truth = simulation.gyr_symmetric.alignment
    assert truth is not None
    text = _text(frames(aligned.alignment.values if aligned.alignment else {}))
    angle = np.degrees(np.linalg.norm(so3.quat_log(truth.values["marker_to_node"])))
    found = re.search(r"marker body is turned by ([\d.]+) ?° against the node", text)
    assert found is not None and abs(float(found.group(1)) - angle) < 0.1
    north = re.search(r"its \+y axis points ([\d.]+) ?° west of magnetic north", text)
    bearing = np.degrees(np.arctan2(simulation.R_nm[0, 1], simulation.R_nm[1, 1]))
    assert bearing < 0 and north is not None and abs(float(north.group(1)) + bearing) < 0.5
    lever = re.search(r"([\d.]+) ± [\d.]+ mm along \+x, ([\d.]+) ± [\d.]+ mm along -y and ([\d.]+)", text)
    assert lever is not None
    np.testing.assert_allclose([float(v) for v in lever.groups()], [30, 20, 10], atol=0.7)


@pytest.mark.parametrize(
    ("turn", "words"),
    [
        ([0.0, 0.0, np.radians(1.0)], "is turned by 1.00° against the node, about its +z axis"),
        ([0.0, -np.pi / 2, 0.0], "is turned by 90° against the node, about its -y axis"),
        ([0.0, 0.0, 0.0], "lies parallel to the node"),
        (np.radians([12.0, 16.0, 0.0]), "is turned by 20° against the node, about the direction (0.60, 0.80, 0.00)"),
    ],
)
def test_a_turn_in_words(turn: list[float], words: str) -> None:
    assert words in _text(turned(so3.exp(turn), "marker body", "node"))


def test_a_turn_within_its_error_has_no_axis() -> None:
    R, se = so3.exp([0.0, 0.0, np.radians(0.2)]), np.radians([0.1, 0.1, 0.1])
    assert "0.20° against the node; with a standard error of 0.17°" in _text(turned(R, "marker body", "node", se))
    assert "about its +z axis" in _text(turned(R, "marker body", "node", se / 3))


def test_laboratories_of_all_kinds_in_words() -> None:
    east_of_north = so3.exp([0.0, 0.0, -np.radians(30.0)])  # y of the laboratory 30 degrees clockwise from north
    assert "+z axis points up, exactly along the vertical; its +y axis points 30° east" in _text(
        heading_words(east_of_north)
    )
    y_up = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # x east, y up, z south
    text = _text(heading_words(so3.exp([0.0, np.radians(2.0), 0.0]) @ y_up))
    assert "Its +y axis points up, 2.00° off the vertical; its -z axis points" in text
    z_down = np.diag([1.0, -1.0, -1.0])
    assert "Its -z axis points up" in _text(heading_words(z_down))


def test_axes_are_drawn_where_they_point() -> None:
    R = so3.exp([0.4, -0.3, 1.1])
    body = frames({"marker_to_node": so3.quat_from_matrix(R)})
    drawn = body.split("<svg")[2]
    ends = {}
    for a in "xyz":
        arrow = re.search(rf'class="axis axis-{a}" d="M(\S+) (\S+)L(\S+) ([\d.-]+)', drawn)
        assert arrow is not None
        x0, y0, x1, y1 = map(float, arrow.groups())
        ends[a] = (x1 - x0, y0 - y1)
    seen = view() @ R  # rows right and up of the picture
    size = ends["x"][0] / seen[0, 0]
    for k, a in enumerate("xyz"):
        np.testing.assert_allclose(ends[a], size * seen[:2, k], atol=0.11)


def test_without_a_magnetometer_there_is_no_earth(simulation: MocapSimulation) -> None:
    recording = replace(simulation.recording, mag=None)
    found = align(recording, simulation.reference, common_clock=False)
    body = frame_pictures(found)
    assert "Marker body" in body and "Lever arm" in body and "Laboratory and earth" not in body
    only = align(replace(recording, acc=None), simulation.reference, common_clock=False)
    assert set(NEW) & set(Page(render(only)).sections) == {"timing", "frames", "motion", "masked"}
    assert "Lever arm" not in frame_pictures(only) and "what is left" not in motion_residuals(only)


@pytest.mark.parametrize("value", [[0, 0, 0, 0], [1e300, 0, 0, 0], [np.nan] * 4, [1, 0, 0], None])
def test_what_is_no_rotation_is_not_drawn(value: list[float] | None) -> None:
    assert rotation(value) is None
    assert frames({"marker_to_node": value, "lever_arm_m": [np.inf, 0, 0]}) == ""


def test_nonsense_in_a_file_does_no_harm(aligned: Calibration) -> None:
    values = {"offset_s": 1e308, "drift_ppm": -1e308, "marker_to_node": [0, 0, 0, 0], "lever_arm_m": [1e300, 0, 0]}
    odd = replace(aligned, alignment=Alignment(False, values), settings={"alignment": HOSTILE}, recordings=(), fits={})
    parsed = Page(render(odd))
    assert "frames" not in parsed.sections and all("alert" not in s for s in parsed.scripts)
    for told in ({"correlation": HOSTILE, "reference_seen": float("inf")}, {"reference_seen": True}, []):
        other = replace(odd, settings={"alignment": told})
        assert "Correlation" not in timing(other) and "samples were used" not in masked(other)
    assert vector([1.0, 2.0, 3.0], largest=2.5) is None


# --- over time -----------------------------------------------------------------------------------------


def test_residuals_before_and_after(page: str, figures: AlignFigures) -> None:
    body = _section(page, "motion")
    before, after = (float(_cells(body, f"Gyroscope less optics, {n}")[0].split("°")[0]) for n in ("before", "after"))
    assert before == pytest.approx(np.degrees(rms(figures.rate_before)), rel=5e-3) and before > 3 * after
    assert after == pytest.approx(np.degrees(rms(figures.rate_after)), rel=5e-3)
    acc = float(_cells(body, "Accelerometer, what is left")[0].split()[0])
    assert acc == pytest.approx(np.sqrt(np.nanmean(figures.residual["acc"] ** 2)), rel=5e-3)
    assert body.count('<rect class="masked"') == 4 * len(figures.masked)


def test_counts_have_no_before() -> None:
    s = simulate_mocap(seed=4, duration_s=30)
    found = align(s.recording, s.reference, common_clock=False, method="r-bsn")
    page = render(found)
    body = _section(page, "motion")
    assert "raw counts say nothing" in body and "less optics, before" not in body and "less optics, after" in body
    assert "A filter cannot run" not in page and "Before:" not in _text(body.split("figcaption")[1])


def test_orientation_error_before_and_after(aligned: Calibration, page: str, figures: AlignFigures) -> None:
    pytest.importorskip("vqf")
    before, after = figures.before, figures.after
    assert before is not None and after is not None
    body = _section(page, "orientation")
    shown = [float(c.rstrip("°")) for c in _cells(body, "Total")]
    assert shown == pytest.approx([before.total, after.total], rel=6e-3)
    assert "down from" in body and body.count('<path class="before"') == body.count('<path class="after"') == 1
    worse = _with_figures(aligned, before=replace(after, total=0.5))
    assert ", up from" in orientation(worse)
    alone = orientation(_with_figures(aligned, before=None))
    assert "raw counts" in alone and '<path class="before"' not in alone


def test_masked_stretches_are_drawn_and_listed(aligned: Calibration, page: str, figures: AlignFigures) -> None:
    body = _section(page, "masked")
    assert f"{floored(100 * figures.seen, 2)} %" in body and "reference-gaps" in body
    drawn = re.findall(r'<rect class="lost" x="([\d.]+)%" width="([\d.]+)%"', body)
    span = span_of(figures)
    expected = [(100 * float(span(a)), 100 * (b - a) / (span.high - span.low)) for a, b in figures.masked]
    np.testing.assert_allclose(np.array(drawn, dtype=float), expected, atol=0.01)
    assert len(re.findall(r'<tr><th scope="row">[\d.]+ s</th>', body)) == len(figures.masked) >= 2
    many = tuple((0.5 * k, 0.5 * k + 0.2) for k in range(40))
    assert "28 further stretches" in masked(_with_figures(aligned, masked=many))
    whole = masked(_with_figures(aligned, masked=(), seen=1.0))
    assert "100.00 %" in whole and "<rect" not in whole


# --- from the command line, and in a browser -----------------------------------------------------------


def _write(path: Path, columns: dict[str, np.ndarray]) -> None:
    with open(path, "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(columns)
        table.writerows(np.column_stack(list(columns.values())).tolist())


def test_verbs_write_it(simulation: MocapSimulation, tmp_path: Path) -> None:
    from margcal.apps.cli import cli

    node = {"t_s": simulation.recording.streams["gyr"].t}
    for kind, unit in (("acc", "mps2"), ("gyr", "radps"), ("mag", "uT")):
        y = simulation.recording.streams[kind].y  # type: ignore[index]
        node |= {f"{kind}_{a}_{unit}": y[:, k] for k, a in enumerate("xyz")}
    reference = simulation.reference
    optics = {"t_s": reference.t} | {f"ref_q{a}": reference.q[:, k] for k, a in enumerate("wxyz")}
    _write(tmp_path / "node.csv", node)
    _write(tmp_path / "optics.csv", optics)
    names = {n: str(tmp_path / n) for n in ("node.csv", "optics.csv", "c.json", "a.html", "b.html", "c.html")}
    given = [names["node.csv"], "--reference", names["optics.csv"], "-o", names["c.json"], "--report", names["a.html"]]
    result = CliRunner().invoke(cli, ["align", *given])
    assert result.exit_code == 0, result.output
    assert {"timing", "frames", "motion", "masked"} <= set(Page(Path(names["a.html"]).read_text()).sections)
    for recordings, out in (([], "b.html"), ([names["node.csv"]], "c.html")):
        result = CliRunner().invoke(cli, ["report", names["c.json"], *recordings, "-o", names[out]])
        assert result.exit_code == 0, result.output
        sections = set(Page(Path(names[out]).read_text()).sections)
        assert {"timing", "frames", "masked"} <= sections and not {"motion", "residuals", "attitudes"} & sections


_SMALL = """[...document.querySelectorAll('#timing, #frames, #orientation, #motion, #masked')].flatMap(s =>
    [...s.querySelectorAll('svg text')].filter(t => t.getBoundingClientRect().width > 0)
    .map(t => t.getBoundingClientRect().height)).filter(h => h < 10).length"""
_OUTSIDE = """[...document.querySelectorAll('.triads svg')].flatMap(s => { const b = s.getBoundingClientRect();
    return [...s.querySelectorAll('text, path')].filter(t => { const r = t.getBoundingClientRect();
        return r.left < b.left || r.right > b.right || r.top < b.top || r.bottom > b.bottom; }); }).length"""
_WIDE = """[...document.querySelectorAll('#timing .scroll, #frames .scroll, #motion .scroll, #masked .scroll')]
    .filter(e => e.scrollWidth > e.clientWidth + 1).length"""


@pytest.mark.skipif(not Path(CHROMIUM).exists(), reason=f"no browser at {CHROMIUM}")
def test_is_legible_in_a_browser(aligned: Calibration, tmp_path: Path) -> None:
    turned_over = {"marker_to_node": [0.02, 0.999, 0.03, 0.01], "lab_to_earth": [0.5, 0.5, 0.5, 0.5]}
    assert aligned.alignment is not None
    values = {**aligned.alignment.values, **turned_over, "lever_arm_m": [-0.2, 0.1, -0.3]}
    other = replace(aligned, alignment=replace(aligned.alignment, values=values))
    for name, calibration in (("page", aligned), ("other", other)):
        write_report(calibration, tmp_path / f"{name}.html")
    with Browser(tmp_path / "profile") as browser:
        for name, width, dark in (("page", 1280, False), ("page", 390, True), ("other", 390, False)):
            browser.open(tmp_path / f"{name}.html", width=width, dark=dark)
            assert browser.complaints() == []
            assert browser.evaluate("document.documentElement.scrollWidth") <= width
            assert browser.evaluate("document.querySelectorAll('.triads svg').length") == 5
            assert (browser.evaluate(_SMALL), browser.evaluate(_OUTSIDE), browser.evaluate(_WIDE)) == (0, 0, 0)
