"""How alike a gyroscope and the optics turn, for every offset between their clocks at once (see `clock`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from margcal.core.types import Array, Mask
from margcal.methods.reference_rates import ReferenceRates

GRID_HZ = 50.0
SPIKE = 1.5
"""Rates of the optics above this multiple of their 98th percentile are cut down to it for the correlation."""
LEAST_OVERLAP_S, LEAST_OVERLAP = 5.0, 0.5
"""What must be in common, also as part of the shorter of the two: short overlaps are alike by chance."""


@dataclass(frozen=True)
class Curve:
    """Multiple correlation of w with z against the offset (s), before any fit."""

    lags: Array
    correlation: Array


def correlate(t_gyr: Array, z: Array, rates: ReferenceRates) -> Curve:
    """Multiple correlation of w with z and a constant, for every lag with enough in common.

    Parameters
    ----------
    z : ndarray (M, 3)
        Gyroscope, its bias roughly taken out.
    """
    h = 1 / GRID_HZ
    a, seen_a = _on_grid(t_gyr, z, np.ones(len(z), dtype=bool), h)
    b, seen_b = _on_grid(rates.t, _without_spikes(rates), rates.valid, h)
    size = 1 << int(np.ceil(np.log2(len(a) + len(b))))
    shift = np.concatenate([np.arange(-len(a) + 1, 0), np.arange(len(b))])

    def spectra(x: Array) -> NDArray[np.complex128]:
        return np.fft.rfft(x, size, axis=0)

    def sums(x: NDArray[np.complex128], y: NDArray[np.complex128]) -> Array:
        """Sum of x(i) y(i + lag) for every lag."""
        return np.fft.irfft(y * np.conj(x), size, axis=0)[shift]

    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    ma, fa = spectra(seen_a), spectra(a)
    mb, fb = spectra(seen_b), spectra(b)
    n = sums(ma, mb)
    enough = n > max(LEAST_OVERLAP_S * GRID_HZ, LEAST_OVERLAP * min(seen_a.sum(), seen_b.sum()))
    n = np.where(enough, n, 1.0)
    mean_a = np.stack([sums(fa[:, k], mb) for k in range(3)], axis=-1) / n[:, None]
    mean_b = np.stack([sums(ma, fb[:, k]) for k in range(3)], axis=-1) / n[:, None]
    V = np.empty((len(n), 3, 3))
    for i, j in pairs:
        V[:, i, j] = V[:, j, i] = sums(spectra(a[:, i] * a[:, j]), mb) / n - mean_a[:, i] * mean_a[:, j]
    W = sums(ma, spectra(np.sum(b * b, axis=1))) / n - np.sum(mean_b**2, axis=1)
    X = np.empty((len(n), 3, 3))
    for i in range(3):
        for j in range(3):
            X[:, i, j] = sums(fa[:, i], fb[:, j]) / n - mean_a[:, i] * mean_b[:, j]
    floor = 1e-6 * float(np.mean(a * a)) + 1e-300
    told = np.sum(X * np.linalg.solve(V + floor * np.eye(3), X), axis=(1, 2))
    share = np.where(enough, told / np.maximum(W, 1e-9 * float(np.mean(b * b)) + 1e-300), 0.0)
    return Curve(shift * h + rates.t[0] - t_gyr[0], np.sqrt(np.clip(share, 0.0, 1.0)))


def _without_spikes(rates: ReferenceRates) -> Array:
    """w with rates that no body has cut down: markers that are taken for each other make hundreds of rad/s."""
    turning = np.linalg.norm(rates.w, axis=1, keepdims=True)
    most = SPIKE * np.quantile(turning[rates.valid], 0.98) + 1e-12
    return rates.w * np.minimum(1.0, most / np.maximum(turning, 1e-12))


def _on_grid(t: Array, x: Array, seen: Mask, h: float) -> tuple[Array, Array]:
    """x (N, 3) in cells of length h: their means (0 where nothing was seen), and which cells hold anything."""
    cell = np.floor((t - t[0]) / h + 0.5).astype(np.int64)
    good: Mask = np.logical_and(seen, np.isfinite(x).all(axis=1))
    count = np.bincount(cell[good], minlength=cell[-1] + 1).astype(np.float64)
    mean = np.stack([np.bincount(cell[good], weights=c[good], minlength=cell[-1] + 1) for c in x.T], axis=-1)
    mean /= np.maximum(count, 1)[:, None]
    mask = (count > 0).astype(np.float64)
    # slow sensors leave cells empty: those between two full neighbours are theirs
    for gap in (1, 2):
        empty = np.flatnonzero(mask == 0)
        empty = empty[(empty >= 1) & (empty < len(mask) - gap)]
        near = empty[(mask[empty - 1] > 0) & (mask[empty + gap] > 0)]
        mean[near] = (mean[near - 1] * gap + mean[near + gap]) / (gap + 1)
        mask[near] = 1.0
    return mean, mask
