"""What all cameras know alike of the object: where it is, how it moves, how large it is, which frames it was solved in.

Everything here follows from what the cameras tell each other, so that as many copies as there are cameras stay the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.bundle_adjustment.bundle import Bundled
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.geometry.future import Later
from sylpose.geometry.matrices import covariance_of
from sylpose.geometry.rigid import turn_of
from sylpose.results import UNCERTAIN_TURN
from sylpose.tracking.frame import SolvedFrame
from sylpose.tracking.keyframes import with_keyframe
from sylpose.tracking.klt_frontend import Anchor
from sylpose.tracking.motion_model import Velocity
from sylpose.tracking.object_model import ObjectModel
from sylpose.tracking.reports import Agreed, Seen

__all__ = ["MIN_MOVED", "Joint", "Nudge", "Refinement", "covariance_with_references"]

# An object that is not found is taken to go on as it did: for so many frames, and until its turn (radians) or its place
# (object's radii) is less certain than this (choice).
MAX_COASTING, COASTING_TURN, COASTING_SHIFT = 15, UNCERTAIN_TURN, 1.0
# Frames besides the keyframes that are refined with them (choice).
RECENT = 8
# Where fewer features of the usual contrast than this agreed with the last pose, in the mean over the cameras, faint ones
# are asked for as well: board4, rich enough, has 90 and more (measured: benchmarks/kinds.py, faint) (choice).
STARVES = 60
# A pose is the object's, and not the background's, when so many of the features that agree with it have moved with it, and
# this share of them (choice).
MIN_MOVED, MOVED_SHARE = 8, 0.04


@dataclass(frozen=True, eq=False)
class Nudge:
    """A camera that was turned while it recorded.

    Attributes:
        camera: index in the rig; frame: the recording's number of the first frame after it.
        turn: (3,) rotation vector, camera's axes, that its background turned by since it last stood; sd: standard deviation
            of that, radians, about the axis known least.
    """

    camera: int
    frame: int
    turn: FloatArray
    sd: float

    @property
    def angle(self) -> float:
        """That its background turned by, radians."""
        return float(np.linalg.norm(self.turn))


@dataclass(frozen=True, eq=False)
class Refinement:
    """Frames that are being refined together (`tracking.window`).

    Attributes:
        number: of the last of them.
        frames: as they were when that began, in order.
        names: (m,) whose landmarks are refined with them; known: by camera, their numbers.
        found: what comes of it.
    """

    number: int
    frames: tuple[SolvedFrame, ...]
    names: IntArray
    known: tuple[IntArray, ...]
    found: Later[Bundled]


@dataclass(frozen=True, eq=False)
class Joint:
    """The joint part's state between two frames.

    Attributes:
        object: its size and points.
        last: the last solved frame; None before the first.
        keyframes: solved frames from all sides of the object, in order of time.
        anchor: the frame whose features are followed, if any.
        renewal: number of the frame that will be the next anchor, while that is prepared (`tracking.anchor_preparation`).
        recent: the last few solved frames, in order of time.
        velocity: how it moves.
        missed: frames since the last solved one.
        seen_again: frames in which it was seen, but not well enough, after it was missed.
        lost: whether nothing is known any more of where it is.
        length_sd: the relative standard deviation that all lengths of its path have in common, as long as no turn has told
            them; 0 once one has.
        proven: whether it was ever seen to move against what stands still.
        first_motion: since the first frame as the last one had it, while boxes are all that is known of its depth.
        only_still: whether in the frame at hand only what never moved agreed with a pose.
        nudges: of cameras, in order of time.
        refined: (6, 6) of (w, d), how well the last frame was known that was refined with others: the next ones are known no
            better, since they are found by the same landmarks. None before any was.
        together: the frame after which frames were last refined together, as it was then; None before.
        pending: frames that are being refined together.
        starves: whether features of the usual contrast hardly suffice to track it.
        told: by camera, what it has told of the frames that are known; nothing before the first refinement, and where it is
            forgotten, by all, it is told again.
    """

    object: ObjectModel = field(default_factory=ObjectModel)
    last: SolvedFrame | None = None
    keyframes: tuple[SolvedFrame, ...] = ()
    anchor: Anchor | None = None
    recent: tuple[SolvedFrame, ...] = ()
    velocity: Velocity = field(default_factory=Velocity)
    missed: int = 0
    seen_again: int = 0
    lost: bool = False
    length_sd: float = 0.0
    proven: bool = False
    first_motion: RigidTransform | None = None
    only_still: bool = False
    nudges: tuple[Nudge, ...] = ()
    refined: FloatArray | None = None
    together: SolvedFrame | None = None
    renewal: int | None = None
    pending: Refinement | None = None
    told: tuple[Seen, ...] = ()
    starves: bool = False

    @property
    def base(self) -> SolvedFrame:
        """The last solved frame, once there is one."""
        assert self.last is not None
        return self.last

    @property
    def known(self) -> Mapping[int, SolvedFrame]:
        """The solved frames that later ones may be matched with, by number."""
        frames = [*self.keyframes, *self.recent, self.base]
        if self.anchor is not None:
            frames.append(self.anchor.frame)
        return {frame.number: frame for frame in frames}

    def predicted(self, time: float) -> RigidTransform:
        """The pose that constant velocity gives; the last pose once the object is lost."""
        last = self.base.world_from_object
        return last if self.lost else self.velocity.motion(time - self.base.time) * last

    def begun(self, first: SolvedFrame) -> Joint:
        """With the frame whose pose defines the object's frame."""
        return replace(self, last=first, keyframes=(first,))

    def accepted(
        self, solved: SolvedFrame, motion: RigidTransform, *, anew: bool, agreed: Sequence[Agreed] = ()
    ) -> Joint:
        """With a solved frame.

        Args:
            motion: of the object since the last one.
            anew: whether it has features of its own, to be matched by their looks.
            agreed: by camera, what of its matches agrees.
        """
        velocity = self.velocity.forgotten(stands=self.lost) if self.missed else self.velocity
        if not self.lost:
            elapsed = solved.time - self.base.time
            velocity = velocity.learnt(motion, self.base.world_from_object.translation, elapsed)
        strong, proven = sum(a.strong for a in agreed), self.proven_by(agreed)
        return replace(
            self,
            last=solved,
            # What is followed from an anchor are some features of many; until it has moved all may be background.
            starves=strong < STARVES * len(agreed) if anew and proven and agreed else self.starves,
            keyframes=with_keyframe(self.keyframes, solved) if anew else self.keyframes,
            recent=(*self.recent, solved)[-RECENT:],
            anchor=None if anew or self.anchor is None else replace(self.anchor, age=self.anchor.age + 1),
            renewal=None if anew else self.renewal,
            velocity=velocity,
            missed=0,
            seen_again=0,
            lost=False,
            proven=proven,
            only_still=False,
        )

    def proven_by(self, agreed: Sequence[Agreed]) -> bool:
        """Whether the object was seen to move, in a frame of which so much agrees (by camera) at the latest: by two cameras
        at least, since something may pass by in front of one."""
        seeing = [a.moved for a in agreed if a.features >= MIN_MOVED]
        cameras = sum(2 * moved >= MIN_MOVED for moved in seeing)
        return self.proven or (sum(seeing) >= MIN_MOVED and cameras >= min(2, len(seeing)))

    def stands(self, agreed: Sequence[Agreed]) -> bool:
        """Whether the object was not seen to move yet, nor is in a frame of which so much agrees (by camera): somebody who
        passes by behind it moves as well, but not most of what one camera sees in the boxes."""
        most = any(a.moved >= MIN_MOVED and 2 * a.moved > a.tried for a in agreed)
        return not most and not self.proven_by(agreed)

    def may_be_background(self, agreed: Sequence[Agreed], share: float = MOVED_SHARE) -> bool:
        """Whether a pose is one that the background would have as well: of what agrees with it (by camera) next to nothing,
        or less than a share, was ever seen to move, though the object was. Before the object has moved there is nothing
        else."""
        moved, features = sum(a.moved for a in agreed), sum(a.features for a in agreed)
        return self.proven and moved < max(MIN_MOVED, share * features)

    def without(self, time: float) -> tuple[Joint, FloatArray]:
        """After a frame in which the object was not found: it is taken to have gone on as before, until that says nothing.

        Returns:
            the state; the covariance (6, 6) of (w, d) of where it is thought to be.
        """
        missed, last = self.missed + 1, self.base
        covariance = last.covariance + self.velocity.spread(time - last.time, missed)
        sd = np.sqrt(np.diag(covariance))
        certain = sd[:3].max() < COASTING_TURN and sd[3:].max() < COASTING_SHIFT * self.object.radius
        lost = self.lost or missed > MAX_COASTING or not certain
        return replace(self, missed=missed, lost=lost, only_still=False, renewal=None), covariance

    def with_length(self, solved: SolvedFrame) -> SolvedFrame:
        """A solved frame whose covariance knows that the length of its path is not told."""
        path = solved.world_from_object.translation - self.keyframes[0].world_from_object.translation
        far = float(np.linalg.norm(path))
        along = np.concatenate([np.zeros(3), path / max(far, 1e-300)])
        lacks = (self.length_sd * far) ** 2 - float(along @ solved.covariance @ along)
        return replace(solved, covariance=solved.covariance + max(lacks, 0.0) * np.outer(along, along))

    def moved(self, frames: Mapping[int, SolvedFrame]) -> Joint:
        """With the poses of some frames, by number, refined."""
        anchor = self.anchor
        if anchor is not None and anchor.frame.number in frames:
            anchor = replace(anchor, frame=frames[anchor.frame.number])
        return replace(
            self,
            last=frames.get(self.base.number, self.base),
            keyframes=tuple(frames.get(k.number, k) for k in self.keyframes),
            anchor=anchor,
            recent=tuple(frames.get(k.number, k) for k in self.recent),
        )

    def relearnt(self, radius: float) -> Joint:
        """Once it is known how large the object is: what boxes told of the depth of its landmarks is forgotten, and so are
        the poses that followed from it, which are all but the first frame's."""
        first = replace(self.keyframes[0], age=1.0)
        kept = self.anchor is not None and self.anchor.frame.number == first.number
        return replace(
            self,
            object=replace(self.object, radius=radius, guessed=False),
            keyframes=(first,),
            last=first,
            recent=(),
            refined=None,
            together=None,
            renewal=None,
            pending=None,
            told=(),
            anchor=Anchor(first, self.anchor.age) if kept and self.anchor is not None else None,
        )


