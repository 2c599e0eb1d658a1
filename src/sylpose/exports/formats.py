"""The formats that trajectories are exported in, known without loading what writes them."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["FORMATS", "ExportFormat"]


class ExportFormat(NamedTuple):
    """A format of trajectories.

    Attributes:
        suffixes: of its file; none for a folder.
        package: what must be installed, by the name of its module; "" for none.
        extra: the extra of sylpose that brings it.
    """

    suffixes: tuple[str, ...]
    package: str = ""
    extra: str = ""


FORMATS: dict[str, ExportFormat] = {
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
