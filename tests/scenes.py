"""Scenes that the tests of the two-frame core share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sylpose.epipolar import TermData, Terms
from sylpose.features import Matches
from sylpose.moments import PairMoments
from sylpose.results import Motion
from sylpose.rig import Rig
from sylpose.simulate import SimulatedPair, ellipsoid, ring

FloatArray = NDArray[np.float64]

BODY = ellipsoid((0.15, 0.12, 0.1))


def around(n: int) -> Rig:
    """`n` cameras around the object, alternately above and below it."""
    return ring(n, height=[0.4 * (-1) ** k for k in range(n)])


def homogeneous(points: FloatArray) -> FloatArray:
    return np.column_stack([points, np.ones(len(points))])


def data_of(rig: Rig, matches: Sequence[Matches]) -> list[TermData]:
    """One term per camera, as `estimate_motion` makes them."""
    return [
        TermData(c, homogeneous(m.x), homogeneous(m.y), camera.rotation, camera.center, camera.focal)
        for c, (camera, m) in enumerate(zip(rig, matches, strict=True))
    ]


def terms_of(data: Sequence[TermData], center: FloatArray, radius: float = 0.15, sigma: float = 0.5) -> Terms:
    """The cost of all matches, each with weight 1."""
    moments = [PairMoments.from_matches(term.x, term.y) for term in data]
    return Terms.build(data, moments, np.full(len(data), sigma), center, radius)


def truth(pair: SimulatedPair, center: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The true (R, d) about a centre."""
    return pair.motion.rotation.as_matrix(), np.asarray(pair.motion.apply(center) - center)


def error(pair: SimulatedPair, found: Motion) -> FloatArray:
    """(6,) the error (w, d) of a motion: radians, and the displacement of its centre."""
    assert found.motion is not None, found.status
    turn = (pair.motion.rotation * found.motion.rotation.inv()).as_rotvec()
    return np.concatenate([turn, pair.motion.apply(found.center) - found.motion.apply(found.center)])


def degrees(error: FloatArray) -> float:
    """The angle of an error (6,)."""
    return float(np.rad2deg(np.linalg.norm(error[:3])))


def shift(error: FloatArray) -> float:
    """The length of an error's (6,) displacement."""
    return float(np.linalg.norm(error[3:]))
