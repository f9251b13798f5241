"""The top of the page: the verdict in a sentence, and a card with the decisive figures of each sensor."""

from __future__ import annotations

from margcal.apps.report_data import residuals
from margcal.apps.report_expected import angle, heading, told
from margcal.apps.report_findings import finding_list
from margcal.apps.report_text import NAMES, degrees, esc, listing, number, plural
from margcal.core.types import Calibration, Kind, SensorModel
from margcal.core.units import KINDS

FRAMES = {
    "housing": "the axes of the housing",
    "marker": "the axes of the marker body",
    "acc-triangular": "the accelerometer's own axes",
    "gyr-symmetric": "the axes in which the gyroscope's matrix is symmetric",
}
VERDICTS = {"pass": "Passed", "warn": "Passed with warnings", "fail": "Failed"}


def masthead(calibration: Calibration) -> str:
    """Name, sentence and cards."""
    device = calibration.device
    cards = "".join(_card(calibration, kind, model) for kind, model in calibration.models.items())
    when = _date(calibration.created)
    return (
        f'<div class="strip"><span class="brand">margcal</span><span>Calibration report</span>{when}</div>'
        f"<h1>{esc(device, 120) if device else 'Sensor node'}</h1>"
        f'<p class="verdict">{_chip(calibration)}{sentence(calibration)}</p>'
        f'<div class="cards">{cards}</div>'
    )


def _date(created: str | None) -> str:
    if not created:
        return ""
    zone = " UTC" if created.endswith(("Z", "+00:00")) else ""
    return f'<time class="date">{esc(created[:16].replace("T", " "))}{zone}</time>'


def _chip(calibration: Calibration) -> str:
    verdict = calibration.verdict
    return f'<strong class="chip {verdict}">{VERDICTS[verdict]}</strong> ' if verdict in VERDICTS else ""


def sentence(calibration: Calibration) -> str:
    """What was calibrated and how good it is, in a sentence or two (HTML)."""
    models = calibration.models
    if not models:
        return "No sensor could be calibrated; the findings below say why and what to record next."
    names = listing(NAMES[k] for k in models).capitalize()
    text = f"{names} {'is' if len(models) == 1 else 'are'} calibrated{_from_what(calibration)}, {_frame(calibration)}."
    return f"{text} {_how_good(calibration)}{_left_out(calibration)}"


def _left_out(calibration: Calibration) -> str:
    lost = {i.sensor for i in calibration.issues if i.level == "fail"} - set(calibration.models)
    names = [NAMES[k] for k in KINDS if k in lost]
    return f" The {listing(names)} could not be calibrated; the findings say why." if names else ""


def _how_good(calibration: Calibration) -> str:
    models = calibration.models
    known: dict[Kind, float] = {k: m.expected_error_deg for k, m in models.items() if m.expected_error_deg is not None}
    if not known:
        return "How true its directions are is not known: there is no covariance to tell it from."
    within = f"within {degrees(max(known.values()))} rms"
    if len(known) == len(models):
        return f"Directions are expected to be true {within}{' for every sensor' if len(models) > 1 else ''}."
    unknown = listing(NAMES[k] for k in models if k not in known)
    return (
        f"Directions of the {listing(NAMES[k] for k in known)} are expected to be true {within}; of the {unknown} "
        "it is not known."
    )


def _from_what(calibration: Calibration) -> str:
    rests = max((m.n_poses or 0 for m in calibration.models.values()), default=0)
    return f" from {plural(rests, 'rest')}" if rests else ""


def _frame(calibration: Calibration) -> str:
    frame = FRAMES.get(calibration.frame, f"the frame “{esc(calibration.frame, 60)}”")
    return f"in one common frame: {frame}" if len(calibration.models) > 1 else f"in {frame}"


def _card(calibration: Calibration, kind: Kind, model: SensorModel) -> str:
    rows = [("Residual, rms", _residual(calibration, kind, model))]
    if model.n_poses is not None:
        rows.append(("Rests", str(model.n_poses)))
    if model.method:
        rows.append(("Method", esc(model.method, 40)))
    details = "".join(f"<div><dt>{k}</dt><dd>{v}</dd></div>" for k, v in rows if v)
    value = degrees(model.expected_error_deg)
    caption = "expected direction error, rms" if model.expected_error_deg is not None else "direction error not known"
    return (
        f'<article class="card"><h2>{NAMES[kind].capitalize()}</h2><p class="figure">{value}</p>'
        f'<p class="caption">{caption}</p><dl>{details}</dl></article>'
    )


def _residual(calibration: Calibration, kind: Kind, model: SensorModel) -> str:
    from margcal.apps.report_data import shown_unit

    factor, unit = shown_unit(model)
    found = residuals(calibration, kind)
    if model.residual_rms is not None:
        value = factor * model.residual_rms
    elif found is not None:
        value = found.rms
    else:
        return ""
    space = "" if unit[0] == "°" else " "
    return f"{number(value, 3)}{space}{unit}"
