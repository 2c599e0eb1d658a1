"""Parquet, through pyarrow: all frames and columns; null where there is no value."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from sylpose.files import replacing
from sylpose.results import Trajectory

__all__ = ["write_parquet"]


def write_parquet(trajectory: Trajectory, path: Path) -> list[str]:
    """The columns of `Trajectory.columns`."""
    columns = {
        name: pa.array(column, from_pandas=isinstance(column, np.ndarray))
        for name, column in trajectory.columns().items()
    }
    with replacing(path) as part:
        pq.write_table(pa.table(columns), part)
    return []
