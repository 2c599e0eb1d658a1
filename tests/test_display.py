"""Text representations of results and cameras: short, correct, and safe to display."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

import sylpose
from sylpose import simulate
from sylpose.display import (
    Printable,
    format_length,
    format_lengths,
    format_position,
    format_rotation,
    format_vector,
    format_with_sd,
)
from sylpose.matches import Matches
from sylpose.moments import PairMoments
from sylpose.report.plots import NotebookFigure
from sylpose.results import FramePose, Motion, Trajectory
from sylpose.rig import Rig
from sylpose.status import FrameStatus, Observability

RIG = Rig(simulate.dome(4).cameras, "m")
RNG = np.random.default_rng(1)
BODY, TURN = simulate.ellipsoid((0.15, 0.12, 0.1)), simulate.random_motion(8.0, 0.02, RNG)
PAIR = simulate.simulate_matches(RIG, BODY, TURN, rng=RNG)
Q, M = [c.rotation for c in RIG], [PairMoments.from_matches(m.x, m.y) for m in PAIR.matches]
MOTION = sylpose.estimate_motion(RIG, PAIR.matches)
POINTS = np.random.default_rng(0).normal(size=(8, 3))


def frame(index: int, status: FrameStatus = FrameStatus.TRACKED, **more: Any) -> FramePose:
    pose = RigidTransform.from_components([0.01 * index, 0, 1], Rotation.from_rotvec([0, np.radians(index), 0]))
    return FramePose(
        index, 0.1 * index, status, pose, 1e-6 * np.eye(6), np.array([40, 0]), np.array([0.31, np.nan]), **more
    )


def trajectory() -> Trajectory:
    frames = [frame(0, FrameStatus.FIRST), *(frame(k) for k in range(1, 10))]
    lost = replace(frame(10, FrameStatus.LOST, reason="no images"), world_from_object=None)
    return Trajectory([*frames, lost], ["left", "right"], "m")


ALL: dict[str, Callable[[], Any]] = {
    "Rig": lambda: RIG,
    "Camera": lambda: RIG.cameras[0],
    "Matches": lambda: PAIR.matches[0],
    "Motion": lambda: MOTION,
    "MotionView": lambda: sylpose.view_of_motion(MOTION, "cam_1", rig=RIG),
    "RotationView": lambda: sylpose.view_of_rotation(sylpose.solve_centralized(Q, M), "cam_1", rig=RIG),
    "CentralizedSolution": lambda: sylpose.solve_centralized(Q, M),
    "CentralizedBatch": lambda: sylpose.solve_centralized_batch(Q, np.array([[m.matrix for m in M]])),
    "RobustSolution": lambda: sylpose.solve_robust(Q, M),
    "Diagnosis": lambda: sylpose.solve_robust(Q, M).diagnosis,
    "DepthPlaneSolution": lambda: sylpose.solve_depth_plane(Q, M),
    "DistributedSolution": lambda: sylpose.solve_exchange(Q, M),
    "OneCameraSolution": lambda: sylpose.solve_one_camera(Q[0], M[0]),
    "RotationEstimate": lambda: sylpose.solve_one_camera(Q[0], M[0]).select_nearest(np.eye(3)),
    "KnownDepthSolution": lambda: sylpose.solve_3d3d(POINTS, POINTS @ Rotation.from_rotvec([0, 0, 0.3]).as_matrix().T),
    "FramePose": lambda: frame(3),
    "Trajectory": trajectory,
}


class Texts(HTMLParser):
    """The texts and the tags of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.tags: list[str] = []
        self.feed(page)

    def handle_data(self, data: str) -> None:
        self.texts.append(data)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        assert not attrs or attrs == [("style", "text-align: left")]


@pytest.mark.parametrize("name", ALL)
def test_representations_are_short_and_equal(name: str) -> None:
    thing = ALL[name]()
    assert type(thing).__name__ == name
    lines = str(thing).splitlines()
    assert 1 <= len(lines) <= 10
    assert max(map(len, lines)) < 170
    assert lines[0].startswith(f"{name}: ")
    assert repr(thing).startswith(f"<{name}: ")
    assert repr(thing).count("\n") == 0
    assert len(repr(thing)) < 160
    shown = Texts(thing._repr_html_()).texts
    # Each label and each text of the lines is in the table, and nothing else.
    assert "".join("".join(lines).split()).replace(f"{name}:", name, 1) == "".join("".join(shown).split()).replace(
        f"{name}:", name, 1
    )


def test_all_public_printables_are_tested() -> None:
    public = {
        name for name in sylpose.__all__ if isinstance(t := getattr(sylpose, name), type) and issubclass(t, Printable)
    }
    assert public - {"KnownObject"} <= set(ALL)  # a known object: tests/io/test_object_files.py


