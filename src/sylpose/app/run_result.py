"""What a run comes to."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from sylpose.results import Trajectory

__all__ = ["Run"]


@dataclass(frozen=True, eq=False)
class Run:
    """What `track_session` did.

    Attributes:
        trajectories: of all frames, by object; with one camera their unit is "first distances", unless the object's size is
            known from another take.
        files: that were written.
        problems: sentences about what could not be read.
        seconds: where the time went: "reading", "tracking" (detection, matching, solving), "saving" (checkpoints),
            "overlay", "smoothing" and "plots".
        changes: by object, what was found wrong with the calibration, a sentence for each camera; nothing unless that was
            asked for.
        network: by object, what its nodes told each other, a sentence; nothing where one process did everything.
    """

    trajectories: dict[str, Trajectory]
    files: tuple[Path, ...]
    problems: tuple[str, ...]
    seconds: dict[str, float]
    changes: dict[str, tuple[str, ...]] = field(default_factory=dict)
    network: dict[str, str] = field(default_factory=dict)

    @property
    def trajectory(self) -> Trajectory:
        """Of the only object.

        Raises:
            ValueError: there are several.
        """
        if len(self.trajectories) > 1:
            raise ValueError(f"several objects ({', '.join(self.trajectories)}): take one of `trajectories`")
        return next(iter(self.trajectories.values()))
