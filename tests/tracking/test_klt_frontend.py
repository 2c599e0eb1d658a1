"""KLT front end: when an anchor suffices, how one is created, and tracking in the next image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.features.klt import start_tracks
from sylpose.features.sift import Features
from sylpose.geometry.arrays import BoolArray, FloatArray, Image
from sylpose.landmarks.landmark_filter import KNOWN_DEPTH_RATIO, LandmarkTable, initialize_landmarks
from sylpose.rig import Camera
from sylpose.tracking.camera_side.camera import (
    MAX_TRACKED,
    MIN_NEW_FEATURES,
    MIN_TRACK_DISTANCE_PX,
    CameraAnchor,
    TrackedFeatures,
    advance_anchor,
    append_new_features,
    create_anchor,
    track_anchor,
)
from sylpose.tracking.camera_side.frame import CameraFrame
from sylpose.tracking.joint_side.joint_state import (
    MAX_ANCHOR_ROTATION,
    MIN_CAMERA_RATIO,
    MIN_TRACKED,
    MIN_TRACKED_RATIO,
    RETRY_FRAMES,
    Anchor,
    SolvedFrame,
    has_enough_tracks,
)
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.reports import TrackingReport

SIZE, FOCAL, DEPTH, RADIUS = (260, 200), 300.0, 1.5, 0.2
N_ANCHOR_FEATURES = TrackingOptions.n_anchor_features
MATRIX = np.array([[FOCAL, 0, (SIZE[0] - 1) / 2], [0, FOCAL, (SIZE[1] - 1) / 2], [0, 0, 1]])
CAMERA = Camera("cam_0", SIZE, MATRIX, np.zeros(4), RigidTransform.identity())
START = RigidTransform.from_translation([0, 0, DEPTH])


@cache
def render_picture(du: float = 0.0, dv: float = 0.0) -> Image:
    """Waves of many directions, translated without interpolation."""
    u, v = np.meshgrid(np.arange(float(SIZE[0])) - du, np.arange(float(SIZE[1])) - dv)
    rng = np.random.default_rng(7)
    total = np.zeros_like(u)
    for _ in range(40):
        angle, length, phase = rng.uniform(0, 2 * np.pi), rng.uniform(6, 40), rng.uniform(0, 2 * np.pi)
        total += np.sin(2 * np.pi / length * (u * np.cos(angle) + v * np.sin(angle)) + phase)
    return np.asarray(np.clip(np.rint(128 + 14 * total), 0, 255).astype(np.uint8))


def make_translated_pose(du: float, dv: float) -> RigidTransform:
    """Pose of the object at which its image is translated by these pixels."""
    return RigidTransform.from_translation([du * DEPTH / FOCAL, dv * DEPTH / FOCAL, DEPTH])


def make_features(pixels: FloatArray, first: int = 0) -> Features:
    """Features whose descriptors encode their number, from `first` on."""
    looks = np.zeros((len(pixels), 128), np.float32)
    looks[:, 0] = first + np.arange(len(pixels))
    return Features(pixels, CAMERA.normalize(pixels), looks)


def make_grid(n: int, margin: float = 30.0) -> FloatArray:
    """(n, 2) pixels all over the picture, well separated, in mixed order."""
    u, v = np.meshgrid(np.linspace(margin, SIZE[0] - margin, 26), np.linspace(margin, SIZE[1] - margin, 20))
    places = np.column_stack([u.ravel(), v.ravel()])
    return np.asarray(np.random.default_rng(3).permutation(places)[:n])


def make_camera_frame(features: Features, depth_sd: float = 1e-3) -> CameraFrame:
    """A frame solved at START, with all features in one plane."""
    rays = np.column_stack([features.normalized, np.ones(len(features))])
    distance = DEPTH * np.linalg.norm(rays, axis=1)
    table = LandmarkTable()
    landmarks = initialize_landmarks(features, CAMERA, START.inv(), distance, np.full(len(features), depth_sd))
    return CameraFrame(features, np.zeros(len(features), bool), table, table.update(landmarks))


def make_anchor(n: int = 60, depth_sd: float = 1e-3) -> CameraAnchor:
    return create_anchor(5, make_camera_frame(make_features(make_grid(n)), depth_sd), render_picture(), None)


def track_to(
    anchor: CameraAnchor, image: Image | None, predicted_pose: RigidTransform = START, mask: BoolArray | None = None
) -> TrackedFeatures:
    return track_anchor(anchor, CAMERA, (image, mask), (START, predicted_pose), RADIUS)


# --- sufficiency


def make_report(
    n_tracked: int, n_alive: int, *, expects_object: bool = True, has_previous_image: bool = True
) -> TrackingReport:
    return TrackingReport(n_tracked, n_alive, expects_object, has_previous_image)


def make_shared_anchor(age: int = 0) -> Anchor:
    nothing = np.zeros((3, 3))
    return Anchor(SolvedFrame(0, 0.0, np.zeros(3), START, np.zeros((6, 6)), nothing, np.ones(3, bool)), age)


def is_sufficient(reports: Sequence[TrackingReport], age: int = 0, turn: float = 0.0) -> bool:
    axis = np.array([0.36, 0.8, 0.48])
    predicted_pose = RigidTransform.from_components([0.5, 0, DEPTH], Rotation.from_rotvec(turn * axis) * START.rotation)
    return has_enough_tracks(reports, make_shared_anchor(age), predicted_pose)


def test_fully_tracked_anchor_suffices() -> None:
    assert is_sufficient([make_report(100, 100)] * 3)


def test_anchor_needs_minimum_share_overall() -> None:
    alive, least = 250, round(MIN_TRACKED_RATIO * 500)
    assert is_sufficient([make_report(least - 80, alive), make_report(80, alive)])
    assert not is_sufficient([make_report(least - 81, alive), make_report(80, alive)])


def test_anchor_needs_minimum_count() -> None:
    third = MIN_TRACKED // 3
    assert is_sufficient([make_report(third, third)] * 3)
    assert not is_sufficient([make_report(third, third)] * 2 + [make_report(third - 1, third - 1)])


def test_anchor_needs_minimum_share_per_camera() -> None:
    least = round(MIN_CAMERA_RATIO * 100)
    assert is_sufficient([make_report(100, 100), make_report(100, 100), make_report(least, 100)])
    assert not is_sufficient([make_report(100, 100), make_report(100, 100), make_report(least - 1, 100)])


def test_anchor_ends_after_large_rotation() -> None:
    assert is_sufficient([make_report(100, 100)] * 3, turn=MAX_ANCHOR_ROTATION - 1e-6)
    assert not is_sufficient([make_report(100, 100)] * 3, turn=MAX_ANCHOR_ROTATION + 1e-6)


def test_returning_camera_triggers_detection() -> None:
    good = [make_report(100, 100)] * 2
    assert not is_sufficient([*good, make_report(0, 0, expects_object=True, has_previous_image=False)])
    assert is_sufficient([*good, make_report(0, 0, expects_object=False, has_previous_image=False)])


def test_camera_without_tracks_is_searched_again() -> None:
    good = [make_report(100, 100)] * 2
    assert is_sufficient([*good, make_report(0, 0)], age=RETRY_FRAMES - 1)
    assert not is_sufficient([*good, make_report(0, 0)], age=RETRY_FRAMES)
    # A camera with the object out of view is ignored; one with tracks needs no new search.
    assert is_sufficient([*good, make_report(0, 0, expects_object=False)], age=RETRY_FRAMES)
    assert is_sufficient([*good, make_report(100, 100)], age=RETRY_FRAMES)


def test_camera_report() -> None:
    anchor = make_anchor()
    alive = anchor.is_alive.copy()
    alive[:7] = False
    here, region = track_to(replace(anchor, is_alive=alive), render_picture()), np.zeros((4, 2))
    report = here.create_report(region)
    assert (report.n_tracked, report.n_alive) == (len(here), int(alive.sum()))
    assert len(here) > 0.9 * alive.sum()
    assert report.expects_object
    assert report.has_previous_image
    assert not here.create_report(None).expects_object
    assert not track_to(anchor, None).create_report(region).expects_object
    assert not track_to(replace(anchor, image=None), render_picture()).create_report(region).has_previous_image


# --- creation


def test_first_anchor_tracks_its_frames_features() -> None:
    anchor = make_anchor(60)
    assert (anchor.number, len(anchor.tracks), anchor.is_alive.shape) == (5, 60, (60,))
    assert anchor.is_alive.sum() > 55
    np.testing.assert_array_equal(anchor.tracks.pixels[anchor.is_alive], make_grid(60)[anchor.is_alive])
    assert anchor.image is not None
    assert anchor.image.ndim == 2
    coloured = create_anchor(5, anchor.frame, np.repeat(render_picture()[:, :, None], 3, axis=2), None)
    np.testing.assert_array_equal(coloured.is_alive, anchor.is_alive)


def test_anchor_without_image_has_no_tracks() -> None:
    frame = make_camera_frame(make_features(make_grid(60)))
    anchor = create_anchor(5, frame, None, None)
    assert anchor.image is None
    assert not anchor.is_alive.any()
    assert len(anchor.tracks) == 60
    assert len(track_to(anchor, render_picture())) == 0


def assert_spread(chosen: FloatArray, n: int, wanted: int) -> None:
    """Assert that the selection of n features is as evenly spread as possible."""
    assert len(chosen) == wanted
    assert chosen[0] <= n / wanted
    assert chosen[-1] >= n - 1 - np.ceil(n / wanted)
    assert np.diff(chosen).max() <= np.ceil(n / wanted)


@pytest.mark.parametrize("n", [MAX_TRACKED - 20, MAX_TRACKED + 100, 2 * MAX_TRACKED + 37])
def test_tracked_features_are_spread_over_the_list(n: int) -> None:
    anchor = make_anchor(n)
    can = np.flatnonzero(anchor.tracks.tracked)
    assert len(can) > 0.9 * n
    assert not (anchor.is_alive & ~anchor.tracks.tracked).any()
    assert_spread(
        np.searchsorted(can, np.flatnonzero(anchor.is_alive)).astype(float), len(can), min(len(can), MAX_TRACKED)
    )


@pytest.mark.parametrize("followed_ones", [50, MAX_TRACKED - MIN_NEW_FEATURES + 10, 2 * MAX_TRACKED])
def test_next_anchor_keeps_tracks_and_adds_new_ones(followed_ones: int) -> None:
    old = make_anchor(450)
    image = render_picture(2.0, 1.0)
    alive = np.zeros(450, bool)
    alive[np.flatnonzero(old.tracks.tracked)[: followed_ones + 20]] = True
    before = track_to(replace(old, is_alive=alive), image, make_translated_pose(2.0, 1.0))
    k = len(before)
    assert 0.9 * followed_ones < k <= followed_ones + 20
    fresh = make_grid(450, margin=25.0)[:120]
    both = append_new_features(before, make_features(fresh, 1000), np.zeros(120, bool), N_ANCHOR_FEATURES)
    anchor = create_anchor(9, make_camera_frame(both), render_picture(50.0, 50.0), before)
    # Kept tracks preserve their order, patches and pixels, not those of any other image.
    assert anchor.number == 9
    np.testing.assert_array_equal(anchor.image, image)
    patches = before.tracks
    np.testing.assert_array_equal(anchor.tracks.filters[:k], patches.filters[before.rows])
    np.testing.assert_array_equal(anchor.tracks.pixels[:k], before.features.pixels)
    np.testing.assert_array_equal(anchor.tracks.warps[:k], before.tracks.warps[before.rows])
    assert anchor.is_alive[:k].all()
    # The others start in this image.
    new = start_tracks(image, both.pixels[k:])
    np.testing.assert_array_equal(anchor.tracks.filters[k:], new.filters)
    assert anchor.is_alive[k:].sum() == min(new.tracked.sum(), max(MAX_TRACKED - k, MIN_NEW_FEATURES))
    assert anchor.is_alive[k:].sum() >= min(MIN_NEW_FEATURES, int(new.tracked.sum())) > 0


def test_outliers_are_dropped_without_modifying_old_anchor() -> None:
    anchor = make_anchor()
    tracked = track_to(anchor, render_picture(1.0, 0.0), make_translated_pose(1.0, 0.0))
    pair = tracked.match_with_anchor()
    weights = np.linspace(0.1, 1, len(pair))
    weights[[3, 8, 20]] = 0.0
    alive, pixels = anchor.is_alive.copy(), anchor.tracks.pixels.copy()
    after = advance_anchor(tracked, [pair.subset(np.arange(len(pair)) < 10), pair], [weights[:10], weights])
    died = tracked.rows[[3, 8, 20]]
    np.testing.assert_array_equal(np.flatnonzero(alive & ~after.is_alive), died)
    np.testing.assert_array_equal(anchor.is_alive, alive)
    np.testing.assert_array_equal(anchor.tracks.pixels, pixels)
    # It remains the anchor; its features have moved in the image.
    assert (after.number, after.frame) == (anchor.number, anchor.frame)
    np.testing.assert_allclose(after.tracks.pixels[died] - pixels[died], [[1.0, 0.0]] * 3, atol=0.2)
    np.testing.assert_array_equal(after.image, render_picture(1.0, 0.0))
    # Dropped features are not searched again.
    poses = make_translated_pose(1.0, 0.0), make_translated_pose(2.0, 0.0)
    again = track_anchor(after, CAMERA, (render_picture(2.0, 0.0), None), poses, RADIUS)
    assert not np.isin(died, again.rows).any()
    assert len(again) > 0.9 * after.is_alive.sum()


def test_last_image_is_kept_when_none_arrives() -> None:
    anchor = make_anchor()
    after = advance_anchor(track_to(anchor, None), [], [])
    assert after.image is anchor.image
    assert after.tracks is anchor.tracks
    later = track_to(after, render_picture(3.0, -2.0), make_translated_pose(3.0, -2.0))
    assert len(later) > 0.9 * anchor.is_alive.sum()


# --- new features


def make_tracked(pixels: FloatArray) -> TrackedFeatures:
    features = make_features(pixels)
    anchor = CameraAnchor(
        0,
        make_camera_frame(features),
        start_tracks(render_picture(), pixels),
        np.ones(len(pixels), bool),
        render_picture(),
    )
    return TrackedFeatures(anchor, np.arange(len(pixels)), features, pixels, anchor.tracks, render_picture())


@pytest.mark.parametrize(("share", "kept"), [(0.98, False), (1.02, True)])
def test_new_feature_near_a_tracked_one_is_dropped(share: float, kept: bool) -> None:
    known = make_grid(30)
    new = known[:5] + share * MIN_TRACK_DISTANCE_PX * np.array([0.6, -0.8])
    both = append_new_features(make_tracked(known), make_features(new, 1000), np.zeros(5, bool), N_ANCHOR_FEATURES)
    assert len(both) == (35 if kept else 30)
    np.testing.assert_array_equal(both.pixels[:30], known)
    np.testing.assert_array_equal(both.descriptors[:30, 0], np.arange(30))


def test_background_features_are_omitted() -> None:
    background = np.arange(60) % 3 == 0
    both = append_new_features(
        make_tracked(np.empty((0, 2))), make_features(make_grid(60), 1000), background, N_ANCHOR_FEATURES
    )
    assert both.descriptors[:, 0].tolist() == (1000 + np.flatnonzero(~background)).tolist()
    np.testing.assert_array_equal(both.pixels, make_grid(60)[~background])
    np.testing.assert_array_equal(both.normalized, CAMERA.normalize(both.pixels))


@pytest.mark.parametrize(
    "known", [0, 100, N_ANCHOR_FEATURES - MIN_NEW_FEATURES - 1, N_ANCHOR_FEATURES - 1, N_ANCHOR_FEATURES + 50]
)
def test_number_of_new_features(known: int) -> None:
    apart = np.random.default_rng(0).uniform(1e4, 2e4, (known, 2))
    for n in (10, 500):
        both = append_new_features(
            make_tracked(apart), make_features(make_grid(n), 1000), np.zeros(n, bool), N_ANCHOR_FEATURES
        )
        new = both.descriptors[known:, 0].astype(float) - 1000
        wanted = max(N_ANCHOR_FEATURES - known, MIN_NEW_FEATURES)
        assert_spread(new, n, min(n, wanted))
    none = append_new_features(make_tracked(apart), Features.empty(), np.zeros(0, bool), N_ANCHOR_FEATURES)
    assert len(none) == known


# --- the next image


@pytest.mark.parametrize("shift", [(0.0, 0.0), (2.3, -1.6), (-4.4, 3.7)])
def test_features_follow_image_translation(shift: tuple[float, float]) -> None:
    """Also without a prediction."""
    anchor = make_anchor()
    anchor = replace(anchor, is_alive=anchor.is_alive & (np.arange(60) % 3 > 0))
    for predicted_pose in (START, make_translated_pose(*shift)):
        tracked = track_to(anchor, render_picture(*shift), predicted_pose)
        assert 0.9 * anchor.is_alive.sum() < len(tracked) <= anchor.is_alive.sum()
        truth = make_grid(60)[tracked.rows]
        assert np.linalg.norm(tracked.features.pixels - truth - shift, axis=1).max() < 0.2
        np.testing.assert_array_equal(tracked.previous_pixels, truth)
        np.testing.assert_array_equal(tracked.features.descriptors[:, 0], tracked.rows)
        np.testing.assert_array_equal(tracked.features.normalized, CAMERA.normalize_to_grid(tracked.features.pixels))
        assert (np.diff(tracked.rows) > 0).all()


def test_large_translation_needs_prediction() -> None:
    anchor, translation = make_anchor(), (23.0, -14.0)
    predicted, alone = (
        track_to(anchor, render_picture(*translation), ahead) for ahead in (make_translated_pose(*translation), START)
    )
    right = [
        np.linalg.norm(f.features.pixels - make_grid(60)[f.rows] - translation, axis=1) < 0.2
        for f in (predicted, alone)
    ]
    assert right[0].all()
    assert len(right[0]) > 0.8 * anchor.is_alive.sum()
    assert right[1].sum() < 0.1 * anchor.is_alive.sum()


def test_tracks_use_last_pixel_not_landmark_projection() -> None:
    """Landmarks with 15 pixels of reprojection error still predict the object's image motion."""
    anchor, translation = make_anchor(), (23.0, -14.0)
    landmarks = anchor.frame.landmarks
    anchor.frame.table.update(replace(landmarks, mean=landmarks.mean + np.array([15 * DEPTH / FOCAL, 0, 0])))
    tracked = track_to(anchor, render_picture(*translation), make_translated_pose(*translation))
    assert len(tracked) > 0.8 * anchor.is_alive.sum()
    assert np.linalg.norm(tracked.features.pixels - make_grid(60)[tracked.rows] - translation, axis=1).max() < 0.2


