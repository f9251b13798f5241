"""What a covariance of (H, B) means for a user: degrees and per cent of the calibrated vector.

Not in the papers. With p = (H row by row, B) and y - B = H^-1 u the calibrated vector errs by

    du = dH (y - B) - H dB = L(u) dp,    L(u) = [ I (kron) (H^-1 u)^T,  -H ]

The error across u is an angle, the error along u a relative magnitude; both are averaged over the sphere. What a
node makes of accelerometer and magnetometer together, tilt and heading, follows from the same L.
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
    worst_towards : tuple of float
        Where that is: a unit vector, calibrated frame.
    """

    direction_deg: float
    magnitude_percent: float
    worst_direction_deg: float
    worst_towards: tuple[float, float, float]


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
    C = relative_covariance(kind, H, covariance, magnitude, u)
    along = np.einsum("ni,nij,nj->n", u, C, u)
    across = np.maximum(np.trace(C, axis1=1, axis2=2) - along, 0.0)
    return ExpectedError(
        float(np.degrees(np.sqrt(np.mean(across)))),
        float(100 * np.sqrt(np.mean(np.maximum(along, 0.0)))),
        float(np.degrees(np.sqrt(np.max(across)))),
        tuple(u[int(np.argmax(across))].tolist()),
    )


def relative_covariance(kind: Kind, H: Array, covariance: Array, magnitude: float, u: Array) -> Array:
    """Covariance (n, 3, 3) of the calibrated vector where it points along `u` (n, 3), in units of its magnitude."""
    L = sensitivity(H, magnitude * u)
    if kind == "gyr":
        L = L[:, :, :9]
        covariance = covariance[:9, :9]
    return L @ covariance @ np.swapaxes(L, -1, -2) / magnitude**2


def sensitivity(H: Array, u: Array) -> Array:
    """L(u) of the head of this module for every row of `u` (n, 3), calibrated unit: (n, 3, 12)."""
    z = u @ np.linalg.inv(H).T
    L = np.zeros((len(u), 3, 12))
    for i in range(3):
        L[:, i, 3 * i : 3 * i + 3] = z
    L[:, :, 9:] = -H
    return L


def direction_ellipses(kind: Kind, H: Array, covariance: Array, magnitude: float, u: Array) -> Array:
    """Semi-axes of the one-sigma ellipse of the direction's error at each of `u` (n, 3).

    Returns
    -------
    ndarray (n, 2, 3), rad
        Two vectors across u, the longer one first.
    """
    across = np.eye(3) - u[:, :, None] * u[:, None, :]
    values, vectors = np.linalg.eigh(across @ relative_covariance(kind, H, covariance, magnitude, u) @ across)
    size = np.sqrt(np.maximum(values[:, [2, 1]], 0.0))
    return size[:, :, None] * np.swapaxes(vectors[:, :, [2, 1]], 1, 2)


def shift_deg(kind: Kind, H: Array, shift: Array, magnitude: float) -> Array:
    """Angle, rms over the sphere, by which the calibrated vector turns when (H row by row, B) moves.

    Parameters
    ----------
    shift : ndarray (J, 12)
        Small changes of (H, B), for instance those that leaving out each of J rests makes.

    Returns
    -------
    ndarray (J,), degrees
    """
    u = sphere()
    L = sensitivity(H, magnitude * u)
    n = 9 if kind == "gyr" else 12
    du = np.einsum("nik,jk->jni", L[:, :, :n], shift[:, :n]) / magnitude
    across = np.sum(du**2, axis=2) - np.einsum("jni,ni->jn", du, u) ** 2
    return np.degrees(np.sqrt(np.mean(np.maximum(across, 0.0), axis=1)))


# --- the node: tilt and heading ----------------------------------------------------------------------

AZIMUTHS = 8


def heading_error(
    acc: tuple[Array, Array],
    mag: tuple[Array, Array],
    gravity: float,
    field: float,
    dip: float,
    between: Array | None = None,
) -> float:
    """Expected error of the heading that accelerometer and magnetometer tell together, rms over all attitudes.

    With up z, magnetic north n and east e, the east that is found, ``m x f``, turns about the vertical by

        -(dm . e + sin(dip) df . e) / cos(dip)

    for errors dm, df of the two unit vectors: a tilt error pulls the vertical field into the horizontal plane. The
    tilt's own error is the accelerometer's direction error.

    Parameters
    ----------
    acc, mag : tuple of ndarray (3, 3) and (12, 12)
        H and the covariance of (H row by row, then B) of each sensor.
    gravity, field : float
        Magnitudes, calibrated units.
    dip : float, rad
    between : ndarray (12, 12), optional
        Covariance of the magnetometer's (H, B) with the accelerometer's. Sensors calibrated at the same rests share
        the errors of their attitudes, and much of it cancels in the formula.

    Returns
    -------
    float, degrees
        Without `between` an upper limit: the largest that any correlation could make it.
    """
    up, east, north = _attitudes()
    m = np.cos(dip) * north - np.sin(dip) * up
    by_mag = np.einsum("ni,nik->nk", east, sensitivity(mag[0], field * m)) / (field * np.cos(dip))
    by_acc = np.einsum("ni,nik->nk", east, sensitivity(acc[0], gravity * up)) * np.tan(dip) / gravity
    var_mag = np.maximum(np.einsum("nk,kl,nl->n", by_mag, mag[1], by_mag), 0.0)
    var_acc = np.maximum(np.einsum("nk,kl,nl->n", by_acc, acc[1], by_acc), 0.0)
    if between is None:
        both = 2 * np.sqrt(var_mag * var_acc)
    else:
        both = 2 * np.einsum("nk,kl,nl->n", by_mag, between, by_acc)
    return float(np.degrees(np.sqrt(np.mean(np.maximum(var_mag + var_acc + both, 0.0)))))


def _attitudes() -> tuple[Array, Array, Array]:
    """Up, east and north (n, 3) in the node's frame, evenly over all attitudes."""
    up: Array = np.repeat(sphere(), AZIMUTHS, axis=0)
    helper = np.eye(3)[np.argmin(np.abs(up), axis=1)]
    a: Array = np.cross(up, helper)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    angle = np.tile(2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS, SPHERE_POINTS)[:, None]
    east: Array = np.cos(angle) * a + np.sin(angle) * np.cross(up, a)
    north: Array = np.cross(up, east)
    return up, east, north


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
    return "({:.1f} {:.1f} {:.1f})".format(*(np.round(v, 1) + 0.0))  # + 0.0: no minus before a zero
