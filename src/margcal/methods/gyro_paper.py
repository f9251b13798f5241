"""The gyroscope's transformation matrix by Z-TIE's unscented Kalman filter (42)-(45), and its baselines on (43).

Z.-Q. Zhang, "Two-step calibration methods for miniature inertial and magnetic sensor units", IEEE Trans. Ind.
Electron. 62(6), 2015, section II.C.2.

============  ====================  ==============================================================  ===============
name here     symbol                meaning                                                         shape
============  ====================  ==============================================================  ===============
q             Q(R_j^{j+1})          known rotation of each turn as a quaternion (scalar first)      (..., T, 4)
X             X_k                   unfolded H_g, row by row                                        (..., 9)
R_v, R_w      R_v, R_w              covariances of process and measurement noise                    scalars (x I)
y, dt         y_g^{j,1:N_j}         readings of the turns, padded                                   (..., T, N, 3)
============  ====================  ==============================================================  ===============

R_j^{j+1} is R_before_after (dR; see `preintegration`). All start from a nominal H and keep every iterate in
``history['H']``. These are the paper's methods for the paper's figures; `gyro.gauss_newton` is the better
one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from margcal.core import kalman, so3
from margcal.core.types import Array, Fit, SensorModel, Turn
from margcal.methods.preintegration import TurnBatch, integrate_quat, pad, preintegrate

CITES = "Z-TIE II.C.2, (42)-(45)"


def labels(turns: Sequence[Turn] | TurnBatch, dR: ArrayLike, H: ArrayLike, B: ArrayLike | None = None) -> Array:
    """Quaternions Q(R_j^{j+1}) (..., T, 4) of known rotations, on the branch on which Int of (42) runs with H.

    Notes
    -----
    not in the paper: q and -q are the same rotation but not the same label. The sign is fixed once, here,
    from the motion integrated with the nominal H; turning it towards the state at every iteration shrinks the
    basin of attraction from 100 to 75 per cent of starts.
    """
    batch = pad(turns)
    H = np.asarray(H, dtype=np.float64)
    q = so3.quat_from_matrix(dR)
    path = integrate_quat(batch.y, batch.dt, H if H.ndim == 2 else H[..., None, :, :], _wide(B))
    return np.where(np.sum(q * path, axis=-1, keepdims=True) < 0, -q, q)


def _wide(B: ArrayLike | None) -> Array:
    """Bias with an axis for the turns."""
    return np.zeros(3) if B is None else np.asarray(B, dtype=np.float64)[..., None, :]


def _measure(batch: TurnBatch, B: ArrayLike | None) -> Callable[[Array], Array]:
    """h of (45): unfolded H (..., s, 9) -> stacked quaternions of all turns (..., s, 4 T)."""
    y, dt = batch.y[..., None, :, :, :], batch.dt[..., None, :, :]
    bias = None if B is None else np.asarray(B, dtype=np.float64)[..., None, None, :]

    def h(X: Array) -> Array:
        H = X.reshape(*X.shape[:-1], 1, 3, 3)
        q = integrate_quat(y, dt, H, bias)
        return q.reshape(*q.shape[:-2], -1)

    return h


def ukf(
    turns: Sequence[Turn] | TurnBatch,
    dR: ArrayLike | None = None,
    *,
    H0: ArrayLike,
    B: ArrayLike | None = None,
    q: ArrayLike | None = None,
    n_iter: int = 50,
    R_v: float = 1e-1,
    R_w: float = 1e-7,
    P0: float | None = None,
    sigma: kalman.Sigma | None = None,
    scale: float = 1.0,
    raw_unit: str = "count",
) -> Fit:
    """H of the gyroscope by the unscented Kalman filter of Z-TIE (44)-(45), verbatim.

    Parameters
    ----------
    turns : sequence of Turn, or TurnBatch of (..., T, N, 3)
        Leading axes are independent data sets, filtered side by side.
    dR : array_like (..., T, 3, 3)
        R_before_after of each turn. May be left out when `q` is given.
    H0 : array_like (3, 3) or (..., 3, 3), rad/s per raw unit
        Start.
    B : array_like (..., 3), raw unit
        Combined bias of (41), taken as known.
    q : array_like (..., T, 4), optional
        Labels Q(R_j^{j+1}) where their sign is known; else `labels` fixes it with H0.
    n_iter : int
        Iterations: each one predicts by (44) and corrects by all turns at once (45).
    R_v, R_w : float
        The paper's settings: process noise 1e-1 I, measurement noise 1e-7 I.
    P0 : float, optional
        Covariance P0 I of the start; default R_v. The first prediction adds R_v to it.
    sigma : kalman.Sigma
        Sigma points, default alpha 1e-3, beta 2, kappa 0 (the paper says none of them; alpha = 1 is 40-75 %
        worse).

    scale : float, rad/s per raw unit
        not in the paper: the filter works on H / scale. R_v is tuned for an H of order one, so readings in
        counts or degrees need their nominal scale here.

    Returns
    -------
    Fit
        `history['H']` (n_iter + 1, ..., 3, 3); `residual` (..., T) rad; `cost` is (43); `covariance` None:
        with R_w chosen by hand, the filter's P is not one.
    """
    batch = pad(turns)
    start = np.asarray(H0, dtype=np.float64)
    known = labels(batch, np.asarray(dR), start, B) if q is None else np.asarray(q, dtype=np.float64)
    lead = known.shape[:-2]
    z = known.reshape(*lead, -1)
    bias = None if B is None else scale * np.asarray(B, dtype=np.float64)
    h = _measure(TurnBatch(scale * batch.y, batch.dt), bias)
    X = np.broadcast_to(start / scale, (*lead, 3, 3)).reshape(*lead, 9)
    P = np.broadcast_to((R_v if P0 is None else P0) * np.eye(9), (*lead, 9, 9))
    Q, R = R_v * np.eye(9), R_w * np.eye(z.shape[-1])
    iterates = [X]
    for _ in range(n_iter):
        X, P = kalman.predict(X, P, np.eye(9), Q)  #                                                       (44)
        X, P, *_rest = kalman.unscented_correct(X, P, z, h, R, sigma)  #                                   (45)
        iterates.append(X)
    history = scale * np.stack(iterates).reshape(-1, *lead, 3, 3)
    return _fit(batch, known, history, B, "ukf", raw_unit)


def _fit(batch: TurnBatch, q: Array, history: Array, B: ArrayLike | None, method: str, raw_unit: str) -> Fit:
    """A `Fit` of the last iterate."""
    H = history[-1]
    image = integrate_quat(batch.y, batch.dt, H[..., None, :, :], _wide(B))
    residual = np.linalg.norm(so3.quat_log(so3.quat_multiply(so3.quat_conjugate(q), image)), axis=-1)
    cost = np.sum((q - image) ** 2, axis=(-2, -1))  #                                                      (43)
    step = np.linalg.norm(history[-1] - history[-2], axis=(-2, -1)) / np.linalg.norm(H, axis=(-2, -1))
    settled = bool(np.all(step < 1e-3))
    bias = np.broadcast_to(np.zeros(3) if B is None else np.asarray(B, dtype=np.float64), H.shape[:-1])
    rms = float(np.sqrt(np.mean(residual**2))) if H.ndim == 2 else None
    model = SensorModel("gyr", H, bias, raw_unit, residual_rms=rms, n_poses=q.shape[-2], method=method)
    text = "" if settled else f"H still moves after {len(history) - 1} iterations; start nearer or iterate longer"
    return Fit(
        model,
        residual,
        cost if cost.ndim else float(cost),
        method,
        CITES,
        rank=9,
        n_iter=len(history) - 1,
        converged=settled,
        history={"H": history},
        text=text,
    )


# --- the paper's baselines on (43) --------------------------------------------------------------------------


class _Cost:
    """(43) of one data set: residuals, their Jacobian, value, gradient; unfolded H (9,)."""

    def __init__(self, batch: TurnBatch, q: Array, B: ArrayLike | None) -> None:
        self.batch, self.q, self.B = batch, q, B
        self.evaluations = 0

    def residuals(self, X: Array) -> Array:
        self.evaluations += 1
        return (integrate_quat(self.batch.y, self.batch.dt, X.reshape(3, 3), self.B) - self.q).ravel()

    def value(self, X: Array) -> float:
        return float(np.sum(self.residuals(X) ** 2))  #                                                    (43)

    def jacobian(self, X: Array) -> Array:
        """Exact (4 T, 9): dq = q * (0, d) / 2 for dR exp(d)."""
        H = X.reshape(3, 3)
        image = integrate_quat(self.batch.y, self.batch.dt, H, self.B)
        J = preintegrate(self.batch.y, self.batch.dt, H, self.B).J_H
        units = np.concatenate([np.zeros((3, 1)), np.eye(3)], axis=1)
        moved = 0.5 * so3.quat_multiply(image[:, None, :], units)  # (T, 3, 4)
        return (np.swapaxes(moved, -1, -2) @ J).reshape(-1, 9)

    def differences(self, X: Array) -> Array:
        """Forward differences (4 T, 9), ten evaluations."""
        steps = np.sqrt(np.finfo(np.float64).eps) * np.maximum(np.abs(X), 1e-3)
        here = self.residuals(X)
        columns = [(self.residuals(X + h * e) - here) / h for h, e in zip(steps, np.eye(9))]
        return np.stack(columns, axis=1)

    def gradient(self, X: Array) -> Array:
        return 2 * self.jacobian(X).T @ self.residuals(X)


class _Path:
    """One descent on (43): its cost, in units of `scale`, and the iterates of the unfolded H."""

    def __init__(
        self,
        turns: Sequence[Turn] | TurnBatch,
        dR: ArrayLike | None,
        H0: ArrayLike,
        B: ArrayLike | None,
        q: ArrayLike | None,
        scale: float,
    ) -> None:
        self.batch, self.B, self.scale = pad(turns), B, scale
        start = np.asarray(H0, dtype=np.float64)
        self.q = labels(self.batch, np.asarray(dR), start, B) if q is None else np.asarray(q, dtype=np.float64)
        bias = None if B is None else scale * np.asarray(B, dtype=np.float64)
        self.cost = _Cost(TurnBatch(scale * self.batch.y, self.batch.dt), self.q, bias)
        self.start = start.ravel() / scale
        self.iterates = [self.start]

    def keep(self, X: Array) -> None:
        self.iterates.append(np.array(X))

    def fit(self, method: str, raw_unit: str) -> Fit:
        path = self.iterates if len(self.iterates) > 1 else self.iterates * 2
        history = self.scale * np.stack(path).reshape(-1, 3, 3)
        found = _fit(self.batch, self.q, history, self.B, method, raw_unit)
        return replace(found, history={**found.history, "evaluations": np.array(self.cost.evaluations)})


def quasi_newton(
    turns: Sequence[Turn] | TurnBatch,
    dR: ArrayLike | None = None,
    *,
    H0: ArrayLike,
    B: ArrayLike | None = None,
    q: ArrayLike | None = None,
    n_iter: int = 200,
    numerical: bool = False,
    scale: float = 1.0,
    raw_unit: str = "count",
) -> Fit:
    """BFGS on (43): SciPy's ``minimize(method='BFGS')``, every iterate kept.

    Stands for MATLAB's ``fminunc`` with algorithm quasi-newton, which is BFGS too, with a cubic line search
    (SciPy: Wolfe conditions) and forward differences (`numerical`; default here: exact gradient). Parameters
    as in `ukf`.
    """
    from scipy.optimize import minimize

    path = _Path(turns, dR, H0, B, q, scale)
    cost = path.cost
    minimize(
        cost.value,
        path.start,
        jac=None if numerical else cost.gradient,
        method="BFGS",
        callback=path.keep,
        options={"maxiter": n_iter, "gtol": 1e-10},
    )
    return path.fit("bfgs", raw_unit)


def nelder_mead(
    turns: Sequence[Turn] | TurnBatch,
    dR: ArrayLike | None = None,
    *,
    H0: ArrayLike,
    B: ArrayLike | None = None,
    q: ArrayLike | None = None,
    n_iter: int = 4000,
    scale: float = 1.0,
    raw_unit: str = "count",
) -> Fit:
    """Nelder-Mead on (43): SciPy's ``minimize(method='Nelder-Mead')``, the best vertex of every iteration kept.

    The same algorithm as MATLAB's ``fminsearch`` (Lagarias et al. 1998, the paper's [31]), the first simplex
    included (5 % of each entry, .00025 where it is zero). Parameters as in `ukf`.
    """
    from scipy.optimize import minimize

    path = _Path(turns, dR, H0, B, q, scale)
    cost = path.cost
    minimize(
        cost.value,
        path.start,
        method="Nelder-Mead",
        callback=path.keep,
        options={"maxiter": n_iter, "maxfev": 4 * n_iter, "xatol": 1e-9, "fatol": 1e-12},
    )
    return path.fit("nelder-mead", raw_unit)


def trust_region(
    turns: Sequence[Turn] | TurnBatch,
    dR: ArrayLike | None = None,
    *,
    H0: ArrayLike,
    B: ArrayLike | None = None,
    q: ArrayLike | None = None,
    n_iter: int = 200,
    numerical: bool = False,
    scale: float = 1.0,
    raw_unit: str = "count",
) -> Fit:
    """Trust region on (43): SciPy's ``least_squares(method='trf')``, every accepted iterate kept.

    The algorithm of MATLAB's ``lsqnonlin`` trust-region-reflective (Branch, Coleman, Li 1999): a Gauss-Newton
    model of the residuals. If the paper took ``fminunc``'s trust region instead, that one models the scalar
    cost with its full Hessian and converges more slowly. `numerical`: forward differences (ten evaluations an
    iteration) as by default in both; default here: exact Jacobian, the same iterates. Parameters as in `ukf`.
    """
    from scipy.optimize import least_squares

    path = _Path(turns, dR, H0, B, q, scale)
    cost = path.cost

    def jacobian(X: Array) -> Array:
        # asked for at the start and once at every accepted iterate: the only hook in all SciPy versions
        if cost.evaluations > 1:
            path.keep(X)
        return cost.differences(X) if numerical else cost.jacobian(X)

    least_squares(
        cost.residuals,
        path.start,
        jac=jacobian,  # type: ignore[arg-type]
        method="trf",
        max_nfev=n_iter,
        xtol=1e-12,
        ftol=1e-14,
        gtol=1e-14,
    )
    return path.fit("trust-region", raw_unit)
