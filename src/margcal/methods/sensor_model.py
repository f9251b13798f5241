"""The sensor error model of both Zhang papers: physical parameters composed into H and B, and split again.

Sources
-------
[Z-TIE]    Zhang, "Two-step calibration methods for miniature inertial and magnetic sensor units",
           IEEE TIE 62(6), 2015, section II.A, (1)-(5).
[ZY-TBME]  Zhang and Yang, "Micromagnetometer calibration for accurate orientation estimation",
           IEEE TBME 62(2), 2015, section II.A, (1)-(12), Table I.

=====================  ================  ==========================================  ======
name here              symbol            meaning                                     shape
=====================  ================  ==========================================  ======
scale                  s_x, s_y, s_z     scale factors, SI unit per raw unit         (3,)
alpha, beta, gamma     same              lower triangle of T, no unit                scalar
phi, theta, psi        same              mounting angles of R, rad                   scalar
soft_iron              A_si              soft iron, no unit                          (3, 3)
hard_iron              b_hi              hard iron, raw unit                         (3,)
bias                   b                 offset of the readings, raw unit            (3,)
H, B                   H_k, B_k          transformation matrix, combined bias        (3, 3), (3,)
=====================  ================  ==========================================  ======

Only H and B can be observed; that is why the papers estimate nothing else. Twenty-four parameters make twelve
numbers, so `split` has to choose, and says in its docstring what it chose.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from margcal.core import so3
from margcal.core.errors import InputError
from margcal.core.types import Array, SensorModel

Form = Literal["zy-tbme", "z-tie"]

NEAR_PERMUTATION_DEG = 30.0
"""A mounting nearer than this to a signed permutation is told as swapped or flipped axes and small angles."""


@dataclass(frozen=True)
class ErrorParameters:
    """The physical error parameters of one triad: the table at the top of the file."""

    scale: Array = field(default_factory=lambda: np.ones(3))
    alpha: float = 0.0
    beta: float = 0.0
    gamma: float = 0.0
    phi: float = 0.0
    theta: float = 0.0
    psi: float = 0.0
    soft_iron: Array = field(default_factory=lambda: np.eye(3))
    hard_iron: Array = field(default_factory=lambda: np.zeros(3))
    bias: Array = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        for name, shape in (("scale", (3,)), ("soft_iron", (3, 3)), ("hard_iron", (3,)), ("bias", (3,))):
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.shape != shape:
                raise InputError(f"{name} has shape {array.shape}; expected {shape}")
            array.flags.writeable = False
            object.__setattr__(self, name, array)


ZY_TBME_TABLE_I = ErrorParameters(
    alpha=0.1,
    beta=0.1,
    gamma=0.1,
    phi=0.1,
    theta=0.1,
    psi=0.1,
    scale=np.array([1 / 1.2, 1 / 1.383, 1 / 1.12]),  # mgauss per raw unit
    bias=np.array([32000.0, 32000.0, 32000.0]),
    hard_iron=np.array([268.0, -123.0, -109.0]),
    # not in the paper: the row prints a32 where a23 must stand; every off-diagonal element is 0.1, so A_si is
    # read as the symmetric matrix, the only reading that names all nine elements.
    soft_iron=np.array([[1.0, 0.1, 0.1], [0.1, 1.0, 0.1], [0.1, 0.1, 1.0]]),
)
"""The 24 parameters of the simulation in ZY-TBME, Table I."""


def non_orthogonality(alpha: float, beta: float, gamma: float) -> Array:
    """Gram-Schmidt orthogonalisation matrix T (3, 3), unit lower triangular."""
    return np.array([[1, 0, 0], [alpha, 1, 0], [beta, gamma, 1]], dtype=np.float64)  # ZY-TBME (1)


def mounting(phi: float, theta: float, psi: float) -> Array:
    """Mounting rotation R (3, 3): takes components along the orthogonalised axes to the frame h."""
    cx, sx, cy, sy, cz, sz = (f(a) for a in (phi, theta, psi) for f in (math.cos, math.sin))
    Rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])  # ZY-TBME (5)
    Ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])  # ZY-TBME (6)
    Rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])  # ZY-TBME (7)
    return Rz @ Ry @ Rx  # ZY-TBME (4)


def mounting_angles(R: ArrayLike) -> tuple[float, float, float]:
    """(phi, theta, psi) of a rotation, rad, theta in [-pi/2, pi/2]; at theta = +-pi/2 phi is set to zero."""
    R = np.asarray(R, dtype=np.float64)
    # atan2 keeps every digit where asin would lose half of them, near theta = +-pi/2
    theta = math.atan2(-R[2, 0], math.hypot(R[2, 1], R[2, 2]))
    if math.hypot(R[2, 1], R[2, 2]) < 1e-12:
        return 0.0, theta, math.atan2(-R[0, 1], R[1, 1])
    return math.atan2(R[2, 1], R[2, 2]), theta, math.atan2(R[1, 0], R[0, 0])


def compose(params: ErrorParameters, form: Form = "zy-tbme") -> tuple[Array, Array]:
    """H and B of the unified model ``u = H (y - B)``.

    Parameters
    ----------
    params : ErrorParameters
    form : {'zy-tbme', 'z-tie'}
        The papers place the offsets differently: ZY-TBME (8) subtracts them from the raw reading, Z-TIE (2)
        after the soft iron. Without soft iron the two are the same.

    Returns
    -------
    H : ndarray (3, 3), SI unit per raw unit
    B : ndarray (3,), raw unit
    """
    R = mounting(params.phi, params.theta, params.psi)
    T = non_orthogonality(params.alpha, params.beta, params.gamma)
    H = R @ T @ np.diag(params.scale) @ params.soft_iron  # Z-TIE (4)
    offset: Array = params.bias + params.hard_iron
    if form == "zy-tbme":
        return H, offset  # ZY-TBME (11)-(12)
    if form == "z-tie":
        return H, np.linalg.inv(params.soft_iron) @ offset  # Z-TIE (3)
    raise InputError(f"form {form!r} is neither 'zy-tbme' nor 'z-tie'")


def split(H: ArrayLike, B: ArrayLike, *, soft_iron: bool = False) -> ErrorParameters:
    """One set of error parameters that composes (form 'zy-tbme') to exactly `H` and `B`.

    Parameters
    ----------
    H : array_like (3, 3)
    B : array_like (3,)
    soft_iron : bool
        False (accelerometer, gyroscope): ``H = R T S``. True (magnetometer): ``H = R S A_si``.

    Returns
    -------
    ErrorParameters

    Raises
    ------
    InputError
        If H is singular or holds anything but finite numbers.

    Notes
    -----
    What is a choice, none of it in the papers:

    - ``soft_iron=False``: T is unit lower triangular as in ZY-TBME (1) and R a proper rotation, so R (T S) is
      the QL decomposition of H, unique for det H > 0. The triangle prefers an axis: before R, the sensing
      axis of raw x is the frame's x, that of raw y lies in its xy-plane. `describe` prefers none.
    - ``soft_iron=True``: in a magnetometer, scale, non-orthogonality and soft iron cannot be told apart. All
      of H's shape goes into A_si = (H^T H)^(1/2), scaled to det 1; scale is the same on the three axes,
      T = I, R is the orthogonal factor. This is the right polar decomposition.
    - Hard iron and bias are one number: it is given as `hard_iron` with `soft_iron`, else as `bias`.
    - det H < 0 (a mirrored triad): R stays a rotation and one scale factor is negative, that of the axis
      which leaves R nearest the identity.
    """
    H, B = _checked(H), np.asarray(B, dtype=np.float64)
    if soft_iron:
        R, shape = so3.polar(H)
        size = np.cbrt(np.linalg.det(shape))
        R, sign = _proper(R)
        # the sign sits between R and A_si: R diag(sign) is the orthogonal factor again
        phi, theta, psi = mounting_angles(R)
        return ErrorParameters(scale=size * sign, phi=phi, theta=theta, psi=psi, soft_iron=shape / size, hard_iron=B)
    R, L = _ql(H)
    R, sign = _proper(R)
    L = sign[:, None] * L
    scale = np.diag(L)
    T = L / scale
    phi, theta, psi = mounting_angles(R)
    return ErrorParameters(scale, T[1, 0], T[2, 0], T[2, 1], phi, theta, psi, bias=B)


def _checked(H: ArrayLike) -> Array:
    H = np.asarray(H, dtype=np.float64)
    if H.shape != (3, 3):
        raise InputError(f"H has shape {H.shape}; expected (3, 3)")
    if not np.all(np.isfinite(H)) or np.linalg.cond(H) > 1e12:
        raise InputError("H is singular or not finite and cannot be split into error parameters")
    return H


def _ql(H: Array) -> tuple[Array, Array]:
    """``H = Q L``, Q orthogonal (det of H's sign), L lower triangular with a positive diagonal."""
    flip = np.eye(3)[::-1]
    Q, U = np.linalg.qr(flip @ H @ flip)
    Q, L = flip @ Q @ flip, flip @ U @ flip
    sign = np.sign(np.diag(L))
    return Q * sign, sign[:, None] * L


def _proper(Q: Array) -> tuple[Array, Array]:
    """``Q = R diag(sign)``, R proper; at most one sign negative: that which leaves R nearest the identity."""
    sign = np.ones(3)
    if np.linalg.det(Q) < 0:
        sign[np.argmin(np.diag(Q))] = -1.0
    return Q * sign, sign


@dataclass(frozen=True)
class Description:
    """A calibrated sensor in figures that people know.

    Attributes
    ----------
    bias : tuple of 3 float, raw unit
    scale_factor : tuple of 3 float, raw unit per SI unit (LSB per m/s^2, say), of the sensing axes x, y, z
    scale_unit : str, such as ``count per m/s^2``
    non_orthogonality_deg : dict ``{'xy', 'xz', 'yz'}``
        90 degrees minus the angle between two sensing axes: positive where they lean towards each other.
    axes : tuple of 3 str, such as ``('+y', '+x', '-z')``, or None
        The frame's axis that each raw axis points along, if the mounting is within `NEAR_PERMUTATION_DEG` of
        axes that are swapped or flipped.
    mounting_deg : dict ``{'roll', 'pitch', 'yaw'}``
        Rotation (ZYX) that takes components along the triad's axes to the frame; beyond `axes`, where those
        are given.
    mounting_angle_deg : float
        The size of that rotation.
    mirrored : bool
        A left-handed triad (det H < 0).
    hard_iron : tuple of 3 float, SI unit, or None
        Magnetometer: the offset as a field along the raw axes, ``B_i / scale_factor_i``.
    soft_iron : tuple of 3x3 float or None
        Magnetometer: symmetric, det 1, in raw axes.
    """

    bias: tuple[float, ...]
    scale_factor: tuple[float, ...]
    scale_unit: str
    non_orthogonality_deg: dict[str, float]
    axes: tuple[str, ...] | None
    mounting_deg: dict[str, float]
    mounting_angle_deg: float
    mirrored: bool
    hard_iron: tuple[float, ...] | None = None
    soft_iron: tuple[tuple[float, ...], ...] | None = None


def sensing_axes(H: ArrayLike) -> tuple[Array, Array]:
    """Scale factors (3,) and unit sensing axes (3, 3), a row an axis, in the frame of u.

    The rows k_i of H^-1 are what each axis senses, ``y_i - B_i = k_i . u``: their lengths are the scale
    factors (raw unit per SI unit), their directions the sensing axes.
    """
    K_fwd = np.linalg.inv(np.asarray(H, dtype=np.float64))
    length = np.linalg.norm(K_fwd, axis=1)
    return length, K_fwd / length[:, None]


def describe(model: SensorModel) -> Description:
    """`model` in words-friendly figures.

    Raises
    ------
    InputError
        If H is singular or not finite.

    Notes
    -----
    The mounting of an accelerometer or gyroscope is the rotation nearest to its three sensing axes, so that
    no axis is preferred; of a magnetometer it is the orthogonal factor of H, so that mounting x scale x soft
    iron is H again.
    """
    H = _checked(model.H)
    scale, axes = sensing_axes(H)
    orthogonal = so3.polar(H)[0] if model.kind == "mag" else so3.polar(axes)[0].T  # triad -> frame
    names, rest = _permutation(orthogonal)
    roll, pitch, yaw = (math.degrees(a) for a in mounting_angles(rest))
    lean = {
        "xy": _lean_deg(axes[0], axes[1]),
        "xz": _lean_deg(axes[0], axes[2]),
        "yz": _lean_deg(axes[1], axes[2]),
    }
    magnetic = model.kind == "mag"
    return Description(
        bias=tuple(model.B.tolist()),
        scale_factor=tuple(scale.tolist()),
        scale_unit=f"{model.raw_unit} per {model.unit}",
        non_orthogonality_deg=lean,
        axes=names,
        mounting_deg={"roll": roll, "pitch": pitch, "yaw": yaw},
        mounting_angle_deg=math.degrees(float(np.linalg.norm(so3.log(rest)))),
        mirrored=bool(np.linalg.det(H) < 0),
        hard_iron=tuple((model.B / scale).tolist()) if magnetic else None,
        soft_iron=tuple(map(tuple, split(H, model.B, soft_iron=True).soft_iron.tolist())) if magnetic else None,
    )


def _lean_deg(a: Array, b: Array) -> float:
    return math.degrees(math.asin(max(-1.0, min(1.0, float(a @ b)))))


def _permutation(Q: Array) -> tuple[tuple[str, ...] | None, Array]:
    """The frame's axes that the triad's axes (columns of Q) point along, and the rotation left over."""
    determinant = np.sign(np.linalg.det(Q))
    nearest = max(
        (P for P in _signed_permutations() if np.linalg.det(P) * determinant > 0),
        key=lambda P: float(np.sum(P * Q)),
    )
    rest = Q @ nearest.T
    if math.degrees(float(np.linalg.norm(so3.log(rest)))) > NEAR_PERMUTATION_DEG:
        return None, _proper(Q)[0]
    rows = np.argmax(np.abs(nearest), axis=0)
    return tuple(("+" if nearest[r, c] > 0 else "-") + "xyz"[r] for c, r in enumerate(rows)), rest


def _signed_permutations() -> list[Array]:
    """The 48 matrices that swap and flip axes."""
    return [
        np.eye(3)[:, list(order)] * np.array(signs)
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]
