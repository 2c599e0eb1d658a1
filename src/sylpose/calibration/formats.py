"""All formats of calibrations: how each is told and read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from sylpose.calibration import anipose, caliscope, filestorage, native, stereo
from sylpose.calibration.build import Sizes
from sylpose.calibration.content import content_of
from sylpose.rig import Rig

__all__ = ["FORMATS", "Format", "told_format"]


class Format(NamedTuple):
    """A format of calibrations.

    Attributes:
        name: for people.
        tells: whether a file's content is of it, however whole.
        read: the rig of such a file; of formats that do not say how large images are, with what else tells that.
        sized: whether every such file says how large its images are.
    """

    name: str
    tells: Callable[[Any], bool]
    read: Callable[..., Rig]
    sized: bool = True

    def rig(self, data: Any, path: Path, sizes: Sizes | None) -> Rig:
        """The rig of a file with this content."""
        return self.read(data, path) if self.sized else self.read(data, path, sizes)


# By kind of content; those that are told by more stand before those that are told by less.
FORMATS: dict[str, tuple[Format, ...]] = {
    "toml": (
        Format("sylpose TOML", lambda data: "format" in data, native.read),
        Format("Caliscope TOML", caliscope.is_caliscope, caliscope.read),
        Format("Anipose TOML", anipose.is_anipose, anipose.read),
    ),
    "plain": (
        Format("OpenCV stereo", stereo.is_stereo, stereo.read, sized=False),
        Format("OpenCV FileStorage", filestorage.is_calibration, filestorage.read, sized=False),
    ),
    "xml": (),
    "csv": (),
    "unknown": (),
}
KNOWN = (
    "known are sylpose, Anipose and Caliscope TOML, OpenCV FileStorage YAML, JSON and XML with a node per camera or a "
    "sequence 'cameras', and OpenCV stereo"
)


def told_format(path: Path) -> tuple[Format, Any]:
    """The format of a file, told from its content, and that.

    Raises:
        OSError: it cannot be read.
        ValueError: it is of no format that is known.
    """
    kind, data = content_of(path)
    for format_ in FORMATS[kind]:
        if format_.tells(data):
            return format_, data
    raise ValueError(f"not a calibration of a known format; {KNOWN}")
