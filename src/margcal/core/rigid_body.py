"""Attitude and position of a rigid body from its markers (Kabsch 1976; Arun, Huang & Blostein 1987).

Markers at s_m in the body's frame k are seen at x_m in the laboratory m:  x_m = R s_m + p + noise. With the centroids
of the markers that are seen taken out, R is the proper rotation nearest to  sum (x_m - x)(s_m - s)^T,  and p = x - R s.
Three markers that are not on one line are enough; then the third singular value is zero, and the determinant decides.

=============  ====================================================  ==========
name here      meaning                                               shape
=============  ====================================================  ==========
x              markers in the laboratory, NaN where not seen, m      (N, M, 3)
shape          markers in the body's frame (s), m                    (M, 3)
R, p           attitude R_mk, and the body's origin, m               (N, 3, 3), (N, 3)
residual       rms distance of seen markers from R s + p, m          (N,)
=============  ====================================================  ==========
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from margcal.core import so3
from margcal.core.errors import DataError
from margcal.core.types import Array, Mask, Reference, _frozen, _set

FLATTEST = 0.05
"""Least height of a triangle of markers over its longest edge: below, the turn about the long edge is noise."""

ROUNDS = 8
"""Of the mean shape: fit all frames, average, repeat. It moves by less than a micrometre after three or four."""

MOST_FRAMES = 2000
"""Frames that the mean shape is taken from; longer tracks are thinned evenly."""


@dataclass(frozen=True)
class BodyFit:
    """R (N, 3, 3), p (N, 3) m, residual (N,) m; NaN where fewer than three markers, or three on a line, are seen."""

    R: Array
    p: Array
    residual: Array


@dataclass(frozen=True)
class MarkerReference(Reference):
    """A `Reference` that was made from markers.

    Attributes
    ----------
    residual : ndarray (N,), m
        Rms distance of the seen markers from the rigid shape; NaN where the body was not seen.
    names : tuple of str
        The markers that were used, in order.
    shape : ndarray (M, 3), m
        Their places in the body's frame.
    """

    residual: Array = None  # type: ignore[assignment]
    names: tuple[str, ...] = ()
    shape: Array = None  # type: ignore[assignment]

    def __post_init__(self) -> None:
        super().__post_init__()
        residual = np.full(len(self.t), np.nan) if self.residual is None else self.residual
        _set(self, "residual", _frozen(residual, (None,), "marker residual"))
        _set(self, "shape", _frozen(np.empty((0, 3)) if self.shape is None else self.shape, (None, 3), "marker shape"))


def fit(x: Array, shape: Array) -> BodyFit:
    """Attitude, position and residual of every frame.

    Parameters
    ----------
    x : ndarray (N, M, 3), m, NaN where a marker is not seen
    shape : ndarray (M, 3), m
    """
    seen: Mask = np.logical_and.reduce(np.isfinite(x), axis=2)
    w: Array = seen.astype(np.float64)
    count: Array = w.sum(axis=1)
    total = np.maximum(count, 1)[:, None]
    filled = np.where(seen[:, :, None], x, 0.0)
    x_mean: Array = filled.sum(axis=1) / total
    s_mean = w @ shape / total
    away = (filled - x_mean[:, None]) * w[:, :, None]
    rest = (shape - s_mean[:, None]) * w[:, :, None]
    R = so3.nearest_rotation(np.einsum("nmi,nmj->nij", away, rest))
    p = x_mean - np.einsum("nij,nj->ni", R, s_mean)
    miss = (away - np.einsum("nij,nmj->nmi", R, rest)) * w[:, :, None]
    residual = np.sqrt(np.einsum("nmi,nmi->n", miss, miss) / total[:, 0])
    lost = (count < 3) | _on_a_line(seen, shape)
    R[lost], p[lost], residual[lost] = np.nan, np.nan, np.nan
    return BodyFit(R, p, residual)


def _on_a_line(seen: Mask, shape: Array) -> Mask:
    """Frames whose seen markers lie (nearly) on one line; each set of markers is looked at once."""
    sets, which = np.unique(np.packbits(seen, axis=1), axis=0, return_inverse=True)
    flat = np.empty(len(sets), dtype=bool)
    for k, packed in enumerate(sets):
        places = shape[np.unpackbits(packed, count=len(shape)).astype(bool)]
        size = np.linalg.svd(places - places.mean(axis=0), compute_uv=False) if len(places) > 1 else np.zeros(2)
        flat[k] = not size[1] > FLATTEST * size[0]
    return flat[which.reshape(-1)]


def mean_shape(x: Array) -> Array:
    """The markers' places (M, 3) in the body's frame, from a recording of them (N, M, 3), m.

    The shape is the mean over frames, each laid over the others; frames in which a marker is far from where it
    belongs (swaps) have little weight. The frame is stated by the markers' order: the first is the origin, x points
    to the second, z is across the plane of these two and the third (x cross the way to the third), y completes. The
    third is the first that lies off the line (see `frame_markers`). The same markers in the same order give the same
    frame in every recording.

    Raises
    ------
    DataError
        If fewer than three markers are ever seen together, or they lie on one line.
    """
    x = x[:: max(1, len(x) // MOST_FRAMES)]
    whole = np.isfinite(x).all(axis=(1, 2))
    if not whole.any():
        never = int(np.isnan(x[:, :, 0]).all(axis=0).sum())
        extra = f" ({never} of {x.shape[1]} markers are never seen)" if never else ""
        raise DataError(f"the markers are never all seen in one frame{extra}; name those that are, or give a template")
    full = x[whole]
    shape = _typical(full)
    frame_markers(shape)  # refuses markers on a line
    for _ in range(ROUNDS):
        found = fit(x, shape)
        in_body = np.einsum("nji,nmj->nmi", found.R, x - found.p[:, None])
        far = np.linalg.norm(in_body - shape, axis=2)
        limit = 2 * np.nanmedian(far) + 1e-9
        weight = np.where(np.isfinite(far), np.minimum(1.0, limit / np.maximum(far, 1e-12)) ** 2, 0.0)
        total = np.maximum(np.einsum("nm->m", weight), 1e-300)
        moved = np.einsum("nm,nmi->mi", weight, np.nan_to_num(in_body)) / total[:, None]
        done = np.abs(moved - shape).max() < 1e-8
        shape = moved
        if done:
            break
    return framed(shape)


def _typical(full: Array) -> Array:
    """The frame (M, 3) whose edges are nearest to the median edges: not one in which markers are swapped."""
    edges = np.linalg.norm(full[:, :, None] - full[:, None, :], axis=3)
    off = np.abs(edges - np.median(edges, axis=0)).sum(axis=(1, 2))
    return full[int(np.argmin(off))]


def frame_markers(shape: Array) -> tuple[int, int, int]:
    """Which markers carry the frame: the first, the second, and the first of the others that is off their line.

    Raises
    ------
    DataError
        If there is none.
    """
    if len(shape) < 3:
        raise DataError(f"{len(shape)} markers; an attitude needs three or more")
    along = shape[1] - shape[0]
    for k in range(2, len(shape)):
        edges = np.array([along, shape[k] - shape[0], shape[k] - shape[1]])
        longest = np.linalg.norm(edges, axis=1).max()
        height = np.linalg.norm(np.cross(along, edges[1])) / max(longest, 1e-12)
        if height > FLATTEST * longest:
            return 0, 1, k
    raise DataError(
        "the markers lie on one line (or two are the same): the turn about it cannot be seen; use one that is off it"
    )


def framed(shape: Array) -> Array:
    """`shape` moved and turned into the frame that its own markers state (see `mean_shape`)."""
    a, b, c = frame_markers(shape)
    x = shape[b] - shape[a]
    z = np.cross(x, shape[c] - shape[a])
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    return (shape - shape[a]) @ np.column_stack([x, np.cross(z, x), z])


def edges_sd(x: Array) -> Array:
    """How much the distance between any two markers varies, robustly (M, M), m: zero for a rigid body.

    NaN for pairs that are never seen together.
    """
    x = x[:: max(1, len(x) // MOST_FRAMES)]
    out = np.full((x.shape[1],) * 2, np.nan)
    for i in range(x.shape[1]):
        for j in range(i + 1, x.shape[1]):
            d = np.linalg.norm(x[:, i] - x[:, j], axis=1)
            d = d[np.isfinite(d)]
            if len(d):
                out[i, j] = out[j, i] = 1.4826 * np.median(np.abs(d - np.median(d)))
    return out
