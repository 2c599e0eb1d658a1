"""Table of the methods: choices of `--method` and `method=`, with their inputs, outputs and features.

The tables of README and `sylpose track --help` are tested against it. It names functions without importing them, so
that `--help` is fast.
"""

from __future__ import annotations

from typing import NamedTuple


class Method(NamedTuple):
    """Method that estimates the object's motion; the tracker accepts all of them.

    Attributes:
        name: as users type it.
        inputs: the data that the motion is estimated from.
        output: the result, and when to choose the method.
        function: its implementation, `module.function` within `sylpose`.
        features: possible sources of a tracked frame's features, the best first; see `FEATURES`.
        supports_two_frames: whether `estimate_motion` accepts it as well; between two frames no landmarks are
            available.
        uses_moments: whether it is one of the paper's rotation estimators, which use the pair moments of two frames.
    """

    name: str
    inputs: str
    output: str
    function: str
    features: tuple[str, ...]
    supports_two_frames: bool = False
    uses_moments: bool = False


def _paper_method(name: str, inputs: str, output: str, function: str) -> Method:
    """Return the entry of one of the paper's estimators.

    These use only the matches with the previous frame. KLT features have matches with their template frame, which is
    the previous frame for one frame only, so they are not supported.
    """
    return Method(name, inputs, output, function, ("sift",), True, True)


# The first of each is the default.
FEATURES = ("auto", "sift", "klt")
# How distributed camera nodes compute a frame's pose (`landmarks.distributed_alignment`).
MODES = ("exact", "compact")
TABLE = (
    Method(
        "landmarks",
        "landmarks on the object, mapped while it rotates",
        "least drift; recommended",
        "landmarks.alignment.align",
        ("klt", "sift"),
    ),
    Method(
        "epipolar",
        "matches with keyframes, perspective, weak depth prior",
        "two frames; a check without a landmark map",
        "relative_pose.solver.fit_terms",
        ("sift", "klt"),
        supports_two_frames=True,
    ),
    _paper_method(
        "sylvester",
        "second moments of the matches, orthographic",
        "the paper's centralized rotation; small rotations",
        "sylvester.centralized.solve_centralized",
    ),
    _paper_method(
        "depth-plane",
        "the same, with a depth plane per camera",
        "low bandwidth; flat and faceted objects",
        "sylvester.depth_plane.solve_depth_plane",
    ),
    Method(
        "known-depth",
        "the landmarks' positions, Sylvester's equation",
        "2D-3D as in the paper, for comparison",
        "sylvester.known_depth.solve_2d3d",
        ("sift", "klt"),
    ),
)

METHODS = tuple(method.name for method in TABLE)
MOTION_METHODS = tuple(method.name for method in TABLE if method.supports_two_frames)
PAPER_METHODS = tuple(method.name for method in TABLE if method.uses_moments)


def resolve_features(method: str, features: str) -> str:
    """Return the source of a tracked frame's features: "sift", or "klt" (tracked from SIFT keyframes).

    Args:
        method: one of `METHODS`.
        features: one of `FEATURES`; "auto" selects the best for the method.

    Raises:
        ValueError: an unknown method, unknown features, or features that the method does not support.
    """
    for name, choice, choices in (("method", method, METHODS), ("features", features, FEATURES)):
        if not isinstance(choice, str) or choice not in choices:
            text = ascii(choice)[:60] if isinstance(choice, str) else f"an object of type {type(choice).__name__}"
            raise ValueError(f"{name}: {text} is not one of {', '.join(choices)}")
    usable = TABLE[METHODS.index(method)].features
    if features == FEATURES[0]:
        return usable[0]
    if features not in usable:
        alternatives = ", ".join(other.name for other in TABLE if features in other.features)
        raise ValueError(
            f"features: {features!r} does not suit the method {method!r}, which needs matches of each frame with the "
            f"previous one; use {' or '.join(map(repr, usable))}, or one of the methods {alternatives}"
        )
    return features


def format_methods_table() -> str:
    """Format the table for `sylpose track --help`, one line per method, within 80 columns."""
    lines = (f"  {m.name + ' *' * ('klt' in m.features):15} {m.inputs}" for m in TABLE)
    return "\n".join(["Methods and the data they use (*: also with --features klt):", *lines])
