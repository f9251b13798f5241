"""What every test may use. Real recordings are read from where they lie and never copied into the project."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: threads would only wait for each other

from collections.abc import Callable
from pathlib import Path

import pytest

_DEFAULT = Path(__file__).resolve().parents[1] / ".." / "shared" / "data"


def find_data(name: str) -> Path:
    """Path of a real recording such as ``imu_tk/xsens_mti_multipose.parquet``; the test is skipped without it."""
    path = Path(os.environ.get("MARGCAL_DATA", _DEFAULT)).resolve() / name
    if not path.exists():
        pytest.skip(f"real recording {name} is not here: set MARGCAL_DATA to the folder that holds it ({path})")
    return path


@pytest.fixture(scope="session")
def data_file() -> Callable[[str], Path]:
    """``data_file('imu_tk/xsens_mti_multipose.parquet')`` -> Path, or the test is skipped and says why."""
    return find_data