def test_pair_connects_tracked_and_anchor_features() -> None:
    tracked = track_to(make_anchor(), render_picture(2.0, 0.0), make_translated_pose(2.0, 0.0))
    pair = tracked.match_with_anchor()
    assert pair.reference == 5
    np.testing.assert_array_equal(pair.indices, np.column_stack([tracked.rows, np.arange(len(tracked))]))
    np.testing.assert_array_equal(pair.pixels_i, make_grid(60)[tracked.rows])
    np.testing.assert_array_equal(pair.pixels_j, tracked.features.pixels)


def test_features_outside_mask_are_dropped() -> None:
    anchor, translation = make_anchor(), (2.0, 1.0)
    mask = np.zeros(SIZE[::-1], bool)
    mask[:, :120] = True
    everywhere = track_to(anchor, render_picture(*translation), make_translated_pose(*translation))
    inside = track_to(anchor, render_picture(*translation), make_translated_pose(*translation), mask)
    expected = np.round(everywhere.features.pixels[:, 0]) < 120
    assert 0.2 < expected.mean() < 0.8
    np.testing.assert_array_equal(inside.rows, everywhere.rows[expected])
    np.testing.assert_array_equal(inside.features.pixels, everywhere.features.pixels[expected])
    # Their tracks continue, as a single mask may be wrong.
    np.testing.assert_array_equal(inside.tracks.tracked, everywhere.tracks.tracked)


