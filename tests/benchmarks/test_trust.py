"""Trust benchmark: its kinds, the scores of known poses, and the image faults."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks import trust_takes
from benchmarks.trust import Run, Score, draw, format_row, format_worst, score_poses
from benchmarks.trust_camera_faults import reflect
from benchmarks.trust_effects import exchange, flip, freeze
from benchmarks.trust_kinds import GROUPS, KINDS
from benchmarks.trust_takes import PHOTOGRAPHS, Film, Take, draw_photo, warn_without_photographs
from sylpose import FramePose, FrameStatus
from sylpose.geometry.arrays import FloatArray

SD = 0.01


@pytest.fixture(scope="module")
def take() -> Take:
    return draw("slow-turn", 0)


def make_poses(poses: RigidTransform, sd: float = SD) -> list[FramePose]:
    """Return tracked poses with that standard deviation, radians and radii alike."""
    return [make_pose(k, pose, sd) for k, pose in enumerate(poses)]


def make_pose(k: int, pose: RigidTransform | None, sd: float) -> FramePose:
    status = FrameStatus.LOST if pose is None else FrameStatus.TRACKED if k else FrameStatus.FIRST
    return FramePose(k, float(k), status, pose, sd**2 * np.eye(6), np.full(2, 50), np.full(2, 0.3))


def mark(poses: list[FramePose], status: FrameStatus, numbers: range) -> list[FramePose]:
    """Change the status of some frames."""
    return [replace(pose, status=status) if pose.index in numbers else pose for pose in poses]


def rotate(poses: RigidTransform, degrees: FloatArray) -> RigidTransform:
    """Add a rotation about each pose's own center."""
    turns = RigidTransform.from_rotation(Rotation.from_rotvec(np.radians(degrees)[:, None] * [1.0, 0.0, 0.0]))
    return poses * turns


def test_there_are_enough_kinds() -> None:
    names = set(KINDS)
    assert len(names) == sum(map(len, GROUPS.values())) >= 60
    assert len(set(GROUPS["people"]) | set(GROUPS["persons"])) >= len(names) / 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["junk-video", "interlaced"])
def test_takes_render_and_repeat(name: str) -> None:
    first, second = ([frame.images[0] for frame in shorten(draw(name, 3)).frames()] for _ in range(2))
    assert len(first) == 3
    for a, b in zip(first, second, strict=True):
        assert a is not None
        assert b is not None
        assert np.array_equal(a, b)


def shorten(take: Take) -> Take:
    return replace(take, scene=replace(take.scene, frames=3))


def test_true_poses_have_no_errors_in_any_world(take: Take) -> None:
    moved = RigidTransform.from_components([1.0, 2.0, 3.0], Rotation.from_rotvec([0.1, 0.2, 0.3]))
    (truth,) = take.true_poses()
    score = score_poses(take, make_poses(truth * moved))
    assert (score.sure, score.wrong, score.localized) == (0, 0, take.scene.frames - 1)
    assert score.degrees[1] < 1e-4
    assert score.in_bounds == (score.n_bounded, score.n_bounded) == (take.scene.frames - 1,) * 2


def test_wrong_frames_are_sure_if_their_covariance_is_small(take: Take) -> None:
    (truth,) = take.true_poses()
    degrees = np.where(np.arange(take.scene.frames) >= 30, 6.0, 0.0)
    sure, unsure = (score_poses(take, make_poses(rotate(truth, degrees), sd)) for sd in (SD, 0.1))
    assert sure.sure_frames == tuple(range(30, take.scene.frames))
    assert sure.sure == sure.wrong == unsure.wrong == take.scene.frames - 30
    assert unsure.sure == 0
    assert sure.in_bounds == (29, sure.n_bounded)


def test_runs_are_scored_against_the_truth_they_agree_with(take: Take) -> None:
    (truth,) = take.true_poses()
    path = take.scene.actors[0].path
    other = replace(take, truths=(lambda frame: path(-3.0 * frame), path))
    score = score_poses(other, make_poses(truth))
    assert (score.truth, score.wrong) == (1, 0)


def test_frames_before_the_object_is_seen_are_wrong(take: Take) -> None:
    (truth,) = take.true_poses()
    away = RigidTransform.concatenate(
        [RigidTransform.from_translation([9.0 * (k < 10), 0.0, 0.0]) * truth[k] for k in range(take.scene.frames)]
    )
    score = score_poses(replace(take, first=10), make_poses(away))
    assert score.sure_frames == tuple(range(1, 10))


def test_frames_without_poses_are_no_errors(take: Take) -> None:
    (truth,) = take.true_poses()
    poses = [make_pose(k, None if 5 <= k < 9 else pose, SD) for k, pose in enumerate(truth)]
    score = score_poses(take, poses)
    assert (score.localized, score.wrong) == (take.scene.frames - 5, 0)
    assert score_poses(take, []).localized == 0


