"""The one table of methods: what `--method` and `method=` choose between, what each needs, gives and can use.

README's and `sylpose track --help`'s tables are tested against it. It names functions and does not load them, so that
`--help` takes no time.
"""

from __future__ import annotations

from typing import NamedTuple

__all__ = [
    "FEATURES",
    "METHODS",
    "MODES",
    "MOTION_METHODS",
    "PAPER_METHODS",
    "TABLE",
    "Method",
    "features_of",
    "summary",
]


class Method(NamedTuple):
    """A way to find the object's motion. The tracker takes all of them.

    Attributes:
        name: as users say it.
        needs: what the motion is found from.
        gives: what comes out and when it is the method to take.
        features: where a tracked frame's features may come from, the best first; see `FEATURES`.
        two_frames: whether `estimate_motion` takes it too: between two frames nothing is known of the landmarks yet.
        moments: whether it is one of the paper's estimators of a rotation, from the pair moments of two frames.
        function: that does it, `module.function` within `sylpose`.
    """

    name: str
    needs: str
    gives: str
    features: tuple[str, ...]
    two_frames: bool
    moments: bool
    function: str


def _paper(name: str, needs: str, gives: str, function: str) -> Method:
    """Of the paper's estimators: each uses the matches with the frame before alone, and followed features (KLT) have
    matches with their anchor frame, which is the frame before for one frame only."""
    return Method(name, needs, gives, ("sift",), True, True, function)


# In each, the first is the default.
FEATURES = ("auto", "sift", "klt")
# How cameras that are nodes come to a frame's pose (`landmarks.distributed_alignment`).
MODES = ("exact", "compact")
TABLE = (
    Method(
        "landmarks",
        "places of features on the object, learnt as it turns",
        "least drift: take it unless there is a reason",
        ("klt", "sift"),
        False,
        False,
        "landmarks.alignment.align",
    ),
    Method(
        "epipolar",
        "matches with keyframes, perspective, depths half known",
        "two frames; a check that learns no depths",
        ("sift", "klt"),
        True,
        False,
        "relative_pose.solver.fit_terms",
    ),
    _paper(
        "sylvester",
        "second moments of the matches, orthographic",
        "the paper's centralised rotation; small turns",
        "sylvester.centralized.solve_centralized",
    ),
    _paper(
        "depth-plane",
        "the same, and a plane for the depth each camera sees",
        "little bandwidth; flat and faceted objects",
        "sylvester.depth_plane.solve_depth_plane",
    ),
    _paper(
        "exchange",
        "as sylvester, moments sent to all cameras",
        "the answer of sylvester, in one round",
        "sylvester.distributed.simulation.solve_exchange",
    ),
    _paper(
        "refine",
        "as sylvester, rotations alone sent to all cameras",
        "the answer of sylvester: the paper's refinement",
        "sylvester.distributed.simulation.solve_refine",
    ),
    _paper(
        "gossip",
        "as sylvester, moments sent to neighbours only",
        "the answer of sylvester, without all-to-all links",
        "sylvester.distributed.simulation.solve_gossip",
    ),
    _paper(
        "one-camera",
        "second moments of one camera, with the constraint",
        "the paper's single camera, to compare",
        "sylvester.one_camera.solve_one_camera",
    ),
    _paper(
        "unconstrained",
        "second moments of one camera, adjusted afterwards",
        "what the constraint is better than, to compare",
        "sylvester.one_camera.solve_unconstrained",
    ),
    Method(
        "known-depth",
        "the landmarks' known places, Sylvester's equation",
        "2D-3D as in the paper, to compare",
        ("sift", "klt"),
        False,
        False,
        "sylvester.known_depth.solve_2d3d",
    ),
)

METHODS = tuple(method.name for method in TABLE)
MOTION_METHODS = tuple(method.name for method in TABLE if method.two_frames)
PAPER_METHODS = tuple(method.name for method in TABLE if method.moments)


def features_of(method: str, features: str) -> str:
    """Where a tracked frame's features come from: "sift", or "klt" (followed from SIFT keyframes).

    Args:
        method: of `METHODS`.
        features: of `FEATURES`; "auto" is what suits the method best.

    Raises:
        ValueError: an unknown method, unknown features, or features that the method cannot use.
    """
    for name, choice, choices in (("method", method, METHODS), ("features", features, FEATURES)):
        if not isinstance(choice, str) or choice not in choices:
            said = ascii(choice)[:60] if isinstance(choice, str) else f"an object of type {type(choice).__name__}"
            raise ValueError(f"{name}: {said} is not one of {', '.join(choices)}")
    usable = TABLE[METHODS.index(method)].features
    if features == FEATURES[0]:
        return usable[0]
    if features not in usable:
        able = ", ".join(other.name for other in TABLE if features in other.features)
        raise ValueError(
            f"features: {features!r} is of no use to the method {method!r}, which wants the matches of each frame with the "
            f"one before; take {' or '.join(map(repr, usable))}, or one of the methods {able}"
        )
    return features


def summary() -> str:
    """The table for `sylpose track --help`, a line for each method, within 80 columns."""
    lines = (f"  {m.name + ' *' * ('klt' in m.features):15} {m.needs}" for m in TABLE)
    return "\n".join(["Methods, and what they find the motion from (*: with --features klt too):", *lines])
