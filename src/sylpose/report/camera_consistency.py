"""Cameras that disagree with the others for a while: as one does that was bumped into, or calibrated badly.

A single frame in which a camera is doubted says little: somebody walked by, or the object is seen at its rim. A camera that
was moved is doubted in one frame after the other, until what it learns of the object by then has made up for it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.results import Trajectory

__all__ = ["Disagreement", "contradictions", "disagreements", "noisy", "remarks"]

# A camera is doubted in a frame when what it says has so many times the variance that its matches give it, and so many
# times that of the others' median: of two or three that contradict each other nobody knows which is wrong (measured:
# docs/benchmarks.md, "A bumped camera").
DOUBTED, ALONE = 2.0, 2.0
# It disagrees from the first of so many frames on, of which all but one are doubtful (measured: the same), ...
WINDOW = 8
# ... and no more once it was not doubted in so many frames (choice).
AT_EASE = 12
# ... unless another one is doubted in so many of these frames as well: where cameras take turns, all are calibrated a little
# off (measured: board4, 0.2 and 0.4 of them; none where one was bumped into).
IN_TURN = 0.15
# Cameras contradict each other where so many at least are doubted by this factor, in this share of the frames: nobody knows
# then which of them is wrong (measured: good calibrations 0, board4 0.2, one or all off by some degrees 0.45 to 0.97).
CONTRADICT, VOICES, OFTEN = 5.0, 2, 0.4
# A camera is noisy when its residuals are so many times the others' median, and so many pixels (choice: what blur, an
# interlaced image or a lens that is off show; a board at a camera's rim has twice the others').
NOISY, NOISY_PX = 4.0, 0.6


@dataclass(frozen=True)
class Disagreement:
    """One camera, for a while.

    Attributes:
        camera: its name.
        first, last: numbers of the first and the last frame in which it was doubted.
        lasts: whether that is so to the end.
    """

    camera: str
    first: int
    last: int
    lasts: bool

    @property
    def text(self) -> str:
        """One sentence."""
        if self.lasts:
            return f"{self.camera} disagrees with the others since frame {self.first}: was it moved?"
        return f"{self.camera} disagreed with the others from frame {self.first} to {self.last}: was it moved?"


def disagreements(trajectory: Trajectory) -> list[Disagreement]:
    """In the order of their first frames; none with fewer than three cameras, of which nobody can tell who is wrong."""
    n = len(trajectory.camera_names)
    frames = [f for f in trajectory if f.measured and len(f.doubt) == n]
    if n < 3 or not frames:
        return []
    doubt, index = np.array([f.doubt for f in frames]), [f.index for f in frames]
    alone = np.array([_doubted(doubt, c) for c in range(n)])
    found = []
    for c, name in enumerate(trajectory.camera_names):
        rows = np.flatnonzero(~np.isnan(doubt[:, c]))
        for first, last in _runs(alone[c, rows]):
            others = np.delete(alone[:, rows[first] : rows[last] + 1], c, axis=0).mean(axis=1)
            if others.max() > IN_TURN:
                continue
            lasts = len(rows) - 1 - last < AT_EASE
            found.append(Disagreement(name, index[rows[first]], index[rows[last]], lasts))
    return sorted(found, key=lambda d: (d.first, d.camera))


def contradictions(trajectory: Trajectory) -> list[str]:
    """A sentence where cameras contradict each other over and over: those whose images agree with no pose, by their names;
    or that nobody knows which of them is wrong. None with fewer than three cameras."""
    n = len(trajectory.camera_names)
    doubt = np.array([f.doubt for f in trajectory if f.seen and len(f.doubt) == n]).reshape(-1, n)
    if n < 3 or len(doubt) < WINDOW:
        return []
    asked = ~np.isnan(doubt).all(axis=0)
    refused = np.flatnonzero(asked & (np.isinf(doubt).mean(axis=0) >= OFTEN))
    if len(refused):
        names = " and ".join(trajectory.camera_names[c] for c in refused)
        if len(refused) == 1:
            return [f"what {names} sees agrees with no pose of the others: is its calibration another camera's?"]
        return [f"what {names} see agrees with no pose of the others: are their calibrations exchanged?"]
    frames = int(np.count_nonzero((doubt > CONTRADICT).sum(axis=1) >= VOICES))
    if frames < OFTEN * len(doubt):
        return []
    return [
        f"the cameras contradict each other in {frames} of {len(doubt)} frames, and which of them is wrong cannot be told: "
        "the calibration is off, and poses are more uncertain than they say"
    ]


def noisy(residuals: FloatArray) -> BoolArray:
    """(C,) which cameras are far noisier than the others.

    Args:
        residuals: (C,) rms of their inliers, pixels; NaN without any.
    """
    out = np.zeros(len(residuals), bool)
    for c in np.flatnonzero(residuals > NOISY_PX).tolist():
        others = np.delete(residuals, c)
        out[c] = np.isfinite(others).any() and residuals[c] > NOISY * np.nanmedian(others)
    return out


def _noises(trajectory: Trajectory) -> list[str]:
    """A sentence for each camera that is noisy over all."""
    frames = [f.residuals for f in trajectory if f.measured]
    known = np.array(frames).reshape(-1, len(trajectory.camera_names))
    usual = np.array([np.median(r[np.isfinite(r)]) if np.isfinite(r).any() else np.nan for r in known.T])
    return [
        f"{trajectory.camera_names[c]} is noisier than the others: {usual[c]:.1f} px, where they have "
        f"{np.nanmedian(np.delete(usual, c)):.1f}: is it blurred, or not as it was calibrated?"
        for c in np.flatnonzero(noisy(usual)).tolist()
    ]


def remarks(trajectory: Trajectory) -> list[str]:
    """What is to be said of the cameras: who disagreed, contradicts or is noisy, and the faults that were found, with in how
    many frames."""
    faults = Counter(fault for frame in trajectory for fault in frame.faults)
    said = [f"{fault} (in {n} frame{'' if n == 1 else 's'})" for fault, n in faults.most_common()]
    named = [d.text for d in disagreements(trajectory)]
    if not named and (told := contradictions(trajectory)):
        # What one of them shows of it says nothing about that one: noises are not told.
        return [*told, *said]
    return [*named, *_noises(trajectory), *said]


def _doubted(doubt: FloatArray, camera: int) -> BoolArray:
    """(n,) in which frames a camera is doubted, and alone."""
    others = np.delete(doubt, camera, axis=1)
    usual = np.nanmedian(np.where(np.isnan(others), 1.0, others), axis=1)
    return np.asarray((doubt[:, camera] > DOUBTED) & (doubt[:, camera] > ALONE * usual))


def _runs(doubted: BoolArray) -> list[tuple[int, int]]:
    """First and last row of each while in which nearly all rows are doubtful."""
    runs: list[tuple[int, int]] = []
    row = 0
    while row + WINDOW <= len(doubted):
        if not (doubted[row] and doubted[row : row + WINDOW].sum() >= WINDOW - 1):
            row += 1
            continue
        last = row
        while doubted[last + 1 : last + 1 + AT_EASE].any():
            last += 1 + int(np.argmax(doubted[last + 1 : last + 1 + AT_EASE]))
        runs.append((row, last))
        row = last + 1
    return runs
