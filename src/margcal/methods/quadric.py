"""Surfaces of second order through points: algebraic fits, true distances, and why a fit is not an ellipsoid.

[3] N. Chernov, H. Ma, "Least squares fitting of quadratic curves and surfaces", Computer Vision, 2011,
    pp. 285-302: Taubin's algebraic fit as the start, Eberly's projection, Ahn's implicit scheme.
[4] I. Markovsky, A. Kukush, S. Van Huffel, "Consistent least squares fitting of ellipsoids", Numerische
    Mathematik 98, 2004, pp. 177-194: the adjusted least-squares estimator.

Points here are centred and scaled to a mean square radius of 1 (`affine.scaled`). A quadric is
``theta . phi(z) = 0`` with phi(z) = (x^2, y^2, z^2, xy, xz, yz, x, y, z, 1); an ellipsoid is kept as a
symmetric positive definite K (..., 3, 3) and a centre b (..., 3) with ``|K (z - b)| = 1``.
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from margcal.core.types import Array

EXPONENTS = np.array(
    [
        [2, 0, 0],
        [0, 2, 0],
        [0, 0, 2],
        [1, 1, 0],
        [1, 0, 1],
        [0, 1, 1],
        [1, 0, 0],
        [0, 1, 0],
        [0, 0, 1],
        [0, 0, 0],
    ]
)
"""Powers of x, y, z in each term of phi."""

PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Elements of a symmetric 3x3 matrix in the order of the quadratic terms of phi."""

FLAT = 0.02
"""Points that keep to a plane within this part of their rms radius lie in that plane."""


def monomials(z: Array) -> Array:
    """phi without its constant term, (..., J, 9)."""
    x, y, w = z[..., 0], z[..., 1], z[..., 2]
    return np.stack([x * x, y * y, w * w, x * y, x * w, y * w, x, y, w], axis=-1)


def gradients(z: Array) -> Array:
    """Derivatives of `monomials` by x, y, z: (..., J, 9, 3)."""
    out = np.zeros((*z.shape[:-1], 9, 3))
    for row, (p, q) in enumerate(PAIRS):
        out[..., row, p] += z[..., q]
        out[..., row, q] += z[..., p]
    out[..., [6, 7, 8], [0, 1, 2]] = 1.0
    return out


def taubin(z: Array) -> Array:
    """Taubin's fit: theta (..., 10) that minimises ``sum F^2 / sum |grad F|^2`` ([3] section 5)."""
    phi = monomials(z)
    mean = phi.mean(axis=-2)
    centred = phi - mean[..., None, :]
    grad = gradients(z)
    N = np.einsum("...jpi,...jqi->...pq", grad, grad)
    root = np.linalg.cholesky(N + 1e-14 * np.trace(N, axis1=-2, axis2=-1)[..., None, None] * np.eye(9))
    whitened = np.swapaxes(np.linalg.solve(root, np.swapaxes(centred, -1, -2)), -1, -2)
    _, _, Vt = np.linalg.svd(whitened, full_matrices=False)
    q = np.linalg.solve(np.swapaxes(root, -1, -2), Vt[..., -1, :, None])[..., 0]
    return np.concatenate([q, -np.sum(q * mean, axis=-1, keepdims=True)], axis=-1)


def adjusted(z: Array, weights: Array) -> tuple[Array, float]:
    """Adjusted least squares [4]: theta (10,) without the bias that noise gives to the plain algebraic fit.

    Monomials x^k of noisy coordinates are replaced by polynomials t_k(x) whose expectation is that of the
    noise-free ones: t_2 = x^2 - v, t_3 = x^3 - 3 x v, t_4 = x^4 - 6 x^2 v + 3 v^2. The noise variance v
    (equal on all axes) is the smallest one that makes the adjusted matrix singular.

    Returns
    -------
    theta, v
    """
    terms = _adjusted_matrices(_moments(z, weights))

    def smallest(v: float) -> float:
        return float(np.linalg.eigvalsh(terms[0] + v * terms[1] + v * v * terms[2])[0])

    low, high = 0.0, 1e-12
    while smallest(high) > 0 and high < 1.0:
        low, high = high, high * 4
    for _ in range(60):
        if high - low <= 1e-12 * high:
            break
        middle = (low + high) / 2
        low, high = (middle, high) if smallest(middle) > 0 else (low, middle)
    v = (low + high) / 2
    _, vectors = np.linalg.eigh(terms[0] + v * terms[1] + v * v * terms[2])
    return vectors[:, 0], v


def _moments(z: Array, weights: Array) -> Array:
    """Weighted means of x^a y^b z^c, (5, 5, 5); those with a + b + c <= 4 are used."""
    powers = np.ones((3, 5, len(z)))
    for k in range(1, 5):
        powers[:, k] = powers[:, k - 1] * z.T
    out = np.zeros((5, 5, 5))
    weighted = powers[2] * weights
    for a, b in itertools.product(range(5), repeat=2):
        if a + b <= 4:
            out[a, b] = weighted @ (powers[0, a] * powers[1, b])
    return out / weights.sum()


