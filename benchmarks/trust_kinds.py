"""The kinds of `benchmarks/trust.py` by group.

A kind is a function that draws a take from a random generator; its name is part of the seed. Kinds named "NAME-person" are
the kind NAME with a person behind or beside the object. The truth is the object's motion, also without boxes: a person
that is followed instead is wrong.
"""

from __future__ import annotations

import numpy as np

from benchmarks.trust_bodies import NOT_RIGID, PEOPLE, SEVERAL, SURFACES
from benchmarks.trust_camera_faults import ONE_CAMERA, REGULAR, WHOLE_RIG, TakeKind
from benchmarks.trust_light import LATE, LIGHT, MOVING_BACKGROUND
from benchmarks.trust_people import add_person
from benchmarks.trust_takes import Take

__all__ = ["GROUPS", "KINDS"]

WITH_PERSON = (
    "hand-board",
    "free-motion",
    "slow-turn",
    "long-lens",
    "six-per-second",
    "all-mirrored",
    "all-upside-down",
    "frozen-later",
    "late-2",
    "bumped",
    "zoomed-5",
    "rotated-3",
    "net",
    "late-half",
    "rests-long",
    "put-down",
    "creeping",
    "exposure-steps",
    "light-dims",
    "low-jpeg",
    "low-h264",
    "rolling-shutter",
    "motion-blur",
    "trembling",
    "shadows",
    "screen-video",
    "mirror",
    "equal-pair",
    "checkered",
    "faint",
    "glossy",
    "hinged",
)


def accompany(kind: TakeKind) -> TakeKind:
    """Add a person to a kind."""

    def draw(rng: np.random.Generator) -> Take:
        return add_person(kind(rng), rng)

    return draw


GROUPS: dict[str, dict[str, TakeKind]] = {
    "regular": REGULAR,
    "whole-rig": WHOLE_RIG,
    "one-camera": ONE_CAMERA,
    "late": LATE,
    "light": LIGHT,
    "background": MOVING_BACKGROUND,
    "people": PEOPLE,
    "several": SEVERAL,
    "surfaces": SURFACES,
    "not-rigid": NOT_RIGID,
}
GROUPS["persons"] = {
    f"{name}-person": accompany(kind)
    for group in list(GROUPS.values())
    for name, kind in group.items()
    if name in WITH_PERSON
}
KINDS: dict[str, TakeKind] = {name: kind for group in GROUPS.values() for name, kind in group.items()}