def test_filled_in_frames_have_bounds_of_their_own(take: Take) -> None:
    (truth,) = take.true_poses()
    degrees = np.where(np.arange(take.scene.frames) >= 30, 6.0, 0.0)
    tracked = mark(make_poses(rotate(truth, degrees)), FrameStatus.COASTING, range(28, 33))
    score = score_poses(take, mark(tracked, FrameStatus.INTERPOLATED, range(4, 9)))
    assert (score.n_filled, score.filled_in_bounds) == (10, (7, 10))
    assert score.filled_sds[0] == pytest.approx(np.radians(6.0) / SD, rel=1e-3)
    # They are not localized, so neither bounded nor wrong and sure as such.
    assert score.localized == score.n_bounded == take.scene.frames - 11
    assert (score.sure, score.in_bounds) == (take.scene.frames - 33, (22, score.n_bounded))
    assert score_poses(take, make_poses(truth)).n_filled == 0


def test_filled_in_frames_without_reference_or_pose_are_not_counted(take: Take) -> None:
    (truth,) = take.true_poses()
    poses = [make_pose(k, None if k < 3 else pose, SD) for k, pose in enumerate(truth)]
    score = score_poses(take, mark(poses, FrameStatus.COASTING, range(5)))
    assert (score.n_filled, score.filled_in_bounds) == (1, (1, 1))
    assert score_poses(take, []).n_filled == 0


def test_missing_photographs_are_reported(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(trust_takes, "PHOTOGRAPHS", {"matplotlib": PHOTOGRAPHS["matplotlib"]})
    warn_without_photographs()
    assert not capsys.readouterr().err
    kept = np.random.default_rng(0)
    photo = draw_photo(kept, (64, 48))
    monkeypatch.setattr(
        trust_takes, "PHOTOGRAPHS", {"no_such_package": ("photographs", 10), "sylpose": ("photographs", 2)}
    )
    warn_without_photographs()
    output = capsys.readouterr()
    assert not output.out
    assert output.err.startswith(
        "warning: no_such_package has 0 instead of 10, sylpose has 0 instead of 2 photographs here"
    )
    assert output.err.count("\n") == 1
    # A drawn room replaces the photograph, and the rest of the take is the same.
    rng = np.random.default_rng(0)
    room = draw_photo(rng, (64, 48))
    assert room.shape == photo.shape == (48, 64, 3)
    assert not np.array_equal(room, photo)
    assert rng.integers(1 << 30) == kept.integers(1 << 30)


def test_image_faults(take: Take) -> None:
    rng = np.random.default_rng(0)
    film: Film = [[rng.integers(0, 255, (4, 6, 3)).astype(np.uint8) for _ in range(3)] for _ in range(2)]
    mirrored = flip(True, False, [1])(take, film)
    assert np.array_equal(mirrored[1][0][:, ::-1], film[1][0])
    assert mirrored[0] is film[0]
    assert np.array_equal(flip(True, True)(take, film)[0][2][::-1, ::-1], film[0][2])
    assert exchange([1, 0])(take, film) == [film[1], film[0]]
    assert freeze(0, 1)(take, film)[0][2] is film[0][1]


def test_reflected_motion_is_that_of_the_reflected_world(take: Take) -> None:
    (truth,) = take.true_poses()
    motion, point = truth[7] * truth[2].inv(), np.array([0.3, 0.2, -0.1])
    mirror = np.array([1.0, -1.0, 1.0])
    assert np.allclose(reflect(motion).apply(mirror * point), mirror * motion.apply(point))


def test_table_counts_frames_and_runs(take: Take) -> None:
    (truth,) = take.true_poses()
    good = score_poses(take, make_poses(truth))
    bad = score_poses(take, make_poses(rotate(truth, np.where(np.arange(take.scene.frames) >= 30, 6.0, 0.0))))
    none = score_poses(take, [])
    runs = [make_run(0, good, bad), make_run(1, none, none)]
    cells = [cell.strip() for cell in format_row("slow-turn", runs).strip("|").split("|")]
    assert cells[:6] == ["slow-turn", "2", "80", "49 / 49", "0", f"{take.scene.frames - 30} in 1"]
    assert cells[10:] == ["100, 100", "74, 100", "-", "-"]
    assert cells[6] == "0.00, 0.00"
    assert format_row("none", runs[1:]).count("| - ") == 8
    assert [line.partition(":")[0] for line in format_worst(runs)] == ["slow-turn 0"]
    filled = score_poses(take, mark(make_poses(truth), FrameStatus.INTERPOLATED, range(9, 12)))
    assert format_row("slow-turn", [make_run(0, good, filled)]).endswith(" | - | 3: 100, 100 |")


def make_run(seed: int, tracked: Score, refined: Score) -> Run:
    return Run("slow-turn", "regular", seed, 3, 40, 0, False, tracked, refined, "ok", "", 1.0)