HERMITE = (
    {(0, 0): 1.0},
    {(1, 0): 1.0},
    {(2, 0): 1.0, (0, 1): -1.0},
    {(3, 0): 1.0, (1, 1): -3.0},
    {(4, 0): 1.0, (2, 1): -6.0, (0, 2): 3.0},
)
"""t_k as {(power of x, power of v): coefficient}."""


def _adjusted_matrices(moments: Array) -> Array:
    """Coefficients of v^0, v^1, v^2 in the adjusted matrix, (3, 10, 10)."""
    out = np.zeros((3, 10, 10))
    for p, q in itertools.product(range(10), repeat=2):
        factors = [HERMITE[k].items() for k in EXPONENTS[p] + EXPONENTS[q]]
        for (ex, cx), (ey, cy), (ez, cz) in itertools.product(*factors):
            out[ex[1] + ey[1] + ez[1], p, q] += cx * cy * cz * moments[ex[0], ey[0], ez[0]]
    return out


def ellipsoid_of(theta: Array) -> tuple[Array, Array, Array]:
    """K, b and whether the quadric theta (..., 10) is a real ellipsoid; else K and b mean nothing."""
    S = np.empty((*theta.shape[:-1], 3, 3))
    for row, (p, q) in enumerate(PAIRS):
        S[..., p, q] = S[..., q, p] = theta[..., row] * (1.0 if p == q else 0.5)
    S, theta = _signed(S, theta)
    eigenvalues, vectors = np.linalg.eigh(S)
    good = eigenvalues[..., 0] > 1e-12 * np.abs(eigenvalues[..., 2])
    safe = np.where(good[..., None], eigenvalues, 1.0)
    b = -0.5 * np.einsum("...ij,...j,...kj,...k->...i", vectors, 1 / safe, vectors, theta[..., 6:9])
    level = np.einsum("...i,...ij,...j->...", b, S, b) - theta[..., 9]
    good &= level > 0
    level = np.where(good, level, 1.0)
    K = np.einsum("...ij,...j,...kj->...ik", vectors, np.sqrt(safe / level[..., None]), vectors)
    return K, b, good


