"""What moves in a recording: late objects, several bodies, and which of them is tracked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import islice
from math import isqrt

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.frames import UNNUMBERED, Box, FrameSet
from sylpose.simulate import Actor, Scene, make_demo_scene, render_frames
from sylpose.simulate.render import Path
from sylpose.smoothing import Track, smooth_tracks
from sylpose.status import FrameStatus
from sylpose.tracking.bodies import (
    MAX_PIXELS,
    N_WINDOWS,
    WINDOW_FRAMES,
    compare_cameras,
    find_candidates,
    find_rigid_motion,
    open_search,
    reduce_frame_set,
    select_windows,
)
from sylpose.tracking.context import Candidate
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.tracker import Tracker, track
from tests.clips import (
    Clip,
    compute_pose_errors,
    frame_sets,
    make_drifting_pose,
    make_rotated_pose,
    make_slab,
    moving_scene,
    statuses,
)
from tests.tracking.test_box_motion import make_pair

AWAY = RigidTransform.from_translation([0, 100, 0])
N_FRAMES, ARRIVAL = 14, 7


def swing(frame: float) -> RigidTransform:
    """Return the pose of a second body, above the object."""
    return RigidTransform.from_components(
        np.array([0.05, -0.26, 0.1]) + np.array([-0.009, 0.003, 0.0]) * frame,
        Rotation.from_rotvec([0, 0, -0.04 * frame]),
    )


def make_two_bodies(frames: int) -> Scene:
    """Make a scene of the object and another body."""
    return moving_scene(make_drifting_pose, frames, [Actor(make_slab([0.26, 0.2, 0.1], 5), swing)], n_cameras=3)


@cache
def render(kind: str) -> Clip:
    """Render the object: "late", "resting" at first, or "with another" body."""
    paths = {
        "late": lambda frame: make_drifting_pose(frame) if frame >= ARRIVAL else AWAY,
        "resting": lambda frame: make_drifting_pose(max(frame - ARRIVAL, 0)),
    }
    if kind == "with another":
        return Clip.render(make_two_bodies(N_FRAMES))
    return Clip.render(moving_scene(paths[kind], N_FRAMES, n_cameras=3))


def render_successive(begin: int, end: int = 9, frames: int = 24) -> Clip:
    """Render a body that moves until a frame, and the object, which moves from another one on."""
    first = Actor(make_slab([0.26, 0.2, 0.1], 5), lambda frame: swing(min(frame, end)))
    return Clip.render(moving_scene(lambda f: make_drifting_pose(max(f - begin, 0)), frames, [first], n_cameras=3))


def windows_of(frames: list[FrameSet]) -> list[list[FrameSet]]:
    return [[frames[k] for k in window] for window in select_windows(len(frames))]


@cache
def candidates_of(kind: str) -> list[Candidate]:
    clip = render(kind)
    return find_candidates(clip.rig, windows_of(clip.frames()))


@pytest.mark.parametrize("n", [0, 1, 2, 9, 17, 18, 40, 1000, 100_000])
def test_windows_are_spread_over_the_recording(n: int) -> None:
    windows = select_windows(n)
    assert len(windows) <= max(N_WINDOWS, isqrt(n // 2))
    assert all(0 < len(window) <= WINDOW_FRAMES for window in windows)
    assert (windows[0].start, windows[-1].stop) == (0, n) if n else not windows
    starts = [window.start for window in windows]
    assert starts == sorted(set(starts))


def test_images_are_reduced_unless_masks_select_a_part() -> None:
    image, mask = np.zeros((1000, 1500, 3), np.uint8), np.zeros((1000, 1500), bool)
    frames = FrameSet.of([image, image, None], 0.0, [None, mask, None])
    reduced, kept, missing = reduce_frame_set(frames).images
    assert reduced is not None
    assert 0.99 * MAX_PIXELS < reduced.size <= MAX_PIXELS
    assert kept is image
    assert missing is None


def test_features_of_a_frame_set_are_detected_once() -> None:
    """Windows overlap. Their frames share the features, but not what is known of the background since their first ones."""
    clip = render("late")
    images = clip.frames()[0]
    with open_search(clip.rig) as search:
        first, again = search.detect_frame(0, images), search.detect_frame(8, images)
        faint = search.detect_frame(0, images, faint=True)
    assert (first.number, again.number) == (0, 8)
    for a, b, more in zip(first.cameras, again.cameras, faint.cameras, strict=True):
        assert a.features is b.features
        assert a.background is not b.background
        assert len(more.features) > len(a.features)


def test_part_of_a_body_is_no_other_body() -> None:
    """Over 15 degrees the fit leaves some of the demo's own matches; they follow a motion of theirs no better."""
    scene = make_demo_scene()
    frames = frame_sets(list(islice(render_frames(scene), 32)))
    for start in (8, 15):
        candidates = find_candidates(scene.rig, [frames[start : start + WINDOW_FRAMES]])
        assert len(candidates) == 1
        assert not candidates[0].is_ambiguous(TrackingOptions())


