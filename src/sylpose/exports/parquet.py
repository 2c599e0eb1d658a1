"""Parquet, through pyarrow: all frames and columns; null where there is no value."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from sylpose.atomic_io import replacing
from sylpose.report.tables import columns_of
from sylpose.results import Trajectory

__all__ = ["write_parquet"]


def write_parquet(trajectory: Trajectory, path: Path) -> list[str]:
    """All of `report.tables`."""
    columns = {name: pa.array(column, from_pandas=True) for name, column in columns_of(trajectory).items()}
    with replacing(path) as part:
        pq.write_table(pa.table(columns), part)
    return []
