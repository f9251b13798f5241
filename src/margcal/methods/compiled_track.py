"""The compiled kernels of the orientation filters, for their `batch` functions; see `tracking` and `core.compiled`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from margcal.core import compiled
from margcal.core.types import Array
from margcal.methods.tracking import Flags


class CompiledTrack(NamedTuple):
    """What a kernel makes of a recording: as in `tracking.Track`, with the state's arrays as they ended."""

    q: Array
    variance: Array
    flags: Flags
    memory: tuple[Array, Array]


def run(
    name: Literal["ekf_quest", "vector_selection", "strapdown"],
    params: Sequence[float],
    memory: tuple[tuple[Array, int], tuple[Array, int]],
    dt: Array,
    gyr: Array,
    acc: ArrayLike,
    mag: ArrayLike,
) -> CompiledTrack | None:
    """A filter's `batch` by its compiled kernel; None where that cannot be had (or there is nothing to do).

    Parameters
    ----------
    name : the kernel
    params : the filter's params, plain numbers
    memory : the two arrays of the state, each with the number of its own axes (1: vector, 2: matrix)
    dt : (..., N) s
    gyr, acc, mag : (..., N, 3)
    """
    kernels = compiled.extension()
    if kernels is None or dt.size == 0 or any(np.ndim(p) for p in params):
        return None
    lead, n = dt.shape[:-1], dt.shape[-1]
    nodes = dt.size // n

    def rows(a: ArrayLike, own: tuple[int, ...]) -> Array:
        wide = np.broadcast_to(np.asarray(a, dtype=np.float64), (*lead, *own))
        return np.ascontiguousarray(wide.reshape(nodes, *own))

    own = [a.shape[a.ndim - axes :] for a, axes in memory]
    state = np.concatenate([rows(a, s).reshape(nodes, -1) for (a, _), s in zip(memory, own)], axis=1)
    numbers = np.tile(np.array(params, dtype=np.float64), (nodes, 1))
    q, variance, flags = np.empty((nodes, n, 4)), np.empty((nodes, n, 3)), np.empty((nodes, n), dtype=np.uint8)
    run_kernel = {
        "ekf_quest": kernels.ekf_quest,
        "vector_selection": kernels.vector_selection,
        "strapdown": kernels.strapdown,
    }[name]
    vectors = [rows(a, (n, 3)) for a in (gyr, acc, mag)]
    run_kernel(numbers, state, rows(dt, (n,)), vectors[0], vectors[1], vectors[2], q, variance, flags)
    first = int(np.prod(own[0]))
    after = state[:, :first].reshape(*lead, *own[0]), state[:, first:].reshape(*lead, *own[1])
    return CompiledTrack(q.reshape(*lead, n, 4), variance.reshape(*lead, n, 3), flags.reshape(*lead, n), after)
