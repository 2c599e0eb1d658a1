"""Detection of cameras that disagree with the others, such as bumped or badly calibrated ones.

A single frame with a high variance inflation proves little: a person may walk by, or the object may be at the image
border. A moved camera is inflated in frame after frame, until the landmarks that it adds compensate for its motion.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from sylpose.geometry.arrays import BoolArray, FloatArray
from sylpose.results import Trajectory

# A camera counts as inflated in a frame if its variance inflation exceeds this value and this multiple of the other
# cameras' median. Of two or three cameras that contradict each other, the faulty one cannot be identified (measured:
# docs/history/benchmarks.md, "A bumped camera").
MIN_INFLATION, MIN_INFLATION_OVER_MEDIAN = 2.0, 2.0
# A disagreement begins with the first of this many frames, of which all but one are inflated (measured: the same), ...
WINDOW_FRAMES = 8
# ... and ends when none of this many frames is inflated (choice).
RECOVERY_FRAMES = 12
# ... It is discarded if another camera is inflated in more than this share of its frames: alternating cameras mean that
# all are slightly miscalibrated (measured: board4, 0.2 and 0.4 of them; none where one was bumped into).
MAX_OTHERS_SHARE = 0.15
# Cameras contradict each other if at least this many are inflated by this factor in this share of the frames; the
# faulty one cannot be identified then (measured: good calibrations 0, board4 0.2, one or all off by some degrees 0.45
# to 0.97).
CONTRADICTION_INFLATION, MIN_CONTRADICTING, MIN_FRAME_SHARE = 5.0, 2, 0.4
# A camera is noisy if its residuals exceed this multiple of the others' median, and this many pixels (choice: typical
# of blur, an interlaced image or a wrong lens model; a board at the image border has twice the others').
NOISY_RATIO, MIN_NOISY_PX = 4.0, 0.6


@dataclass(frozen=True)
class Disagreement:
    """Interval of frames in which one camera disagrees with the others.

    Attributes:
        camera: its name.
        first, last: numbers of the first and the last frame with variance inflation.
        is_ongoing: whether the disagreement continues to the end.
    """

    camera: str
    first: int
    last: int
    is_ongoing: bool

    @property
    def text(self) -> str:
        """Describe the disagreement in one sentence."""
        if self.is_ongoing:
            return f"{self.camera} disagrees with the others since frame {self.first}: was it moved?"
        return f"{self.camera} disagreed with the others from frame {self.first} to {self.last}: was it moved?"


def find_disagreements(trajectory: Trajectory) -> list[Disagreement]:
    """Find the cameras that disagree with the others, and when.

    Returns:
        Disagreements in the order of their first frames; empty with fewer than three cameras, where the faulty one
        cannot be identified.
    """
    n = len(trajectory.camera_names)
    frames = [f for f in trajectory if f.is_measured and len(f.variance_inflation) == n]
    if n < 3 or not frames:
        return []
    inflation, index = np.array([f.variance_inflation for f in frames]), [f.index for f in frames]
    inflated = np.array([_find_inflated_frames(inflation, c) for c in range(n)])
    found = []
    for c, name in enumerate(trajectory.camera_names):
        rows = np.flatnonzero(~np.isnan(inflation[:, c]))
        for first, last in _find_runs(inflated[c, rows]):
            others = np.delete(inflated[:, rows[first] : rows[last] + 1], c, axis=0).mean(axis=1)
            if others.max() > MAX_OTHERS_SHARE:
                continue
            is_ongoing = len(rows) - 1 - last < RECOVERY_FRAMES
            found.append(Disagreement(name, index[rows[first]], index[rows[last]], is_ongoing))
    return sorted(found, key=lambda d: (d.first, d.camera))


def find_contradictions(trajectory: Trajectory) -> list[str]:
    """Describe persistent contradictions between cameras, if any.

    Returns:
        At most one sentence. It names the cameras whose images agree with no pose, or states that the faulty camera
        cannot be identified. Empty with fewer than three cameras.
    """
    n = len(trajectory.camera_names)
    inflation = np.array(
        [f.variance_inflation for f in trajectory if f.is_observed and len(f.variance_inflation) == n]
    ).reshape(-1, n)
    if n < 3 or len(inflation) < WINDOW_FRAMES:
        return []
    is_known = ~np.isnan(inflation).all(axis=0)
    rejected = np.flatnonzero(is_known & (np.isinf(inflation).mean(axis=0) >= MIN_FRAME_SHARE))
    if len(rejected):
        names = " and ".join(trajectory.camera_names[c] for c in rejected)
        if len(rejected) == 1:
            return [f"{names} agrees with no pose of the other cameras: is its calibration another camera's?"]
        return [f"{names} agree with no pose of the other cameras: are their calibrations swapped?"]
    frames = int(np.count_nonzero((inflation > CONTRADICTION_INFLATION).sum(axis=1) >= MIN_CONTRADICTING))
    if frames < MIN_FRAME_SHARE * len(inflation):
        return []
    return [
        f"the cameras contradict each other in {frames} of {len(inflation)} frames, and the faulty one cannot be "
        "identified: check the calibration; pose uncertainty is underestimated"
    ]


def find_noisy_cameras(residuals: FloatArray) -> BoolArray:
    """Find the cameras whose residuals far exceed those of the others.

    Args:
        residuals: (C,) rms of their inliers, pixels; NaN without inliers.

    Returns:
        (C,) mask of noisy cameras.
    """
    out = np.zeros(len(residuals), bool)
    for c in np.flatnonzero(residuals > MIN_NOISY_PX).tolist():
        others = np.delete(residuals, c)
        out[c] = np.isfinite(others).any() and residuals[c] > NOISY_RATIO * np.nanmedian(others)
    return out


def _describe_noisy_cameras(trajectory: Trajectory) -> list[str]:
    """Describe each camera that is noisy over the whole trajectory."""
    frames = [f.residuals for f in trajectory if f.is_measured]
    known = np.array(frames).reshape(-1, len(trajectory.camera_names))
    usual = np.array([np.median(r[np.isfinite(r)]) if np.isfinite(r).any() else np.nan for r in known.T])
    return [
        f"{trajectory.camera_names[c]} is noisier than the others: {usual[c]:.1f} px, where they have "
        f"{np.nanmedian(np.delete(usual, c)):.1f}: is it blurred or badly calibrated?"
        for c in np.flatnonzero(find_noisy_cameras(usual)).tolist()
    ]


def describe_camera_problems(trajectory: Trajectory) -> list[str]:
    """Describe all camera problems of a trajectory.

    Returns:
        Sentences on disagreeing, contradicting and noisy cameras, then the detected faults with their frame counts.
    """
    faults = Counter(fault for frame in trajectory for fault in frame.faults)
    fault_notes = [f"{fault} (in {n} frame{'' if n == 1 else 's'})" for fault, n in faults.most_common()]
    disagreement_notes = [d.text for d in find_disagreements(trajectory)]
    if not disagreement_notes and (contradiction_notes := find_contradictions(trajectory)):
        # With contradicting cameras, a single camera's residuals do not reveal its own noise: noise is not reported.
        return [*contradiction_notes, *fault_notes]
    return [*disagreement_notes, *_describe_noisy_cameras(trajectory), *fault_notes]


def _find_inflated_frames(inflation: FloatArray, camera: int) -> BoolArray:
    """Return a mask (n,) of the frames in which this camera alone is inflated."""
    others = np.delete(inflation, camera, axis=1)
    usual = np.nanmedian(np.where(np.isnan(others), 1.0, others), axis=1)
    return np.asarray(
        (inflation[:, camera] > MIN_INFLATION) & (inflation[:, camera] > MIN_INFLATION_OVER_MEDIAN * usual)
    )


def _find_runs(inflated: BoolArray) -> list[tuple[int, int]]:
    """Find the first and last row of each run in which nearly all rows are inflated."""
    runs: list[tuple[int, int]] = []
    row = 0
    while row + WINDOW_FRAMES <= len(inflated):
        if not (inflated[row] and inflated[row : row + WINDOW_FRAMES].sum() >= WINDOW_FRAMES - 1):
            row += 1
            continue
        last = row
        while inflated[last + 1 : last + 1 + RECOVERY_FRAMES].any():
            last += 1 + int(np.argmax(inflated[last + 1 : last + 1 + RECOVERY_FRAMES]))
        runs.append((row, last))
        row = last + 1
    return runs