def covariance_with_references(
    information: FloatArray,
    now: RigidTransform,
    agreed: Sequence[Agreed],
    known: Mapping[int, SolvedFrame],
    radius: float,
    alike: float = 0.0,
) -> FloatArray:
    """(6, 6) of (w, d), a frame's covariance plus the references' own.

    The references' errors come from common ancestors, so they are taken as fully correlated: then the covariance of their
    weighted mean is at most the weighted mean of their covariances. The weights are their shares of inliers.

    Args:
        information: (6, 6) of (w, d), of the frame's fit.
        now: world_from_object.
        agreed: by camera.
        radius: of the object.
        alike: the correlation of the frame's own error with the references', each along the axes of its covariance.
    """
    shares: dict[int, float] = {}
    for a in agreed:
        for number, weight in zip(a.references, a.weights, strict=True):
            if number in known:  # who tells of another one is wrong
                shares[number] = shares.get(number, 0.0) + weight
    total, inherited = max(sum(shares.values()), 1e-12), np.zeros((6, 6))
    for number, weight in shares.items():
        # An error of the reference's pose, in world axes, turns with the object.
        turn = turn_of(now) @ turn_of(known[number].world_from_object).T
        both = np.kron(np.eye(2), turn)
        inherited += weight / total * (both @ known[number].covariance @ both.T)
    # What cannot be observed is bounded: no motion by half a turn or by the object's size is matched.
    bound = np.repeat([np.pi**-2, radius**-2], 3)
    own = covariance_of(information + np.diag(bound))
    if not alike:
        return own + inherited
    unit = np.repeat([1.0, 1.0 / radius], 3)
    roots = [_root(unit[:, None] * covariance * unit) for covariance in (own, inherited)]
    both = alike * roots[0] @ roots[1] / np.outer(unit, unit)
    return own + inherited + both + both.T


def _root(covariance: FloatArray) -> FloatArray:
    """Of a symmetric matrix, symmetric."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)
