"""What one camera tells all the others: small frozen records of numbers, no image, no feature, no function.

A frame's decisions are functions of these alone (`joint`, `phases`), so that every camera that hears the same comes to the
same (docs/map.md, "Two halves").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.landmarks.alignment import Sights
from sylpose.relative_pose.terms import TermData

__all__ = [
    "Ages",
    "Agreed",
    "Chance",
    "Following",
    "Known",
    "Middle",
    "Moved",
    "Recognised",
    "Seen",
    "Sighted",
    "Stance",
    "placed",
    "total_ages",
]


# Places that need not be known well are told to this share of the object's radius, at least (choice).
PLACED = 1.0 / 256.0


def placed(points: FloatArray, radius: float) -> FloatArray:
    """Points (n, 3) about where they are, on an object of some radius: rounded, for few bytes."""
    grid = 2.0 ** np.floor(np.log2(PLACED * radius))
    return np.asarray(np.round(points / grid) * grid)


@dataclass(frozen=True, eq=False)
class Following:
    """How one camera's followed features are.

    Attributes:
        found, alive: how many are still seen; how many of the anchor's are on the object for all that is known.
        looks: whether it has an image and the object should be in it.
        follows: whether it had an image before, to follow them from.
    """

    found: int
    alive: int
    looks: bool
    follows: bool

    @classmethod
    def none(cls) -> Following:
        """Of a camera that sees nothing."""
        return cls(0, 0, False, False)


@dataclass(frozen=True, eq=False)
class Moved:
    """One camera's matches with one earlier frame that do not stand still.

    Attributes:
        term: the matches.
        shift_px: (n,) by how much each is displaced, pixels.
        jitter_px: by how much those that stand still scatter in each direction, pixels.
        standing: how many these are.
    """

    term: TermData
    shift_px: FloatArray
    jitter_px: float
    standing: int


@dataclass(frozen=True, eq=False)
class Middle:
    """By how much what one camera sees in its box is displaced since it was seen first.

    Attributes:
        seen: number of features at the box's middle; middle_px: what half of their matches are displaced by less than;
            still: whether that is no more than what stands still is.
        moved: number of features in all of the box that do not stand still; moved_px: what half of these are displaced by.
    """

    seen: int
    middle_px: float
    still: bool
    moved: int
    moved_px: float

    @classmethod
    def none(cls) -> Middle:
        """Of a camera that sees nothing."""
        return cls(0, np.nan, False, 0, np.nan)


@dataclass(frozen=True, eq=False)
class Ages:
    """In how many frames one camera's landmarks were seen.

    Attributes:
        values, counts: (k,) so many frames, that many landmarks.
        moving: how many of them move or did.
        oldest: the largest value of all landmarks of the frames that were matched with.
        depth_sd: how well their depth is known, standard deviation of the middle one, length units; NaN without any.
    """

    values: FloatArray
    counts: FloatArray
    moving: int = 0
    oldest: int = 0
    depth_sd: float = np.nan

    @classmethod
    def of(cls, seen: FloatArray, moving: int = 0, oldest: int = 0, depth_sd: float = np.nan) -> Ages:
        """Of landmarks seen in so many frames (n,)."""
        counts = np.bincount(seen.astype(np.int64))
        values = np.flatnonzero(counts)
        return cls(values.astype(float), counts[values].astype(float), moving, oldest, depth_sd)


def total_ages(of_cameras: list[Ages]) -> FloatArray:
    """(n,) in how many frames each landmark of all cameras was seen, in order."""
    values = np.concatenate([ages.values for ages in of_cameras])
    return np.sort(np.repeat(values, np.concatenate([ages.counts for ages in of_cameras]).astype(np.int64)))


@dataclass(frozen=True, eq=False)
class Chance:
    """How many of one camera's features agree with a pose.

    Attributes:
        matches: weighted matches, of which a feature may have several.
        inliers, tried: features.
        by_chance: how many would agree if their matches were random.
        unknowns: that the camera's surface adds.
    """

    matches: int
    inliers: int
    tried: int
    by_chance: float
    unknowns: int


@dataclass(frozen=True, eq=False)
class Known:
    """One camera's landmarks that agree with a pose and whose depth is known.

    Attributes:
        sights: the matches.
        weights: (n,) 0 for those that are not used.
    """

    sights: Sights
    weights: FloatArray

    @classmethod
    def none(cls) -> Known:
        """Of a camera that sees nothing."""
        return cls(Sights.none(), np.empty(0))


@dataclass(frozen=True, eq=False)
class Agreed:
    """What of one camera's matches agrees with the frame's pose.

    Attributes:
        matches: number of inliers, of so many matches that were tried.
        references: numbers of the frames they are matches with, and weights: the sum of each one's weights.
        ages: of the inliers' landmarks.
        features: number of features that are inliers, and moved: of those that have moved with the object, now or before.
        tried_moved: number of features, inliers or not, that were seen to move with the object before.
        moving: number of features that are inliers and do not stand still.
        residual_px: the rms of their residuals, NaN without any.
        sees: whether the frame has any feature of this camera.
        strong: number of features that are inliers and not faint.
        noise_px: standard deviation of the inliers' residuals, whatever a few of them are; NaN without any.
        tried_features: number of features that have matches, inliers or not.
    """

    matches: int
    tried: int
    references: tuple[int, ...]
    weights: tuple[float, ...]
    ages: Ages
    features: int
    moved: int
    tried_moved: int
    residual_px: float
    sees: bool
    moving: int = 0
    strong: int = 0
    noise_px: float = np.nan
    tried_features: int = 0

    @classmethod
    def none(cls) -> Agreed:
        """Of a camera that sees nothing."""
        return cls(0, 0, (), (), Ages.of(np.empty(0)), 0, 0, 0, np.nan, False)


@dataclass(frozen=True, eq=False)
class Recognised:
    """One camera's features that look like landmarks of its keyframes.

    Attributes:
        points: (n, 3) the landmarks, object's frame; pixels: (n, 2) the features.
    """

    points: FloatArray
    pixels: FloatArray

    @classmethod
    def none(cls) -> Recognised:
        """Of a camera that sees nothing."""
        return cls(np.empty((0, 3)), np.empty((0, 2)))


@dataclass(frozen=True, eq=False)
class Seen:
    """What one camera saw in several frames, and did not tell before; together with that, what all remember of it.

    Attributes:
        frame: (n,) numbers of frames; landmark: (n,) numbers of its landmarks; image: (n, 2) normalised points.
        known: (m,) in order, the numbers of those that are to be used now; place: (m, 3) about where each is on the object.
    """

    frame: IntArray
    landmark: IntArray
    image: FloatArray
    known: IntArray
    place: FloatArray

    @classmethod
    def none(cls) -> Seen:
        """Of a camera that sees nothing."""
        no = np.empty(0, np.int64)
        return cls(no, no, np.empty((0, 2)), no, np.empty((0, 3)))

    def of(self, frames: Sequence[int], landmarks: IntArray | None = None) -> Seen:
        """What was seen in some frames, of some landmarks: sights alone."""
        kept = np.isin(self.frame, frames)
        kept &= True if landmarks is None else np.isin(self.landmark, landmarks)
        return replace(Seen.none(), frame=self.frame[kept], landmark=self.landmark[kept], image=self.image[kept])

    def among(self, later: Seen) -> Seen:
        """With what was told later: sights alone, in order of frames and landmarks."""
        frame, landmark = np.concatenate([self.frame, later.frame]), np.concatenate([self.landmark, later.landmark])
        order = np.lexsort([landmark, frame])
        image = np.concatenate([self.image, later.image])[order]
        return replace(Seen.none(), frame=frame[order], landmark=landmark[order], image=image)


@dataclass(frozen=True, eq=False)
class Sighted:
    """All that one camera saw in some frames: what refining them together needs.

    Attributes:
        frame: (n,) which of these frames; landmark: (n,) which of the landmarks; image: (n, 2) normalised points.
        known: (m,) the landmarks' numbers, in order; place: (m, 3) about where each is on the object; moved: (m,) 1 for
            those that are known to have moved with it, or 0.
    """

    frame: IntArray
    landmark: IntArray
    image: FloatArray
    known: IntArray
    place: FloatArray
    moved: IntArray

    @classmethod
    def none(cls) -> Sighted:
        """Of a camera that sees nothing."""
        no = np.empty(0, np.int64)
        return cls(no, no, np.empty((0, 2)), no, np.empty((0, 3)), no)


@dataclass(frozen=True, eq=False)
class Stance:
    """How one camera stands, for all that its background shows.

    Attributes:
        odd: whether it does not look as it did.
        turn: (3,) rotation vector, camera's axes, that it seems to be turned by since it last stood; 0 where it is nothing
            like that.
        sd: standard deviation about the axis of which least is known, radians.
        since: the recording's number of the first frame that showed it.
        certain: whether two frames in a row showed the same.
    """

    odd: bool = False
    turn: FloatArray = field(default_factory=lambda: np.zeros(3))
    sd: float = 0.0
    since: int = 0
    certain: bool = False

    @property
    def angle(self) -> float:
        """That it seems to be turned by, radians."""
        return float(np.linalg.norm(self.turn))