def test_late_object_is_found_where_it_moves() -> None:
    (candidate,) = candidates_of("late")
    assert candidate.first >= ARRIVAL
    assert not candidate.is_ambiguous(TrackingOptions())
    tracked = list(track(render("late").frames(), render("late").rig))
    assert len(tracked) == N_FRAMES
    assert set(statuses(tracked[: candidate.first])) == {FrameStatus.NO_MOTION}
    reason = f"the object is not seen to move before frame {candidate.first}"
    assert {frame.pose.reason for frame in tracked[: candidate.first]} == {reason}
    assert statuses(tracked[candidate.first :]) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (
        N_FRAMES - candidate.first - 1
    )


def test_resting_object_has_a_pose_from_the_first_frame() -> None:
    (candidate,) = candidates_of("resting")
    assert candidate.first == 0
    assert candidate.last > ARRIVAL
    clip = render("resting")
    tracked = list(track(clip.frames(), clip.rig))
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * (N_FRAMES - 1)
    assert compute_pose_errors(tracked, clip.truth)[:, 0].max() < 0.5


def test_outlines_contain_the_body() -> None:
    clip = render("with another")
    for candidate in candidates_of("with another"):
        path = min((make_drifting_pose, swing), key=lambda p: _offset(clip, candidate, p(candidate.first)))
        for camera, outline in zip(clip.rig, candidate.outlines, strict=True):
            assert outline is not None
            x, y = camera.project(path(candidate.first).translation)[0]
            assert (outline.min(axis=0) < [x, y]).all()
            assert (outline.max(axis=0) > [x, y]).all()


def _offset(clip: Clip, candidate: Candidate, pose: RigidTransform) -> float:
    """Return the largest distance of an outline's center from that of a body, pixels."""
    pixels = [camera.project(pose.translation)[0] for camera in clip.rig]
    centers = [outline.mean(axis=0) for outline in candidate.outlines if outline is not None]
    return float(np.linalg.norm(np.subtract(pixels, centers), axis=1).max())


def test_of_two_bodies_none_is_tracked_silently() -> None:
    clip, candidates = render("with another"), candidates_of("with another")
    assert len(candidates) == 2
    assert all(candidate.is_ambiguous(TrackingOptions()) for candidate in candidates)
    assert candidates[0].n_matches >= candidates[1].n_matches
    tracked = list(track(clip.frames(), clip.rig))
    assert set(statuses(tracked)) == {FrameStatus.FIRST, FrameStatus.AMBIGUOUS}
    assert "several bodies" in tracked[0].note.lower() or "another one moves" in tracked[0].note
    refined = smooth_tracks([Track.from_tracked(frame) for frame in tracked], clip.rig).poses
    assert {pose.status for pose in refined} == {FrameStatus.FIRST, FrameStatus.AMBIGUOUS}


def test_body_at_the_same_place_is_a_rival() -> None:
    """A bar crosses the object, as a forearm does, and turns about another axis: their centers are near."""

    def cross(frame: float) -> RigidTransform:
        center = make_drifting_pose(frame).translation
        return RigidTransform.from_components(center, Rotation.from_rotvec([0, 0, 0.08 * frame]))

    bar = Actor(make_slab([0.8, 0.15, 0.08], 5), cross)
    clip = Clip.render(moving_scene(make_drifting_pose, N_FRAMES, [bar], n_cameras=3))
    largest = find_candidates(clip.rig, windows_of(list(clip.frames())))[0]
    assert largest.rival_ratio > TrackingOptions().max_rival_ratio


