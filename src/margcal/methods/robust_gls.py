"""`gls_ml` of one sensor without the poses that contradict the others: wrong labels, disturbed readings.

Not in the papers. The pose that the fit would most like to lose (largest deletion chi-square) is left out, the
fit is made anew, and the pose is tested against its prediction, with the uncertainty of both: does it miss by more
than the largest of J such misfits does by chance? Then the next one is looked at. Two bad poses may hide each
other, since the first is judged by a fit that holds the second; so the search goes on a little after a pose that
passes, and the last pose that fails decides how many are out (Rosner, Technometrics 25, 1983). Of these, any that
agrees with the final fit is taken in again. Several sensors of one node share their attitudes; `workflow.robust`
does the like for them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from margcal.core.types import Array, Fit, Kind
from margcal.methods.affine import checked_readings, checked_rotations
from margcal.methods.gls import gls_ml

FALSE_ALARM = 0.005
"""Probability that a pose is left out of faultless data."""
MAX_SHARE = 0.3
"""Share of the poses that may be left out; beyond, the data contradict the model."""
LOOK_AHEAD = 1
"""Poses that may pass before the search ends."""
MIN_LEFT = 10
"""Poses that must remain."""


@dataclass(frozen=True)
class RobustGls:
    """The fit of the poses that agree.

    Attributes
    ----------
    fit : Fit, of `gls_ml`
    left_out : ndarray (..., J) of bool
    chi2 : ndarray (..., J)
        Misfit to the prediction from the other poses, of those that were left out, else NaN.
    limit : ndarray (..., J)
        What `chi2` was compared with, else NaN.
    contradictory : ndarray (...,) of bool
        Poses still contradict each other, but no more may be left out.
    """

    fit: Fit
    left_out: NDArray[np.bool_]
    chi2: Array
    limit: Array
    contradictory: NDArray[np.bool_]


def robust_gls(
    y: ArrayLike,
    R: ArrayLike,
    magnitude: float,
    *,
    kind: Kind = "acc",
    raw_unit: str = "count",
    unit: str = "",
    noise_sd: ArrayLike | None = None,
    s_rot: float | None = None,
) -> RobustGls:
    """`gls_ml` without the poses that contradict the others.

    Parameters
    ----------
    y, R, magnitude, kind, raw_unit, unit, noise_sd, s_rot
        See `gls_ml`; leading axes are nodes.

    Raises
    ------
    DataError
        See `gls_ml`.
    """
    y = checked_readings(y, kind)
    R = checked_rotations(R, y.shape[-2])
    J = y.shape[-2]
    lead = np.broadcast_shapes(y.shape[:-2], R.shape[:-3])
    nodes = np.broadcast_to(y, (*lead, J, 3)).reshape(-1, J, 3)
    turns = np.broadcast_to(R, (*lead, J, 3, 3)).reshape(-1, J, 3, 3)
    noise = None if noise_sd is None else np.broadcast_to(np.asarray(noise_sd, float), (*lead, J, 3)).reshape(-1, J, 3)

    def fit_of(index: NDArray[np.intp], use: NDArray[np.bool_]) -> Fit:
        own = None if noise is None else noise[index]
        return gls_ml(nodes[index], turns[index], magnitude, kind=kind, noise_sd=own, s_rot=s_rot, use=use)

    use, contradictory = _search(fit_of, len(nodes), J)
    use, chi2, limit = _taken_in_again(fit_of, use)
    fit = gls_ml(
        y,
        R,
        magnitude,
        kind=kind,
        raw_unit=raw_unit,
        unit=unit,
        noise_sd=noise_sd,
        s_rot=s_rot,
        use=use.reshape(*lead, J),
    )
    shape = (*lead, J)
    return RobustGls(fit, ~use.reshape(shape), chi2.reshape(shape), limit.reshape(shape), contradictory.reshape(lead))


_FitOf = Callable[[NDArray[np.intp], NDArray[np.bool_]], Fit]
"""(nodes, poses that count) -> their fit."""


def _search(fit_of: _FitOf, n: int, J: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Poses (n, J) that agree, and the nodes at which more are bad than may be left out."""
    use = np.ones((n, J), dtype=bool)
    contradictory = np.zeros(n, dtype=bool)
    most = min(int(MAX_SHARE * J), J - MIN_LEFT)
    active, trial_use, passed = np.arange(n), use.copy(), np.zeros(n, dtype=int)
    deletion = fit_of(active, trial_use).details["deletion"]
    while len(active):
        row = np.arange(len(active))
        suspect = np.argmax(np.where(trial_use, deletion, -np.inf), axis=1)
        trial_use[row, suspect] = False
        out = J - trial_use.sum(axis=1)
        trial = fit_of(active, trial_use)
        bad = trial.details["deletion"][row, suspect] > largest_misfit(J - out + 1, trial.details["dof"])
        contradictory[active[bad & (out > most)]] = True
        found = bad & (out <= most)
        use[active[found]] = trial_use[found]
        passed = np.where(bad, 0, passed + 1)
        on = (passed <= LOOK_AHEAD) & (out <= most)
        active, trial_use, passed, deletion = active[on], trial_use[on], passed[on], trial.details["deletion"][on]
    return use, contradictory


def _taken_in_again(fit_of: _FitOf, use: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], Array, Array]:
    """`use` with what agrees with the final fit after all; misfit and limit of what stays out."""
    use = use.copy()
    chi2, limit = np.full(use.shape, np.nan), np.full(use.shape, np.nan)
    some = np.flatnonzero(~use.all(axis=1))
    if not len(some):
        return use, chi2, limit
    details = fit_of(some, use[some]).details
    allowed = np.broadcast_to(largest_misfit(use[some].sum(axis=1) + 1, details["dof"])[:, None], use[some].shape)
    out = ~use[some] & (details["deletion"] > allowed)
    use[some] = ~out
    chi2[some] = np.where(out, details["deletion"], np.nan)
    limit[some] = np.where(out, allowed, np.nan)
    return use, chi2, limit


def largest_misfit(n: Array, dof: Array) -> Array:
    """Limit for the largest of `n` misfits, chi-squares of 3 whose scale was estimated with `dof` (3 F(3, dof)).

    Quantile of F by Paulson's cube root (Annals of Mathematical Statistics 13, 1942), good to a few per cent.
    """
    z = np.array([NormalDist().inv_cdf(1 - FALSE_ALARM / k) for k in np.ravel(n)]).reshape(np.shape(n))
    a, b = 2 / 27, 2 / (9 * np.maximum(dof, 3.0))
    # F^(1/3) = x solves  ((1 - b) x - (1 - a))^2 = z^2 (b x^2 + a)
    p, q, r = (1 - b) ** 2 - z * z * b, (1 - a) * (1 - b), (1 - a) ** 2 - z * z * a
    return np.where(p > 0, 3 * ((q + np.sqrt(np.maximum(q * q - p * r, 0.0))) / np.where(p > 0, p, 1.0)) ** 3, math.inf)
