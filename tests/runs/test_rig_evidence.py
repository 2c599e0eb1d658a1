"""What the first frames show of a rig: frozen, motionless, late and exchanged cameras, and a sentence for each mistake."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import Image
from sylpose.io.capture import open_session
from sylpose.relative_pose.rig_hypotheses import Hypothesis, HypothesisFit, Mistake
from sylpose.runs.rig_evidence import MIN_FROZEN_FRAMES, RigFindings, describe_findings, examine_rig, find_frozen
from tests.clips import Clip, frame_sets, make_rotated_pose, moving_scene

FRAMES = 20


@cache
def swinging_clip() -> Clip:
    """Render three cameras and an object that swings: its speed changes, so a late camera disagrees."""

    def swing(frame: float) -> RigidTransform:
        return make_rotated_pose(25 * np.sin(frame / 3), np.array([0.03, -0.02, 0.02]) * np.sin(frame / 4))

    return Clip.render(moving_scene(swing, FRAMES, n_cameras=3))


def examine(images: Sequence[Sequence[Image]]) -> RigFindings:
    return examine_rig(swinging_clip().rig, lambda: frame_sets(images))


def test_a_good_recording_shows_nothing() -> None:
    found = examine(swinging_clip().images)
    assert found.frames is not None
    assert (found.is_contradicted, found.explanations, found.frozen, found.still) == (False, (), {}, ())


def test_mirrored_images_are_named() -> None:
    found = examine([[np.ascontiguousarray(image[:, ::-1]) for image in frame] for frame in swinging_clip().images])
    # The demo's rig is symmetric: with its outer cameras exchanged, it is nearly its own mirror image.
    named = {fit.hypothesis for fit in found.explanations}
    assert Hypothesis(Mistake.MIRRORED) in named
    assert named <= {Hypothesis(Mistake.MIRRORED), Hypothesis(Mistake.EXCHANGED, (2, 1, 0))}
    assert found.is_rig_wrong


def test_a_late_camera_is_named() -> None:
    images = swinging_clip().images
    late = [[frame[0], images[max(k - 2, 0)][1], frame[2]] for k, frame in enumerate(images)]
    found = examine(late)
    assert [fit.hypothesis for fit in found.explanations] == [Hypothesis(Mistake.LATE, (1,), 2)]


def test_frozen_and_motionless_cameras_are_named() -> None:
    images, rng = swinging_clip().images, np.random.default_rng(0)
    frozen = examine([[frame[0], frame[1], images[min(k, 8)][2]] for k, frame in enumerate(images)])
    assert frozen.frozen == {2: (8, FRAMES - 1)}
    picture = images[0][2]
    noisy = [np.clip(picture + rng.normal(0, 1.5, picture.shape), 0, 255).astype(np.uint8) for _ in images]
    still = examine([[frame[0], frame[1], own] for frame, own in zip(images, noisy, strict=True)])
    assert still.still == (2,)
    assert (still.frozen, still.is_contradicted) == ({}, False)


def test_equal_images_are_frozen_only_while_others_change() -> None:
    changes = np.ones((12, 3), bool)
    changes[2 : 2 + MIN_FROZEN_FRAMES - 1, 1] = False
    assert find_frozen(changes) == {1: (2, 2 + MIN_FROZEN_FRAMES - 1)}
    assert find_frozen(changes[:6]) == {}
    assert find_frozen(np.zeros((12, 3), bool)) == {}
    assert find_frozen(np.zeros((0, 3), bool)) == {}


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
        (Hypothesis(Mistake.INCONSISTENT, (2,)), "--exclude-camera cam_2"),
    ],
)
def test_each_mistake_has_a_remedy(recording: Path, hypothesis: Hypothesis, words: str) -> None:
    fit = HypothesisFit(hypothesis, 0.5, 100.0, 5)
    (text,) = describe_findings(open_session(recording), RigFindings((0, 9), True, (fit,), {}, ()))
    assert text.startswith("The cameras contradict each other in what moves from frame 0 to 9. They agree if ")
    assert words in text


def test_several_findings_are_described(recording: Path) -> None:
    session = open_session(recording)
    both = tuple(HypothesisFit(Hypothesis(m), 0.5, 100.0, 5) for m in (Mistake.MIRRORED, Mistake.TURNED))
    found = describe_findings(session, RigFindings((0, 9), True, both, {1: (3, 9)}, (2,)))
    assert [text.split(":")[0] for text in found[:2]] == ["cam_1", "cam_2"]
    assert "agree in 2 cases" in found[2]
    assert "(2) all images are turned" in found[2]
    assert describe_findings(session, RigFindings((0, 9), False, (), {}, ())) == []
    (unexplained,) = describe_findings(session, RigFindings((0, 9), True, (), {}, ()))
    assert "no usual mistake explains it" in unexplained