def test_faint_body_is_a_rival() -> None:
    """Of a plain object that a person holds, features of normal contrast show nothing."""
    slab = make_slab([0.4, 0.3, 0.1], 5)
    textures = [(128 + 0.1 * (texture.astype(float) - 128)).astype(np.uint8) for texture in slab.textures]
    faint = Actor(replace(slab, textures=tuple(textures)), swing)
    clip = Clip.render(moving_scene(make_drifting_pose, N_FRAMES, [faint], n_cameras=3))
    largest, *_ = find_candidates(clip.rig, windows_of(list(clip.frames())))
    assert largest.is_ambiguous(TrackingOptions())


def test_bodies_that_move_one_after_the_other_are_two() -> None:
    """They never move in the same window, and each rests in sight while the other moves."""
    clip = render_successive(30, frames=48)
    candidates = find_candidates(clip.rig, windows_of(clip.frames()))
    assert len(candidates) == 2
    larger, smaller = candidates
    assert larger.rival_ratio == smaller.rival_ratio == 0.0
    assert larger.later_ratio == pytest.approx(smaller.n_matches / larger.n_matches)
    assert smaller.later_ratio == pytest.approx(larger.n_matches / smaller.n_matches)
    assert smaller.is_ambiguous(TrackingOptions())
    assert larger.is_ambiguous(TrackingOptions()) == (larger.later_ratio > TrackingOptions.max_rival_ratio)
    assert not replace(smaller, is_chosen=True).is_ambiguous(TrackingOptions())


def test_rival_is_measured_where_both_move() -> None:
    """A body that moves all the time has a rival, however short the time of that."""
    clip = render_successive(16, end=24)
    candidates = find_candidates(clip.rig, windows_of(clip.frames()))
    assert len(candidates) == 2
    assert min(candidate.rival_ratio for candidate in candidates) > 3 * TrackingOptions.max_rival_ratio


@pytest.mark.parametrize("path", [make_drifting_pose, swing])
def test_chosen_body_is_tracked(path: Path) -> None:
    clip = render("with another")
    candidate = min(candidates_of("with another"), key=lambda c: _offset(clip, c, path(c.first)))
    chosen = replace(candidate, is_chosen=True)
    with Tracker(clip.rig, candidate=chosen) as tracker:
        tracked = [result for frames in clip.frames() for result in tracker.step(frames)]
    assert set(statuses(tracked[candidate.first :])) == {FrameStatus.FIRST, FrameStatus.TRACKED}
    start, end = tracked[candidate.first].pose.world_from_object, tracked[-1].pose.world_from_object
    assert start is not None
    assert end is not None
    true = path(N_FRAMES - 1) * path(candidate.first).inv()
    off = (end * start.inv()).rotation * true.rotation.inv()
    assert np.degrees(off.magnitude()) < 0.5


@pytest.mark.parametrize("last", [1, 6, 50])
def test_no_frame_is_lost_while_the_search_waits(last: int) -> None:
    """The frame up to which the search measured the motion may be beyond what is buffered, or the recording's end."""
    clip = Clip.render(moving_scene(lambda frame: make_rotated_pose(4.0 * frame), 7, n_cameras=2))
    candidate = replace(find_candidates(clip.rig, [clip.frames()])[0], first=0, last=last)
    with Tracker(clip.rig, candidate=candidate, options=TrackingOptions(max_buffered_frames=3)) as tracker:
        tracked = [result for frames in clip.frames() for result in tracker.step(frames)] + tracker.flush()
    assert statuses(tracked) == [FrameStatus.FIRST] + [FrameStatus.TRACKED] * 6


def test_frames_without_numbers_are_searched_as_numbered() -> None:
    clip = render("resting")
    numbered = list(clip.frames())
    assert [frames.index for frames in numbered] == list(range(N_FRAMES))
    unnumbered = [replace(frames, index=UNNUMBERED) for frames in numbered]
    expected, found = ([frame.pose for frame in track(own, clip.rig)] for own in (numbered, unnumbered))
    assert [pose.index for pose in found] == list(range(N_FRAMES))
    for a, b in zip(expected, found, strict=True):
        assert a.status is b.status
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_iterator_is_searched_as_the_sequence() -> None:
    clip = render("late")
    frames = clip.frames()
    for ahead, is_found in ((60, True), (0, False)):
        tracked = list(track(iter(frames), clip.rig, lookahead=ahead))
        assert (FrameStatus.TRACKED in statuses(tracked)) or not is_found
        assert [frame.pose.index for frame in tracked] == list(range(N_FRAMES))
    by_sequence = list(track(frames, clip.rig))
    by_iterator = list(track(iter(frames), clip.rig))
    for a, b in zip(by_sequence, by_iterator, strict=True):
        np.testing.assert_array_equal(a.pose.covariance, b.pose.covariance)