def _signed(S: Array, theta: Array) -> tuple[Array, Array]:
    sign = np.where(np.trace(S, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
    return S * sign[..., None, None], theta * sign[..., None]


def sphere(z: Array) -> tuple[Array, Array]:
    """K and b of the sphere nearest to (..., J, 3): linear least squares, ``|z|^2 = 2 b.z + r^2 - |b|^2``."""
    square = np.einsum("...ji,...ji->...j", z, z)
    design = np.concatenate([2 * z, np.ones((*z.shape[:-1], 1))], axis=-1)
    x = (np.linalg.pinv(design, rcond=1e-6) @ square[..., None])[..., 0]
    b = x[..., :3]
    radius = np.sqrt(np.maximum(x[..., 3] + np.einsum("...i,...i->...", b, b), 1e-12))
    return np.eye(3) / radius[..., None, None], b


def distances(z: Array, K: Array, b: Array) -> tuple[Array, Array]:
    """Signed distance (..., J) of each point from the ellipsoid and its foot point (..., J, 3).

    Eberly's projection ([3] section 6): in the ellipsoid's axes with semi-axes e, the foot point of p is
    ``e^2 p / (t + e^2)`` with t the largest root of ``g(t) = sum (e p / (t + e^2))^2 - 1``; g is convex and
    falling there, so Newton's method from the left cannot overshoot. Outside is positive.
    """
    eigenvalues, axes = np.linalg.eigh(K)
    e2 = (1 / eigenvalues**2)[..., None, :]
    p = (z - b[..., None, :]) @ axes
    ep2 = e2 * p * p
    t = np.max(np.sqrt(ep2) - e2, axis=-1)
    for _ in range(100):
        shifted = np.maximum(t[..., None] + e2, 1e-150)
        terms = ep2 / shifted**2
        value = terms.sum(axis=-1) - 1
        step = value / np.maximum(2 * (terms / shifted).sum(axis=-1), 1e-150)
        t = t + step
        if np.all(np.abs(step) <= 4e-16 * e2.max(axis=-1)) or np.all(value <= 0):
            break
    shifted = np.maximum(t[..., None] + e2, 1e-150)
    foot = e2 * p / shifted
    distance = t * np.sqrt(np.sum((p / shifted) ** 2, axis=-1))
    return distance, foot @ np.swapaxes(axes, -1, -2) + b[..., None, :]


def distance_jacobian(foot: Array, K: Array, b: Array) -> Array:
    """Derivatives (..., J, 9) of the signed distance by (K's six elements in the order of PAIRS, b).

    Ahn's implicit scheme: with F = |K (z - b)| - 1, the distance changes by dF/|grad F|, both at the foot
    point.
    """
    v = foot - b[..., None, :]
    s = v @ K  # K is symmetric
    normal = s @ K
    out = np.empty((*foot.shape[:-1], 9))
    for row, (p, q) in enumerate(PAIRS):
        out[..., row] = s[..., p] * v[..., q] if p == q else s[..., p] * v[..., q] + s[..., q] * v[..., p]
    out[..., 6:] = -normal
    return out / np.linalg.norm(normal, axis=-1)[..., None]


def symmetric(six: Array) -> Array:
    """Symmetric (..., 3, 3) from its six elements in the order of PAIRS."""
    out = np.empty((*six.shape[:-1], 3, 3))
    for row, (p, q) in enumerate(PAIRS):
        out[..., p, q] = out[..., q, p] = six[..., row]
    return out


def refine(z: Array, K: Array, b: Array, max_iter: int = 100) -> tuple[Array, Array, Array, int]:
    """Orthogonal-distance fit: Levenberg-Marquardt on `distances` from a start, all nodes of a batch at once.

    Returns
    -------
    K (..., 3, 3) symmetric positive definite, b (..., 3), converged (...,), number of iterations
    """
    lead = z.shape[:-2]
    z = z.reshape(-1, *z.shape[-2:])
    x = np.concatenate([np.stack([K[..., p, q] for p, q in PAIRS], axis=-1), b], axis=-1).reshape(len(z), 9)
    damping, done = np.zeros(len(z)), np.zeros(len(z), dtype=bool)
    r, J = _misfit(z, x)
    n_iter = 0
    while n_iter < max_iter and not done.all():
        n_iter += 1
        on = np.flatnonzero(~done)
        normal = np.swapaxes(J[on], -1, -2) @ J[on]
        gradient = np.einsum("njp,nj->np", J[on], r[on])
        diagonal = np.einsum("npp->np", normal)
        damped = normal + (damping[on] + 1e-15)[:, None, None] * (diagonal[:, :, None] * np.eye(9))
        step = -np.linalg.solve(damped, gradient[..., None])[..., 0]
        trial_r, trial_J = _misfit(z[on], x[on] + step)
        before, after = np.sum(r[on] ** 2, axis=1), np.sum(trial_r**2, axis=1)
        down = after <= before * (1 + 1e-13) + 1e-300
        good, bad = on[down], on[~down]
        x[good] += step[down]
        r[good], J[good] = trial_r[down], trial_J[down]
        small = np.abs(step).max(axis=1) <= 1e-14 * np.abs(x[on]).max(axis=1)
        stalled = np.abs(np.einsum("np,np->n", step, gradient)) <= 1e-16 * before
        done[on] = (down & (small | stalled)) | (~down & (damping[on] > 1e8))
        damping[good] = np.where(damping[good] < 1e-9, 0.0, damping[good] / 10)
        damping[bad] = np.where(damping[bad] == 0, 1e-6, damping[bad] * 10)
    K = symmetric(x[:, :6])
    eigenvalues, vectors = np.linalg.eigh(K)
    K = np.einsum("nij,nj,nkj->nik", vectors, np.abs(eigenvalues), vectors)
    return K.reshape(*lead, 3, 3), x[:, 6:].reshape(*lead, 3), done.reshape(lead), n_iter


def _misfit(z: Array, x: Array) -> tuple[Array, Array]:
    K, b = symmetric(x[:, :6]), x[:, 6:]
    distance, foot = distances(z, K, b)
    return distance, distance_jacobian(foot, K, b)


def why_not(z: Array) -> str:
    """Why points (J, 3) do not make an ellipsoid, in words that say what to record."""
    _, s, Vt = np.linalg.svd(z - z.mean(axis=0), full_matrices=False)
    thickness = s[2] / math.sqrt(len(z))
    normal = Vt[2]
    if thickness < 0.15:
        axis = axis_words(normal)
        return f"the readings lie near a plane across {axis}: tilt it towards the sensed vector, up and down"
    _, b = sphere(z)
    directions = (z - b) / np.linalg.norm(z - b, axis=1, keepdims=True)
    mean = directions.mean(axis=0)
    if np.linalg.norm(mean) > 0.4:
        return f"the readings cover one side only: none have {axis_words(-mean)} towards the sensed vector"
    return "the readings do not lie on an ellipsoid: look for a disturbance, or record more attitudes all around"


def axis_words(direction: Array) -> str:
    """'axis z', '-x' and the like where `direction` is within 25 degrees of an axis, else its components."""
    direction = direction / np.linalg.norm(direction)
    largest = int(np.argmax(np.abs(direction)))
    if abs(direction[largest]) > 0.9:
        return f"sensor axis {'-' if direction[largest] < 0 else ''}{'xyz'[largest]}"
    return "direction (" + ", ".join(f"{x + 0.0:.1f}" for x in np.round(direction, 1)) + ")"
