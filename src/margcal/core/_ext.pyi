"""Types of the compiled kernels (src/ext/module.cpp). Arrays are C-contiguous float64 (indices int64).

Results go into the arrays that are given last. All raise TypeError or ValueError with the argument's name when
an array has another type, shape or layout.
"""

import numpy as np
from numpy.typing import NDArray

_Array = NDArray[np.float64]
_Index = NDArray[np.int64]
_Flags = NDArray[np.uint8]

def apply(y: _Array, H: _Array, B: _Array, out: _Array) -> None: ...
def moving_scatter(t: _Array, y: _Array, centres: _Array, width: float, sd: _Array) -> None: ...
def integrate(y: _Array, dt: _Array, H: _Array, B: _Array, turn: _Index, sensor: _Index, out: _Array) -> None: ...
def preintegrate(
    y: _Array,
    dt: _Array,
    H: _Array,
    B: _Array,
    noise: _Array,
    dR: _Array,
    J_H: _Array,
    J_B: _Array,
    C: _Array,
) -> None: ...
def ekf_quest(
    params: _Array,
    state: _Array,
    dt: _Array,
    gyr: _Array,
    acc: _Array,
    mag: _Array,
    q: _Array,
    variance: _Array,
    flags: _Flags,
    one_by_one: bool = False,
) -> None: ...
def vector_selection(
    params: _Array,
    state: _Array,
    dt: _Array,
    gyr: _Array,
    acc: _Array,
    mag: _Array,
    q: _Array,
    variance: _Array,
    flags: _Flags,
    one_by_one: bool = False,
) -> None: ...
def strapdown(
    params: _Array,
    state: _Array,
    dt: _Array,
    gyr: _Array,
    acc: _Array,
    mag: _Array,
    q: _Array,
    variance: _Array,
    flags: _Flags,
    one_by_one: bool = False,
) -> None: ...
def lanes() -> str: ...
def use_lanes(name: str) -> None: ...
