"""What a covariance of (H, B) means for a user: degrees and per cent of the calibrated vector.

Not in the papers. With p = (H row by row, B) and y - B = H^-1 u the calibrated vector errs by

    du = dH (y - B) - H dB = L(u) dp,    L(u) = [ I (kron) (H^-1 u)^T,  -H ]

The error across u is an angle, the error along u a relative magnitude; both are averaged over the sphere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from margcal.core.types import Array, Kind

SPHERE_POINTS = 200


@dataclass(frozen=True)
class ExpectedError:
    """Root mean square over the sphere, and the worst direction.

    Attributes
    ----------
    direction_deg : float
        Angle between calibrated and true vector.
    magnitude_percent : float
    worst_direction_deg : float
        Largest angle over the sphere (one standard deviation).
    """

    direction_deg: float
    magnitude_percent: float
    worst_direction_deg: float


def sphere(n: int = SPHERE_POINTS) -> Array:
    """n directions (n, 3) evenly over the sphere (Fibonacci lattice)."""
    k = np.arange(n) + 0.5
    z = 1 - 2 * k / n
    azimuth = np.pi * (1 + np.sqrt(5)) * k
    r = np.sqrt(1 - z * z)
    return np.column_stack([r * np.cos(azimuth), r * np.sin(azimuth), z])


def expected_error(kind: Kind, H: Array, covariance: Array, magnitude: float) -> ExpectedError:
    """Error of the calibrated vector to be expected from the covariance.

    Parameters
    ----------
    kind : {'acc', 'gyr', 'mag'}
        For a gyroscope only H counts: its bias is not a direction.
    H : ndarray (3, 3)
    covariance : ndarray (12, 12), of (H row by row, then B)
    magnitude : float
        Of the sensed vector, calibrated unit (any value for a gyroscope).
    """
    u = sphere()
    L = _sensitivity(H, magnitude * u)
    if kind == "gyr":
        L = L[:, :, :9]
        covariance = covariance[:9, :9]
    C = L @ covariance @ np.swapaxes(L, -1, -2) / magnitude**2
    along = np.einsum("ni,nij,nj->n", u, C, u)
    across = np.maximum(np.trace(C, axis1=1, axis2=2) - along, 0.0)
    return ExpectedError(
        float(np.degrees(np.sqrt(np.mean(across)))),
        float(100 * np.sqrt(np.mean(np.maximum(along, 0.0)))),
        float(np.degrees(np.sqrt(np.max(across)))),
    )


def _sensitivity(H: Array, u: Array) -> Array:
    """L(u) for every row of `u`, (n, 3, 12)."""
    z = u @ np.linalg.inv(H).T
    L = np.zeros((len(u), 3, 12))
    for i in range(3):
        L[:, i, 3 * i : 3 * i + 3] = z
    L[:, :, 9:] = -H
    return L


def direction_errors_deg(H: Array, B: Array, H_true: Array, B_true: Array, magnitude: float | None) -> Array:
    """Angle over the sphere (n,) between the vector that (H, B) gives and the true one.

    With `magnitude` None (a gyroscope) the biases are left out.
    """
    u = sphere()
    size = 1.0 if magnitude is None else magnitude
    z = size * u @ np.linalg.inv(H_true).T
    offset = np.zeros(3) if magnitude is None else B_true - B
    v = (z + offset) @ H.T
    cross = np.linalg.norm(np.cross(v, u), axis=1)
    return np.degrees(np.arctan2(cross, np.sum(v * u, axis=1)))


@dataclass(frozen=True)
class WeakDirection:
    """The least certain combination of parameters: `what` is 'rotation', 'stretch' or 'bias'; `text` in words."""

    what: str
    sd: float
    text: str


def weakest_direction(kind: Kind, H: Array, covariance: Array, magnitude: float) -> WeakDirection:
    """Name the combination of (H, B) that the data determine least.

    In relative units, ``E = dH H^-1`` (its antisymmetric part turns the frame, its symmetric part stretches it) and
    ``H dB / magnitude``, the covariance's largest eigenvector is taken apart.
    """
    inverse = np.linalg.inv(H)
    to = np.zeros((12, 12))
    to[:9, :9] = np.kron(np.eye(3), inverse.T)  # rows of E = rows of dH times H^-1
    to[9:, 9:] = H / magnitude
    values, vectors = np.linalg.eigh(to @ covariance @ to.T)
    sd, worst = float(np.sqrt(max(values[-1], 0.0))), vectors[:, -1]
    E, b = worst[:9].reshape(3, 3), worst[9:]
    turn = np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / np.sqrt(2)
    stretch = (E + E.T) / 2
    parts = {"rotation": np.linalg.norm(turn), "stretch": np.linalg.norm(stretch)}
    if kind != "gyr":
        parts["bias"] = np.linalg.norm(b)
    what = max(parts, key=lambda k: float(parts[k]))
    if what == "rotation":
        about, size = _axis_words(turn), np.degrees(sd)
        text = f"the rotation of its frame about {about} is the least determined ({size:.1f} degrees)"
    elif what == "stretch":
        along = np.linalg.eigh(stretch)
        axis = along[1][:, np.argmax(np.abs(along[0]))]
        text = f"its gain along {_axis_words(axis)} is the least determined ({100 * sd:.1f} %)"
    else:
        text = f"its bias along {_axis_words(b)} is the least determined ({100 * sd:.1f} % of the magnitude)"
    return WeakDirection(what, sd, text)


def _axis_words(v: Array) -> str:
    v = v / np.linalg.norm(v)
    k = int(np.argmax(np.abs(v)))
    if abs(v[k]) > 0.95:
        return f"the {'xyz'[k]} axis"
    v = v * np.sign(v[k])
    return f"({v[0]:.1f} {v[1]:.1f} {v[2]:.1f})"
