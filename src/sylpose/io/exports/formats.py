"""Export formats of trajectories, importable without the writers' dependencies."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["EXPORT_FORMATS", "ExportFormat"]


class ExportFormat(NamedTuple):
    """Export format of trajectories.

    Attributes:
        suffixes: suffixes of its file; empty for a folder.
        package: import name of the required package; "" for none.
        extra: extra of sylpose that installs it.
    """

    suffixes: tuple[str, ...]
    package: str = ""
    extra: str = ""


EXPORT_FORMATS: dict[str, ExportFormat] = {
    "csv": ExportFormat((".csv",)),
    "tum": ExportFormat((".tum", ".txt")),
    "trc": ExportFormat((".trc",)),
    "bvh": ExportFormat((".bvh",)),
    "gltf": ExportFormat((".glb", ".gltf")),
    "c3d": ExportFormat((".c3d",), "ezc3d", "export"),
    "parquet": ExportFormat((".parquet",), "pyarrow", "export"),
    "rosbag": ExportFormat((), "rosbags", "export"),
    "usd": ExportFormat((".usda", ".usdc", ".usd"), "pxr", "usd"),
}
