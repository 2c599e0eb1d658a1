"""Parquet export, through pyarrow: all frames and columns; null for missing values."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from sylpose.atomic_io import replace_atomically
from sylpose.report.files import build_columns
from sylpose.results import Trajectory

__all__ = ["write_parquet"]


def write_parquet(trajectory: Trajectory, path: Path) -> list[str]:
    """Write all columns of `report.tables`."""
    columns = {name: pa.array(column, from_pandas=True) for name, column in build_columns(trajectory).items()}
    with replace_atomically(path) as part:
        pq.write_table(pa.table(columns), part)
    return []