@pytest.mark.parametrize("missing", ["now", "before", "alive"])
def test_missing_images_or_features_keep_tracks(missing: str) -> None:
    anchor = make_anchor()
    if missing == "before":
        anchor = replace(anchor, image=None)
    if missing == "alive":
        anchor = replace(anchor, is_alive=np.zeros(60, bool))
    tracked = track_to(anchor, None if missing == "now" else render_picture())
    assert (
        len(tracked) == len(tracked.match_with_anchor()) == len(tracked.features) == len(tracked.previous_pixels) == 0
    )
    assert tracked.tracks is anchor.tracks
    assert (tracked.image is None) == (missing == "now")


@pytest.mark.parametrize(("share", "found"), [(0.9, True), (1.1, False)])
def test_lost_features_with_known_depth_are_searched_again(share: float, found: bool) -> None:
    anchor = make_anchor(depth_sd=share * KNOWN_DEPTH_RATIO * RADIUS)
    lost = np.zeros(60, bool)
    lost[::2] = True
    anchor = replace(anchor, tracks=anchor.tracks.keep(~lost))
    tracked = track_to(anchor, render_picture(3.0, 2.0), make_translated_pose(3.0, 2.0))
    again = lost[tracked.rows]
    assert again.sum() == 0 if not found else again.sum() > 0.8 * (lost & anchor.is_alive).sum()
    assert (~again).sum() > 0.9 * (~lost & anchor.is_alive).sum()
    # Its previous pixel is unknown.
    assert np.isnan(tracked.previous_pixels[again]).all()
    assert np.isfinite(tracked.previous_pixels[~again]).all()
    truth = make_grid(60)[tracked.rows] + [3.0, 2.0]
    assert np.linalg.norm(tracked.features.pixels - truth, axis=1).max() < 0.2
