"""Whether one camera stands, by its own background.

It watches corners all over its image (`features.static_background`). When nearly all of those that stood have moved
by one rotation
about the camera's centre, where the object is or may be apart, the camera was nudged. What becomes of that is decided with
the others (`nudges`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from sylpose.features.static_background import FEWEST, Backdrop, Steadied, Turn, alike, begin, turn_since
from sylpose.geometry.arrays import BoolArray, FloatArray, Image
from sylpose.rig import Camera
from sylpose.tracking.region import polygon_mask
from sylpose.tracking.reports import Stance

__all__ = ["PAUSE", "View", "Watch"]

# An image, and the object's mask (h, w) in it.
View = tuple[Image | None, BoolArray | None]

# A camera stands while so many of the corners that stood in the frame before look as they did (measured: of "background" in
# benchmarks/kinds.py, 0.8 at least where it stands, less than 0.1 where it was nudged by a degree; 0.6 where an object that
# fills half of the image starts).
STANDS = 0.4
# It was turned where so many corners and such a share of those asked agree on that, spread by such a share of its image, and
# no more than such a share stands still (choice).
LEAST, AGREE, SPREAD, STILL = 12, 0.6, 0.1, 0.1
# A nudge is a displacement by so many pixels in the middle, and by so many standard deviations (choice).
NUDGE_PX, SURE = 2.0, 10.0
# Two rotations are one within so many pixels in the middle of the image, or so many standard deviations (choice).
SAME_PX, SAME_SDS = 0.5, 4.0
# After so many frames in a row in which a camera does not stand, and it is not certain by what it was turned, it is watched
# anew, so many frames later; where there is too little to watch it by, that is looked for again after as many (choice).
PATIENCE, PAUSE = 10, 30


class Watch:
    """What one camera remembers of how it stands.

    Attributes:
        camera: its calibration.
        backdrop: the corners, as an image had them in which the camera stood; None while it is not watched.
        stood: (n,) which of them looked alike when the camera last stood; without those on the object once it does not.
        steady: how its images are turned back, once it was nudged.
        turned: the rotation since the backdrop that the last frame showed, if any; since: the recording's number of the
            first such frame.
        odd: frames in a row in which the camera does not stand.
        pause: frames until it is watched anew.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.backdrop: Backdrop | None = None
        self.stood: BoolArray = np.zeros(0, bool)
        self.steady: Steadied | None = None
        self.turned: Turn | None = None
        self.since = self.odd = self.pause = 0

    def seen(self, image: Image | None, mask: BoolArray | None) -> View:
        """An image and the object's mask in it, turned back as far as the camera is known to be turned."""
        if image is None or self.steady is None:
            return image, mask
        return self.steady.image(image), self.steady.mask(mask)

    def look(self, image: Image | None, region: Callable[[], FloatArray | None], index: int) -> Stance:
        """How the camera stands.

        Args:
            image: turned back; None without one.
            region: tells the object's outline in it, (k, 2); None where that is not known.
            index: the recording's number of the frame.
        """
        if image is None:
            return Stance(odd=self.odd > 0)
        if self.backdrop is None:
            self.pause -= 1
            if self.pause < 0:
                self._begin(image)
            return Stance()
        like = alike(self.backdrop, image)
        if (like & self.stood).sum() >= STANDS * self.stood.sum():
            self.stood, self.turned, self.odd = like, None, 0
            if like.sum() < FEWEST:
                self.forget(PATIENCE)
            return Stance()
        if not self.odd:
            # Where the object is may be less certain in the frames to come: without this camera.
            self.stood = self.stood & ~self._on(region())
        enough = self.stood.sum() >= LEAST
        turn = turn_since(self.backdrop, image, self.camera, self.stood) if enough else None
        self.odd += 1
        if turn is None or not _is_nudge(turn):
            self.turned = None
            if self.odd > PATIENCE:
                self.forget(PAUSE)
            return Stance(odd=True)
        certain = self.turned is not None and _is_same(turn, self.turned, self.camera)
        self.since = self.since if self.turned is not None else index
        self.turned = turn
        if self.odd > PATIENCE and not certain:
            self.forget(PAUSE)
        return Stance(True, Rotation.from_matrix(turn.rotation).as_rotvec(), turn.sd, self.since, certain)

    def turn_back(self) -> None:
        """What the last frame showed is a nudge."""
        assert self.backdrop is not None
        assert self.turned is not None
        before = np.eye(3) if self.steady is None else self.steady.rotation
        self.steady = Steadied(self.camera, before @ self.turned.rotation)
        columns, rows = self.backdrop.pixels.astype(np.int64).T
        self.stood = self.stood & self.steady.seen[rows, columns]
        self.turned, self.odd = None, 0

    def forget(self, pause: int) -> None:
        """The camera is watched anew after so many frames."""
        self.backdrop, self.turned, self.odd, self.pause = None, None, 0, pause

    def _begin(self, image: Image) -> None:
        self.backdrop = begin(image, None if self.steady is None else self.steady.seen)
        self.stood = np.ones(len(self.backdrop), bool)
        if len(self.backdrop) < FEWEST:
            self.forget(PAUSE)

    def _on(self, region: FloatArray | None) -> BoolArray:
        """(n,) which of the corners are where the object is."""
        assert self.backdrop is not None
        columns, rows = self.backdrop.pixels.astype(np.int64).T
        return np.asarray(polygon_mask(region, self.camera.size)[rows, columns])


def _is_nudge(turn: Turn) -> bool:
    """Whether a turn is that of the whole camera, and seen beyond doubt."""
    most = turn.agree >= LEAST and turn.agree >= AGREE * turn.asked and turn.still <= STILL * turn.asked
    sure = _angle(turn.rotation) > SURE * turn.sd
    return bool(most and turn.spread >= SPREAD and turn.shift_px > NUDGE_PX and sure)


def _is_same(one: Turn, other: Turn, camera: Camera) -> bool:
    """Whether two turns are one: the camera stands again."""
    apart = _angle(one.rotation @ other.rotation.T)
    return bool(apart < max(SAME_PX / camera.focal, SAME_SDS * np.hypot(one.sd, other.sd)))


def _angle(rotation: FloatArray) -> float:
    return float(Rotation.from_matrix(rotation).magnitude())
