"""The top of the page: the verdict in a sentence, and a card with the decisive figures of each sensor."""

from __future__ import annotations

from margcal.apps.report_data import residuals
from margcal.apps.report_expected import FULL_CIRCLE_DEG, angle, heading, told
from margcal.apps.report_findings import finding_list
from margcal.apps.report_text import NAMES, degrees, esc, listing, number, plural
from margcal.core.types import Calibration, Issue, Kind, SensorModel
from margcal.core.units import KINDS

FRAMES = {
    "housing": "the axes of the housing",
    "marker": "the axes of the marker body",
    "acc-triangular": "the accelerometer's own axes",
    "gyr-symmetric": "the axes in which the gyroscope's matrix is symmetric",
}
VERDICTS = {"pass": "Passed", "warn": "Usable, with warnings", "fail": "Failed: do not use"}


def masthead(calibration: Calibration) -> str:
    """Name, sentence and cards."""
    device = calibration.device
    cards = "".join(_card(calibration, kind, model) for kind, model in calibration.models.items())
    when = _date(calibration.created)
    return (
        f'<div class="strip"><span class="brand">margcal</span><span>Calibration report</span>{when}</div>'
        f"<h1>{esc(device, 120) if device else 'Sensor node'}</h1>"
        f'<p class="verdict">{_chip(calibration)}{sentence(calibration)}</p>{_reasons(calibration)}'
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
        why = "; the reasons below say what to record next" if _serious(calibration) else ""
        return f"No sensor could be calibrated{why}."
    names = listing(NAMES[k] for k in models)
    one = len(models) == 1
    if calibration.verdict == "fail":
        return (
            f"The recording cannot carry what was asked for. The numbers of the {names} are what came out all the "
            f"same{_from_what(calibration)}: look at them, do not apply them.{_lost(calibration)}"
        )
    text = f"{names.capitalize()} {'is' if one else 'are'} calibrated{_from_what(calibration)}, {_frame(calibration)}."
    return f"{text} {_how_good(calibration)}{_node(calibration)}{_lost(calibration)}{_doubts(calibration)}"


def _lost(calibration: Calibration) -> str:
    lost = {i.sensor for i in calibration.issues if i.level == "fail"} - set(calibration.models)
    names = [NAMES[k] for k in KINDS if k in lost]
    return f" The {listing(names)} could not be calibrated." if names else ""


def _doubts(calibration: Calibration) -> str:
    """What the verdict hangs on, before the reasons are listed."""
    if calibration.verdict == "pass":
        return " No check raises a doubt."
    if calibration.verdict == "warn" and _serious(calibration):
        return " What speaks against it:"
    if calibration.verdict == "warn":
        return " The verdict is a warning because not every sensor's uncertainty is known."
    return ""


def _node(calibration: Calibration) -> str:
    """What a user of the node gets at rest: tilt and heading."""
    errors, found = told(calibration), heading(calibration)
    if "acc" not in errors or found is None:
        return ""
    error, _, limit = found
    return (
        f" At rest, expect a tilt true within {angle(errors['acc'].direction_deg)} and a heading true within "
        f"{angle(error)} rms{' at most' if limit else ''}."
    )


def _serious(calibration: Calibration) -> list[Issue]:
    return [i for i in calibration.issues if i.level in ("fail", "warn")]


def _reasons(calibration: Calibration) -> str:
    """Failures and warnings, right under the verdict."""
    serious = _serious(calibration)
    return f'<div class="reasons">{finding_list(serious)}</div>' if serious else ""


def _how_good(calibration: Calibration) -> str:
    models = calibration.models
    known: dict[Kind, float] = {k: m.expected_error_deg for k, m in models.items() if m.expected_error_deg is not None}
    if not known:
        return "How true its directions are is not known: there is no covariance to tell it from."
    if max(known.values()) >= FULL_CIRCLE_DEG:
        return "The data do not determine its directions."
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
    rows = [*_errors(calibration, kind), ("Residual, rms", _residual(calibration, kind, model))]
    if model.n_poses is not None:
        rows.append(("Rests", str(model.n_poses)))
    if model.method:
        rows.append(("Method", esc(model.method, 40)))
    details = "".join(f"<div><dt>{k}</dt><dd>{v}</dd></div>" for k, v in rows if v)
    value = "–" if model.expected_error_deg is None else angle(model.expected_error_deg)
    caption = "expected direction error, rms" if model.expected_error_deg is not None else "direction error not known"
    return (
        f'<article class="card"><h2>{NAMES[kind].capitalize()}</h2><p class="figure">{value}</p>'
        f'<p class="caption">{caption}</p><dl>{details}</dl></article>'
    )


def _errors(calibration: Calibration, kind: Kind) -> list[tuple[str, str]]:
    found = told(calibration).get(kind)
    if found is None:
        return []
    size = f"{number(found.magnitude_percent, 2)} %" if found.magnitude_percent < 100 else "not determined"
    return [("Worst direction", angle(found.worst_direction_deg)), ("Expected magnitude error", size)]


def _residual(calibration: Calibration, kind: Kind, model: SensorModel) -> str:
    from margcal.apps.report_data import shown_unit

    factor, unit = shown_unit(model)
    if kind == "gyr" and calibration.alignment is not None and model.n_poses is None:
        unit = "°/s"  # of every sample, not of turns
    found = residuals(calibration, kind)
    if found is not None and found.out.any():
        value = found.rms  # of what was not left out
    elif model.residual_rms is not None:
        value = factor * model.residual_rms
    elif found is not None:
        value = found.rms
    else:
        return ""
    space = "" if unit == "°" else " "
    return f"{number(value, 3)}{space}{unit}"