def turn_upside_down(frames: Sequence[FrameSet]) -> list[FrameSet]:
    return [
        replace(frame, images=tuple(image[::-1, ::-1] for image in frame.images if image is not None))
        for frame in frames
    ]


def test_wrong_rig_is_contradicted_from_the_first_pose_on() -> None:
    """Of a right rig the F ratio is about 1; images turned upside down contradict the calibration in every window."""
    clip = render("resting")
    (right,) = candidates_of("resting")
    assert right.f_ratio < 3.0
    frames = turn_upside_down(clip.frames())
    wrong = find_candidates(clip.rig, windows_of(frames))[0]
    assert wrong.f_ratio > TrackingOptions.max_pooled_f_ratio
    tracked = list(track(frames, clip.rig))
    assert FrameStatus.TRACKED not in statuses(tracked)
    assert FrameStatus.CONTRADICTED in statuses(tracked)


def test_wrong_rig_is_contradicted_with_boxes() -> None:
    """From the first pose on, though the depths are guessed then."""
    clip = Clip.render(moving_scene(make_drifting_pose, N_FRAMES, n_cameras=3))
    frames, boxes = clip.frames(), clip.boxes
    (width, height), turned = clip.rig.cameras[0].size, dict[str, Box]()
    for name, box in boxes.items():
        turned[name] = Box(width - 1 - box.x - box.width, height - 1 - box.y - box.height, box.width, box.height)
    assert compare_cameras(clip.rig, frames, boxes) < 3.0
    assert compare_cameras(clip.rig, turn_upside_down(frames), turned) > TrackingOptions.max_pooled_f_ratio
    assert np.isnan(compare_cameras(clip.rig, frames[:2], boxes))  # one pair of frames may have outliers
    tracked = list(track(turn_upside_down(frames), clip.rig, turned))
    assert FrameStatus.TRACKED not in statuses(tracked)
    assert FrameStatus.CONTRADICTED in statuses(tracked)


def test_scattered_keypoints_are_no_rigid_motion() -> None:
    """Those of a wall in compressed pictures are displaced by more than the usual noise, each by its own."""
    rng, camera = np.random.default_rng(0), render("resting").rig.cameras[0]
    depths = np.column_stack([rng.uniform(-0.3, 0.3, (80, 2)), rng.uniform(1.4, 1.8, 80)])
    points, turn = (
        camera.camera_from_world.inv().apply(depths),
        RigidTransform.from_rotation(Rotation.from_rotvec([0, 0.1, 0])),
    )
    before, after = camera.project(points), camera.project(turn.apply(points))
    is_static, is_rigid = find_rigid_motion(camera, make_pair(before, after), TrackingOptions())
    assert is_rigid
    assert is_static.mean() < 0.2
    scattered = before + rng.normal(0, 8.0, before.shape)
    assert not find_rigid_motion(camera, make_pair(before, scattered), TrackingOptions())[1]
    assert not find_rigid_motion(camera, make_pair(before, before), TrackingOptions())[1]


@pytest.mark.parametrize(("offset", "is_known"), [(0.01, True), (0.2, False)])
def test_evidence_needs_time_offsets_that_are_small_against_the_motion(offset: float, is_known: bool) -> None:
    """Cameras that see an accelerating object at other times see other motions."""
    clip = render("resting")
    frames = [replace(frame, times=tuple(frame.time + offset * c for c in range(3))) for frame in clip.frames()]
    (candidate,) = find_candidates(clip.rig, windows_of(frames))
    assert np.isfinite(candidate.f_ratio) == is_known


def test_fast_object_is_one_body() -> None:
    """After 60 degrees its features are others, but it is at the same place."""
    clip = Clip.render(moving_scene(lambda frame: make_rotated_pose(10 * frame), N_FRAMES, n_cameras=3))
    candidates = find_candidates(clip.rig, windows_of(clip.frames()))
    assert candidates[0].first == 0
    assert candidates[0].n_matches > 0.9 * sum(candidate.n_matches for candidate in candidates)


def test_nothing_moves() -> None:
    clip = render("late")
    frames = clip.frames()[:ARRIVAL]
    assert not find_candidates(clip.rig, windows_of(frames))
    assert set(statuses(track(frames, clip.rig))) == {FrameStatus.NO_MOTION}
