"""Least absolute deviations: the certified optimum against HiGHS, ties, outliers, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.optimize import linprog

from margcal.core.errors import DataError
from margcal.core.lad import least_absolute, least_lengths


def highs(A: np.ndarray, b: np.ndarray) -> float:
    """The optimal cost by linear programming."""
    n, p = A.shape
    c = np.concatenate([np.zeros(p), np.ones(2 * n)])
    rows = sparse.hstack([sparse.csr_matrix(A), -sparse.eye(n), sparse.eye(n)]).tocsc()
    tight = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
    found = linprog(
        c, A_eq=rows, b_eq=b, bounds=[(None, None)] * p + [(0, None)] * 2 * n, method="highs-ds", options=tight
    )
    return float(found.fun)


def problem(n: int, kind: str, seed: int, p: int = 4) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    A = np.column_stack([9.8 * rng.standard_normal((n, p - 1)), -np.ones(n)])
    b = A @ rng.standard_normal((p, 3)) + 0.1 * rng.laplace(size=(n, 3))
    if kind == "quantised":
        A, b = np.round(A, 1), np.round(b, 1)
    elif kind == "ties":  # small integers: many rows through every vertex
        A, b = np.round(A / 5), np.round(b)
        A[:, -1] = -1
    elif kind == "outliers":
        b[rng.random(n) < 0.3] += 30
    elif kind == "counts":
        A[:, :-1] = np.round(A[:, :-1] * 1000 + 32768)
    return A, b


@pytest.mark.parametrize("kind", ["laplace", "quantised", "ties", "outliers", "counts"])
@pytest.mark.parametrize("n", [30, 400, 1200])
def test_optimum_is_that_of_highs(n: int, kind: str) -> None:
    A, b = problem(n, kind, seed=n)
    found = least_absolute(A, b)
    assert np.all(found.gap <= 1e-12)
    assert np.all(np.abs(found.slopes) <= 1 + 1e-8)
    for k in range(3):
        best = highs(A, b[:, k])
        assert abs(np.abs(A @ found.x[:, k] - b[:, k]).sum() - best) <= 1e-10 * best
        # the vertex: as many rows as unknowns hold exactly
        assert np.abs(A[found.rows[k]] @ found.x[:, k] - b[found.rows[k], k]).max() < 1e-9 * np.abs(b).max() + 1e-9


def test_certificate_is_checked_from_outside() -> None:
    """The slopes make a dual point that is feasible and as high as the cost."""
    A, b = problem(2000, "outliers", seed=5)
    found = least_absolute(A, b[:, 0])
    r = A @ found.x[:, 0] - b[:, 0]
    y = np.sign(r)
    y[found.rows[0]] = found.slopes[0]
    assert np.abs(A.T @ y).max() < 1e-9 * np.abs(A).sum()
    assert -b[:, 0] @ y == pytest.approx(found.cost[0], rel=1e-10)


def test_large_problem_is_certified() -> None:
    A, b = problem(100_000, "laplace", seed=1)
    found = least_absolute(A, b)
    assert np.all(found.gap <= 1e-12)


def test_line_through_median() -> None:
    """One unknown: the median."""
    b = np.array([3.0, -1.0, 100.0, 4.0, 2.5])
    assert least_absolute(np.ones((5, 1)), b).x[0, 0] == pytest.approx(3.0, abs=1e-14)


def test_lengths_do_not_depend_on_axes() -> None:
    A, b = problem(2000, "outliers", seed=7)
    turn = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    x, cost = least_lengths(A, b)
    turned, cost_turned = least_lengths(A, b @ turn)
    assert turned == pytest.approx(x @ turn, abs=1e-4)
    assert cost_turned == pytest.approx(cost, rel=1e-8)
    # no step to a side is downhill
    for step in np.random.default_rng(2).standard_normal((20, 4, 3)) * 1e-3:
        assert np.linalg.norm(A @ (x + step) - b, axis=1).sum() >= cost


@pytest.mark.parametrize("A", [np.ones((10, 2)), np.zeros((10, 1)), np.eye(3)])
def test_undetermined_is_refused(A: np.ndarray) -> None:
    with pytest.raises(DataError):
        least_absolute(A, np.arange(float(len(A))))