def test_motion_prints_values_and_uncertainty() -> None:
    text = str(MOTION)
    assert MOTION.motion is not None
    assert text.startswith(f"Motion: ok. {MOTION.status.text}\n")
    w = np.degrees(MOTION.motion.rotation.as_rotvec())
    assert f"{np.linalg.norm(w):.3f}° about {format_vector(w / np.linalg.norm(w))}" in text
    moved = 1000 * (MOTION.motion.apply(MOTION.center) - MOTION.center)
    sigma = np.sqrt(np.diag(MOTION.covariance))
    assert f"{format_vector(moved, 2)} ± {format_vector(1000 * sigma[3:], 2)} mm" in text
    assert format_vector(np.degrees(sigma[:3]), 3) in text
    for name, mask, residual in zip(RIG.names, MOTION.inliers, MOTION.residuals, strict=True):
        assert f"{name} " in text
        assert f"{mask.sum()} of {len(mask)} matches, residual {residual:.2f} px" in text
    assert "at fault" not in text
    assert "at fault     cam_2 was moved." in str(replace(MOTION, faults=("cam_2 was moved.",)))


def test_unknown_values_are_not_printed() -> None:
    alone = sylpose.estimate_motion(RIG.subset(["cam_0"]), PAIR.matches[:1])
    assert "translation not observable" in repr(alone)
    assert " mm" not in str(alone)  # nor in meters: at distance 1
    assert "unobservable" in str(alone)
    given = sylpose.estimate_motion(RIG.subset(["cam_0"]), PAIR.matches[:1], center=PAIR.center)
    assert given.unit == "m"
    nothing = sylpose.estimate_motion(RIG, [Matches.empty()] * 4)
    assert str(nothing).splitlines()[0] == f"Motion: too few matches. {nothing.status.text}"
    assert "rotat" not in str(nothing) + repr(nothing)
    assert "residual" not in str(nothing)
    unknown = replace(MOTION, covariance=np.diag([np.inf] * 6))
    assert "± (unknown, unknown, unknown)° about x, y, z" in str(unknown)
    lost = trajectory()[10]
    assert "no images" in str(lost)
    assert "position" not in str(lost)
    straight = replace(frame(3), observability=Observability.NO_TRANSLATION_SCALE)
    assert Observability.NO_TRANSLATION_SCALE.text in str(straight)


def test_trajectory_summary() -> None:
    text = str(trajectory())
    assert text.splitlines()[0] == "Trajectory: 10 of 11 frames with a pose, rotated 9.0°, moved 90.0 mm"
    assert "tracked 9, first frame 1, lost 1" in text
    assert "used in 10 frames, median 40 inliers, residual 0.31 px" in text
    assert "used in 0 frames" in text
    assert str(Trajectory([], ["left"])).startswith("Trajectory: 0 of 0 frames with a pose")


def test_names_from_files_are_escaped() -> None:
    bad = "<script>alert('1')</script>\x1b[31m"
    for thing in (
        Trajectory([frame(0), frame(1)], [bad, "right"], bad),
        replace(MOTION, faults=(bad,), camera_names=(bad,) * 4, unit=bad),
        replace(frame(2), reason=bad, faults=(bad,)),
    ):
        page = Texts(thing._repr_html_())
        assert "script" not in page.tags
        assert "script" in "".join(page.texts)
        for text in (str(thing), repr(thing), thing._repr_html_()):
            assert "\x1b" not in text


def test_long_camera_lists_are_truncated() -> None:
    rig = simulate.ring(30)
    assert len(str(rig).splitlines()) == 14
    assert "and 18 cameras more" in str(rig)


def test_digits_follow_the_uncertainty() -> None:
    assert format_with_sd(np.array([1.23456, -0.0004, 7.0]), np.array([0.012, 0.034, 0.2])) == (
        "(1.235, 0.000, 7.000) ± (0.012, 0.034, 0.200)"
    )
    assert (
        format_with_sd(np.array([123.456, 0, 0]), np.array([np.inf, np.inf, 0]))
        == "(123, 0, 0) ± (unknown, unknown, 0)"
    )
    assert format_lengths(np.array([0.0123, 0, 0]), np.array([1e-4, 1e-4, 1e-4]), "m") == (
        "(12.30, 0.00, 0.00) ± (0.10, 0.10, 0.10) mm"
    )
    assert (
        format_lengths(np.array([2.0, 0, 0]), np.array([0.1, 0.1, 0.1]), "")
        == "(2.00, 0.00, 0.00) ± (0.10, 0.10, 0.10) units"
    )
    assert [format_length(v, "m") for v in (0.0, 0.01234, 2.5)] == ["0 mm", "12.3 mm", "2.50 m"]
    assert format_position(np.array([123.4567, 0.0, -1.0])) == "(123.5, 0.0, -1.0)"
    assert format_rotation(Rotation.identity()) == "0°"
    assert format_rotation(Rotation.from_rotvec([0, 0, -np.pi / 2])) == "90.0° about (0.00, 0.00, -1.00)"


def test_trajectory_plot() -> None:
    figure = sylpose.plot_trajectory(trajectory(), note="by hand")
    assert len(figure.axes) == 4
    assert isinstance(figure, NotebookFigure)
    assert figure._repr_png_().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match="no frames"):
        sylpose.plot_trajectory(Trajectory([], []))


def test_pose_estimate_prints_position() -> None:
    points = np.random.default_rng(2).uniform(-0.1, 0.1, (12, 3))
    found: Motion = sylpose.estimate_pose(RIG, [points] * 4, [camera.project(points) for camera in RIG])
    assert "center at" in str(found)
    assert f"at {format_position(points.mean(axis=0))}" in repr(found)
