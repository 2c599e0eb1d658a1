"""What a recording shows of a rig: frozen, motionless, late and exchanged cameras, and a sentence for each mistake."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from benchmarks.kinds_scenes import rotate_view
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import BoolArray, Image
from sylpose.io.capture import open_session
from sylpose.io.capture.repetitions import RepetitionFilter
from sylpose.relative_pose.camera_evidence import MAX_POOLED_F_RATIO
from sylpose.relative_pose.rig_hypotheses import Hypothesis, HypothesisFit, Mistake, compute_f_ratios
from sylpose.rig import Rig
from sylpose.runs.rig_evidence import (
    MIN_FROZEN_FRAMES,
    MotionEvidence,
    RigFindings,
    collect_motion,
    describe_findings,
    examine_rig,
    find_frozen,
    find_suspect,
)
from sylpose.tracking.joint_side.joint_state import Nudge
from tests.clips import Clip, frame_sets, make_rotated_pose, moving_scene

FRAMES = 32


@cache
def swinging_clip() -> Clip:
    """Render three cameras and an object that swings: its speed changes, so a late camera disagrees."""

    def swing(frame: float) -> RigidTransform:
        return make_rotated_pose(25 * np.sin(frame / 3), np.array([0.03, -0.02, 0.02]) * np.sin(frame / 4))

    return Clip.render(moving_scene(swing, FRAMES, n_cameras=3))


def examine(images: Sequence[Sequence[Image]], rig: Rig | None = None, f_ratio: float = np.nan) -> RigFindings:
    """Examine images as they are read from a recording."""

    def read(numbers: Sequence[int]) -> Generator[FrameSet, None, None]:
        sets, pictures = frame_sets(images), RepetitionFilter(swinging_clip().rig.names)
        for k in numbers:
            yield replace(sets[k], images=tuple(pictures.remove(k, sets[k].images)[0]))

    return examine_rig(rig or swinging_clip().rig, range(len(images)), read, f_ratio)


def mirror(images: Sequence[Sequence[Image]]) -> list[list[Image]]:
    return [[np.ascontiguousarray(image[:, ::-1]) for image in frame] for frame in images]


def test_a_good_recording_shows_nothing() -> None:
    found = examine(swinging_clip().images)
    assert found.frames is not None
    assert (found.is_contradicted, found.explanations, found.frozen, found.still) == (False, (), {}, ())


@pytest.mark.parametrize("rest", [0, 70])
def test_mirrored_images_are_named(rest: int) -> None:
    """Whenever the object begins to move."""
    images = mirror(swinging_clip().images)
    found = examine([*[images[0]] * rest, *images])
    # The demo's rig is symmetric: with its outer cameras exchanged, it is nearly its own mirror image.
    named = {fit.hypothesis for fit in found.explanations}
    assert Hypothesis(Mistake.MIRRORED) in named
    assert named <= {Hypothesis(Mistake.MIRRORED), Hypothesis(Mistake.EXCHANGED, (2, 1, 0))}
    assert found.is_rig_wrong
    assert found.is_contradicted


def test_motion_of_the_object_decides_without_an_explanation() -> None:
    """The limit is that of the tracker; other bodies may move as well."""
    assert not examine(swinging_clip().images, f_ratio=MAX_POOLED_F_RATIO).is_contradicted
    found = examine(swinging_clip().images, f_ratio=1.01 * MAX_POOLED_F_RATIO)
    assert found.is_contradicted
    assert (found.explanations, found.suspect) == ((), None)


def test_the_suspect_reduces_the_f_ratio_most() -> None:
    def leave_out(c: int, f_ratio: float) -> HypothesisFit:
        return HypothesisFit(Hypothesis(Mistake.INCONSISTENT, (c,)), f_ratio, 9.0, 3)

    other = HypothesisFit(Hypothesis(Mistake.MIRRORED), 0.1, 9.0, 3)
    assert find_suspect([other, leave_out(0, 8.0), leave_out(1, 2.5), leave_out(2, 7.6)]) == 1
    # Any two of three cameras nearly agree: the healthy one of these two must not be named.
    assert find_suspect([other, leave_out(0, 8.0), leave_out(1, 2.5), leave_out(2, 2.9)]) is None
    assert find_suspect([leave_out(0, 0.0), leave_out(1, 0.2), leave_out(2, 0.0)]) is None
    few = [replace(fit, n_pairs=2) for fit in (leave_out(0, 8.0), leave_out(1, 0.5), leave_out(2, 7.6))]
    assert find_suspect(few) is None
    assert find_suspect([other, leave_out(0, 8.0), leave_out(1, 3.1)]) is None
    assert find_suspect([other]) is None


def test_a_late_camera_is_named() -> None:
    images = swinging_clip().images
    late = [[earlier[0], frame[1], frame[2]] for frame, earlier in zip(images[2:], images, strict=False)]
    found = examine(late)
    assert [fit.hypothesis for fit in found.explanations] == [Hypothesis(Mistake.LATE, (0,), 2)]


def test_frozen_and_motionless_cameras_are_named() -> None:
    images, rng = swinging_clip().images, np.random.default_rng(0)
    frozen = examine([[frame[0], frame[1], images[min(k, 8)][2]] for k, frame in enumerate(images)])
    assert frozen.frozen == {2: (9, FRAMES - 1)}
    # Late in a recording as well.
    late = [*[images[0]] * 70, *[[frame[0], frame[1], images[0][2]] for frame in images[1:]]]
    assert [*examine(late).frozen] == [2]
    picture = images[0][2]
    noisy = [np.clip(picture + rng.normal(0, 1.5, picture.shape), 0, 255).astype(np.uint8) for _ in images]
    still = examine([[frame[0], frame[1], own] for frame, own in zip(images, noisy, strict=True)])
    assert still.still == (2,)
    assert (still.frozen, still.is_contradicted) == ({}, False)


def test_a_camera_that_was_moved_is_named() -> None:
    """And compared by images that are rotated back: nothing is contradicted."""
    clip, degrees, moved = swinging_clip(), 2.0, 14
    turn = np.radians(degrees) * np.array([0.6, 0.8, 0.0])
    images = [
        [frame[0], rotate_view(frame[1], clip.rig.cameras[1], turn) if k >= moved else frame[1], frame[2]]
        for k, frame in enumerate(clip.images)
    ]
    found = examine(images)
    assert [(nudge.camera, nudge.frame) for nudge in found.nudges] == [(1, moved)]
    assert np.degrees(found.nudges[0].angle) == pytest.approx(degrees, abs=0.1)
    assert (found.is_contradicted, found.explanations) == (False, ())
    sets = frame_sets(images)
    windows = [sets[k : k + 9] for k in (0, 6, 12, 18)]
    evidence = collect_motion(clip.rig, windows)
    assert {nudge.frame for nudge in evidence.nudges} == {moved}
    assert max(compute_f_ratios(clip.rig, evidence.pairs, Hypothesis())) < MAX_POOLED_F_RATIO
    # The first image after the motion is not used: one does not show whether the camera stands still again.
    assert all(
        not len(pair[1][0]) for frames, pair in zip(evidence.frames, evidence.pairs, strict=True) if moved in frames
    )


def test_missing_images_are_frozen_only_while_others_have_some() -> None:
    def find(has_image: BoolArray) -> dict[int, tuple[int, int]]:
        return find_frozen(MotionEvidence((), (), (), np.zeros(3, bool), 10 * np.arange(len(has_image)), has_image))

    images = np.ones((12, 3), bool)
    images[2 : 2 + MIN_FROZEN_FRAMES, 1] = False
    assert find(images) == {1: (20, 10 * (1 + MIN_FROZEN_FRAMES))}
    assert find(images[: 1 + MIN_FROZEN_FRAMES]) == {}
    assert find(np.zeros((12, 3), bool)) == {}
    assert find(np.zeros((0, 3), bool)) == {}


@pytest.mark.parametrize(
    ("hypothesis", "words"),
    [
        (Hypothesis(Mistake.MIRRORED), "all images are mirrored: convert the videos (ffmpeg -i IN -vf hflip OUT)"),
        (Hypothesis(Mistake.TURNED, (1,)), "the images of cam_1 are turned by 180 degrees"),
        (Hypothesis(Mistake.FLIPPED), "left-handed world"),
        (Hypothesis(Mistake.CLOCKWISE, (0,)), "transpose=cclock"),
        (Hypothesis(Mistake.INVERTED), "calibration.toml contains the inverse poses"),
        (Hypothesis(Mistake.OPENGL), "OpenGL or Blender"),
        (Hypothesis(Mistake.INVERTED_OPENGL), "then invert the poses"),
        (Hypothesis(Mistake.EXCHANGED, (1, 2, 0)), "--video cam_0=cam_2.mp4 --video cam_1=cam_0.mp4"),
        (
            Hypothesis(Mistake.LATE, (1,), 2),
            "cam_1 is late by 2 frames relative to the others: --frame-offset cam_1=-2",
        ),
        (
            Hypothesis(Mistake.LATE, (1,), -1),
            "cam_1 is early by 1 frame relative to the others: --frame-offset cam_1=1",
        ),
        (Hypothesis(Mistake.UNIT, (1,), units=("cm", "m")), "multiply its translation by 0.01."),
        (Hypothesis(Mistake.INCONSISTENT, (2,)), "--exclude-camera cam_2"),
    ],
)
def test_each_mistake_has_a_remedy(recording: Path, hypothesis: Hypothesis, words: str) -> None:
    fit = HypothesisFit(hypothesis, 0.5, 100.0, 5)
    (text,) = describe_findings(open_session(recording), RigFindings((0, 9), True, (fit,)))
    assert text.startswith("The cameras contradict each other in what moves from frame 0 to 9. They agree if ")
    assert words in text


def test_several_findings_are_described(recording: Path) -> None:
    session = open_session(recording)
    both = tuple(HypothesisFit(Hypothesis(m), 0.5, 100.0, 5) for m in (Mistake.MIRRORED, Mistake.TURNED))
    found = describe_findings(session, RigFindings((0, 9), True, both, None, {1: (3, 7)}, (2,)))
    assert [text.split(":")[0] for text in found[:2]] == ["cam_1", "cam_2"]
    assert "agree in 2 cases" in found[2]
    assert "(2) all images are turned" in found[2]
    assert describe_findings(session, RigFindings((0, 9))) == []
    nudge = Nudge(0, 5, np.array([0.0, 0.0, np.radians(1.5)]), 1e-4)
    (moved,) = describe_findings(session, RigFindings((0, 9), nudges=(nudge,)))
    assert moved.startswith(
        "cam_0 seems to have been moved before frame 5: what it sees turned by 1.5 degrees as a whole."
    )
    (unexplained,) = describe_findings(session, RigFindings((0, 9), True))
    assert "no usual mistake explains it. Check that the calibration belongs to these images" in unexplained
    (suspected,) = describe_findings(session, RigFindings((0, 9), True, suspect=1))
    assert "They do so least without cam_1: calibrate it again, or exclude it (--exclude-camera cam_1)" in suspected
