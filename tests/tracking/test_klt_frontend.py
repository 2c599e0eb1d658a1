"""The KLT front end: when an anchor serves on, how one begins, and where its features are in the next image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.features.klt import begin
from sylpose.features.sift import Features
from sylpose.geometry.arrays import BoolArray, FloatArray, Image
from sylpose.landmarks.landmark_filter import new_landmarks
from sylpose.landmarks.landmark_table import LandmarkTable
from sylpose.rig import Camera
from sylpose.tracking.frame import CameraFrame, SolvedFrame
from sylpose.tracking.klt_frontend import (
    ANCHOR_SHARE,
    ANCHOR_TURN,
    ASK_AGAIN,
    CAMERA_SHARE,
    FEATURES,
    FOLLOWED,
    KNOWN_DEPTH,
    MIN_FOLLOWED,
    MIN_NEW,
    SAME_PX,
    Anchor,
    CameraAnchor,
    Followed,
    begin_anchor,
    follow,
    gone_on,
    suffices,
    with_new,
)
from sylpose.tracking.reports import Following

SIZE, FOCAL, DEPTH, RADIUS = (260, 200), 300.0, 1.5, 0.2
MATRIX = np.array([[FOCAL, 0, (SIZE[0] - 1) / 2], [0, FOCAL, (SIZE[1] - 1) / 2], [0, 0, 1]])
CAMERA = Camera("cam_0", SIZE, MATRIX, np.zeros(4), RigidTransform.identity())
START = RigidTransform.from_translation([0, 0, DEPTH])


@cache
def picture(du: float = 0.0, dv: float = 0.0) -> Image:
    """Waves of many directions, shifted without interpolation."""
    u, v = np.meshgrid(np.arange(float(SIZE[0])) - du, np.arange(float(SIZE[1])) - dv)
    rng = np.random.default_rng(7)
    total = np.zeros_like(u)
    for _ in range(40):
        angle, length, phase = rng.uniform(0, 2 * np.pi), rng.uniform(6, 40), rng.uniform(0, 2 * np.pi)
        total += np.sin(2 * np.pi / length * (u * np.cos(angle) + v * np.sin(angle)) + phase)
    return np.asarray(np.clip(np.rint(128 + 14 * total), 0, 255).astype(np.uint8))


def shifted(du: float, dv: float) -> RigidTransform:
    """Where the object has to be to be seen so many pixels further."""
    return RigidTransform.from_translation([du * DEPTH / FOCAL, dv * DEPTH / FOCAL, DEPTH])


def features_at(pixels: FloatArray, first: int = 0) -> Features:
    """Whose look tells their number, from `first` on."""
    looks = np.zeros((len(pixels), 128), np.float32)
    looks[:, 0] = first + np.arange(len(pixels))
    return Features(pixels, CAMERA.normalize(pixels), looks)


def grid(n: int, margin: float = 30.0) -> FloatArray:
    """(n, 2) all over the picture, none near another, in a mixed order."""
    u, v = np.meshgrid(np.linspace(margin, SIZE[0] - margin, 26), np.linspace(margin, SIZE[1] - margin, 20))
    places = np.column_stack([u.ravel(), v.ravel()])
    return np.asarray(np.random.default_rng(3).permutation(places)[:n])


def camera_frame(features: Features, depth_sd: float = 1e-3) -> CameraFrame:
    """Solved at START, all features in one plane."""
    rays = np.column_stack([features.normalized, np.ones(len(features))])
    distance = DEPTH * np.linalg.norm(rays, axis=1)
    table = LandmarkTable()
    landmarks = new_landmarks(features, CAMERA, START.inv(), distance, np.full(len(features), depth_sd))
    return CameraFrame(features, np.zeros(len(features), bool), table, table.learn(landmarks))


def anchor_of(n: int = 60, depth_sd: float = 1e-3) -> CameraAnchor:
    return begin_anchor(5, camera_frame(features_at(grid(n)), depth_sd), picture(), None)


def followed_to(
    anchor: CameraAnchor, image: Image | None, ahead: RigidTransform = START, mask: BoolArray | None = None
) -> Followed:
    return follow(anchor, CAMERA, START, ahead, image, mask, RADIUS)


# --- whether it suffices


def told(found: int, alive: int, *, looks: bool = True, follows: bool = True) -> Following:
    return Following(found, alive, looks, follows)


def joint_anchor(age: int = 0) -> Anchor:
    nothing = np.zeros((3, 3))
    return Anchor(SolvedFrame(0, 0.0, np.zeros(3), START, np.zeros((6, 6)), nothing, np.ones(3, bool)), age)


def enough(reports: Sequence[Following], age: int = 0, turn: float = 0.0) -> bool:
    axis = np.array([0.36, 0.8, 0.48])
    ahead = RigidTransform.from_components([0.5, 0, DEPTH], Rotation.from_rotvec(turn * axis) * START.rotation)
    return suffices(reports, joint_anchor(age), ahead)


def test_an_anchor_all_of_which_is_seen_suffices() -> None:
    assert enough([told(100, 100)] * 3)


def test_enough_of_all_features_must_be_seen() -> None:
    alive, least = 250, round(ANCHOR_SHARE * 500)
    assert enough([told(least - 80, alive), told(80, alive)])
    assert not enough([told(least - 81, alive), told(80, alive)])


def test_and_so_many_in_all() -> None:
    third = MIN_FOLLOWED // 3
    assert enough([told(third, third)] * 3)
    assert not enough([told(third, third)] * 2 + [told(third - 1, third - 1)])


def test_and_a_share_in_each_camera() -> None:
    least = round(CAMERA_SHARE * 100)
    assert enough([told(100, 100), told(100, 100), told(least, 100)])
    assert not enough([told(100, 100), told(100, 100), told(least - 1, 100)])


def test_and_the_object_must_not_have_turned_far() -> None:
    assert enough([told(100, 100)] * 3, turn=ANCHOR_TURN - 1e-6)
    assert not enough([told(100, 100)] * 3, turn=ANCHOR_TURN + 1e-6)


def test_a_camera_that_gives_images_again_takes_part_at_once() -> None:
    good = [told(100, 100)] * 2
    assert not enough([*good, told(0, 0, looks=True, follows=False)])
    assert enough([*good, told(0, 0, looks=False, follows=False)])


def test_a_camera_that_saw_nothing_is_asked_again_after_a_while() -> None:
    good = [told(100, 100)] * 2
    assert enough([*good, told(0, 0)], age=ASK_AGAIN - 1)
    assert not enough([*good, told(0, 0)], age=ASK_AGAIN)
    # One from which the object is hidden has nothing to say; one that sees it needs not be asked.
    assert enough([*good, told(0, 0, looks=False)], age=ASK_AGAIN)
    assert enough([*good, told(100, 100)], age=ASK_AGAIN)


def test_a_camera_reports_what_it_has() -> None:
    anchor = anchor_of()
    alive = anchor.alive.copy()
    alive[:7] = False
    here, region = followed_to(replace(anchor, alive=alive), picture()), np.zeros((4, 2))
    report = here.report(region)
    assert (report.found, report.alive) == (len(here), int(alive.sum()))
    assert len(here) > 0.9 * alive.sum()
    assert report.looks
    assert report.follows
    assert not here.report(None).looks
    assert not followed_to(anchor, None).report(region).looks
    assert not followed_to(replace(anchor, image=None), picture()).report(region).follows


# --- how one begins


def test_the_first_anchor_follows_the_frames_own_features() -> None:
    anchor = anchor_of(60)
    assert (anchor.number, len(anchor.tracks), anchor.alive.shape) == (5, 60, (60,))
    assert anchor.alive.sum() > 55
    np.testing.assert_array_equal(anchor.tracks.pixels[anchor.alive], grid(60)[anchor.alive])
    assert anchor.image is not None
    assert anchor.image.ndim == 2
    coloured = begin_anchor(5, anchor.frame, np.repeat(picture()[:, :, None], 3, axis=2), None)
    np.testing.assert_array_equal(coloured.alive, anchor.alive)


def test_without_an_image_nothing_is_followed() -> None:
    frame = camera_frame(features_at(grid(60)))
    anchor = begin_anchor(5, frame, None, None)
    assert anchor.image is None
    assert not anchor.alive.any()
    assert len(anchor.tracks) == 60
    assert len(followed_to(anchor, picture())) == 0


def assert_spread(chosen: FloatArray, n: int, wanted: int) -> None:
    """So many of n, no two further from each other than an even choice's."""
    assert len(chosen) == wanted
    assert chosen[0] <= n / wanted
    assert chosen[-1] >= n - 1 - np.ceil(n / wanted)
    assert np.diff(chosen).max() <= np.ceil(n / wanted)


@pytest.mark.parametrize("n", [FOLLOWED - 20, FOLLOWED + 100, 2 * FOLLOWED + 37])
def test_of_many_features_some_from_all_over_the_list_are_followed(n: int) -> None:
    anchor = anchor_of(n)
    can = np.flatnonzero(anchor.tracks.followed)
    assert len(can) > 0.9 * n
    assert not (anchor.alive & ~anchor.tracks.followed).any()
    assert_spread(np.searchsorted(can, np.flatnonzero(anchor.alive)).astype(float), len(can), min(len(can), FOLLOWED))


@pytest.mark.parametrize("followed_ones", [50, FOLLOWED - MIN_NEW + 10, 2 * FOLLOWED])
def test_the_next_goes_on_with_what_is_followed_and_begins_new_ones(followed_ones: int) -> None:
    old = anchor_of(450)
    image = picture(2.0, 1.0)
    alive = np.zeros(450, bool)
    alive[np.flatnonzero(old.tracks.followed)[: followed_ones + 20]] = True
    before = followed_to(replace(old, alive=alive), image, shifted(2.0, 1.0))
    k = len(before)
    assert 0.9 * followed_ones < k <= followed_ones + 20
    fresh = grid(450, margin=25.0)[:120]
    both = with_new(before, features_at(fresh, 1000), np.zeros(120, bool))
    anchor = begin_anchor(9, camera_frame(both), picture(50.0, 50.0), before)
    # The followed keep their order, their patches and their places, not those of any other image.
    assert anchor.number == 9
    np.testing.assert_array_equal(anchor.image, image)
    patches = before.tracks.patches
    np.testing.assert_array_equal(anchor.tracks.patches.filters[:k], patches.filters[before.rows])
    np.testing.assert_array_equal(anchor.tracks.pixels[:k], before.features.pixels)
    np.testing.assert_array_equal(anchor.tracks.warps[:k], before.tracks.warps[before.rows])
    assert anchor.alive[:k].all()
    # The others begin, here and now.
    new = begin(image, both.pixels[k:])
    np.testing.assert_array_equal(anchor.tracks.patches.filters[k:], new.patches.filters)
    assert anchor.alive[k:].sum() == min(new.followed.sum(), max(FOLLOWED - k, MIN_NEW))
    assert anchor.alive[k:].sum() >= min(MIN_NEW, int(new.followed.sum())) > 0


def test_outliers_die_and_the_old_anchor_is_as_it_was() -> None:
    anchor = anchor_of()
    followed = followed_to(anchor, picture(1.0, 0.0), shifted(1.0, 0.0))
    pair = followed.pair()
    weights = np.linspace(0.1, 1, len(pair))
    weights[[3, 8, 20]] = 0.0
    alive, pixels = anchor.alive.copy(), anchor.tracks.pixels.copy()
    after = gone_on(followed, [pair.subset(np.arange(len(pair)) < 10), pair], [weights[:10], weights])
    died = followed.rows[[3, 8, 20]]
    np.testing.assert_array_equal(np.flatnonzero(alive & ~after.alive), died)
    np.testing.assert_array_equal(anchor.alive, alive)
    np.testing.assert_array_equal(anchor.tracks.pixels, pixels)
    # It stays the anchor, whose features are elsewhere by now.
    assert (after.number, after.frame) == (anchor.number, anchor.frame)
    np.testing.assert_allclose(after.tracks.pixels[died] - pixels[died], [[1.0, 0.0]] * 3, atol=0.2)
    np.testing.assert_array_equal(after.image, picture(1.0, 0.0))
    # The dead are not looked for again.
    again = follow(after, CAMERA, shifted(1.0, 0.0), shifted(2.0, 0.0), picture(2.0, 0.0), None, RADIUS)
    assert not np.isin(died, again.rows).any()
    assert len(again) > 0.9 * after.alive.sum()


def test_where_no_image_came_the_last_one_is_kept() -> None:
    anchor = anchor_of()
    after = gone_on(followed_to(anchor, None), [], [])
    assert after.image is anchor.image
    assert after.tracks is anchor.tracks
    later = followed_to(after, picture(3.0, -2.0), shifted(3.0, -2.0))
    assert len(later) > 0.9 * anchor.alive.sum()


# --- new features beside the followed


def followed_at(pixels: FloatArray) -> Followed:
    features = features_at(pixels)
    anchor = CameraAnchor(0, camera_frame(features), begin(picture(), pixels), np.ones(len(pixels), bool), picture())
    return Followed(anchor, np.arange(len(pixels)), features, pixels, anchor.tracks, picture())


@pytest.mark.parametrize(("share", "kept"), [(0.98, False), (1.02, True)])
def test_a_new_feature_near_a_followed_one_is_the_same(share: float, kept: bool) -> None:
    known = grid(30)
    new = known[:5] + share * SAME_PX * np.array([0.6, -0.8])
    both = with_new(followed_at(known), features_at(new, 1000), np.zeros(5, bool))
    assert len(both) == (35 if kept else 30)
    np.testing.assert_array_equal(both.pixels[:30], known)
    np.testing.assert_array_equal(both.descriptors[:30, 0], np.arange(30))


def test_background_is_left_out() -> None:
    background = np.arange(60) % 3 == 0
    both = with_new(followed_at(np.empty((0, 2))), features_at(grid(60), 1000), background)
    assert both.descriptors[:, 0].tolist() == (1000 + np.flatnonzero(~background)).tolist()
    np.testing.assert_array_equal(both.pixels, grid(60)[~background])
    np.testing.assert_array_equal(both.normalized, CAMERA.normalize(both.pixels))


@pytest.mark.parametrize("known", [0, 100, FEATURES - MIN_NEW - 1, FEATURES - 1, FEATURES + 50])
def test_there_are_so_many_in_all_or_so_many_new_ones_at_least(known: int) -> None:
    apart = np.random.default_rng(0).uniform(1e4, 2e4, (known, 2))
    for n in (10, 500):
        both = with_new(followed_at(apart), features_at(grid(n), 1000), np.zeros(n, bool))
        new = both.descriptors[known:, 0].astype(float) - 1000
        wanted = max(FEATURES - known, MIN_NEW)
        assert_spread(new, n, min(n, wanted))
    none = with_new(followed_at(apart), Features.none(), np.zeros(0, bool))
    assert len(none) == known


# --- the next image


@pytest.mark.parametrize("shift", [(0.0, 0.0), (2.3, -1.6), (-4.4, 3.7)])
def test_features_are_found_where_the_image_went(shift: tuple[float, float]) -> None:
    """Also when nothing was predicted."""
    anchor = anchor_of()
    anchor = replace(anchor, alive=anchor.alive & (np.arange(60) % 3 > 0))
    for ahead in (START, shifted(*shift)):
        followed = followed_to(anchor, picture(*shift), ahead)
        assert 0.9 * anchor.alive.sum() < len(followed) <= anchor.alive.sum()
        truth = grid(60)[followed.rows]
        assert np.linalg.norm(followed.features.pixels - truth - shift, axis=1).max() < 0.2
        np.testing.assert_array_equal(followed.before, truth)
        np.testing.assert_array_equal(followed.features.descriptors[:, 0], followed.rows)
        np.testing.assert_array_equal(followed.features.normalized, CAMERA.normalize_to_grid(followed.features.pixels))
        assert (np.diff(followed.rows) > 0).all()


def test_far_away_they_are_found_by_the_prediction_alone() -> None:
    anchor, shift = anchor_of(), (23.0, -14.0)
    predicted, alone = (followed_to(anchor, picture(*shift), ahead) for ahead in (shifted(*shift), START))
    right = [np.linalg.norm(f.features.pixels - grid(60)[f.rows] - shift, axis=1) < 0.2 for f in (predicted, alone)]
    assert right[0].all()
    assert len(right[0]) > 0.8 * anchor.alive.sum()
    assert right[1].sum() < 0.1 * anchor.alive.sum()


def test_where_a_feature_was_is_known_better_than_where_its_landmark_was() -> None:
    """Landmarks that are off by 15 pixels still tell how the image of the object moves."""
    anchor, shift = anchor_of(), (23.0, -14.0)
    landmarks = anchor.frame.landmarks
    anchor.frame.table.learn(replace(landmarks, mean=landmarks.mean + np.array([15 * DEPTH / FOCAL, 0, 0])))
    followed = followed_to(anchor, picture(*shift), shifted(*shift))
    assert len(followed) > 0.8 * anchor.alive.sum()
    assert np.linalg.norm(followed.features.pixels - grid(60)[followed.rows] - shift, axis=1).max() < 0.2


def test_a_pair_is_of_the_found_and_the_anchors_features() -> None:
    followed = followed_to(anchor_of(), picture(2.0, 0.0), shifted(2.0, 0.0))
    pair = followed.pair()
    assert pair.reference == 5
    np.testing.assert_array_equal(pair.indices, np.column_stack([followed.rows, np.arange(len(followed))]))
    np.testing.assert_array_equal(pair.pixels_i, grid(60)[followed.rows])
    np.testing.assert_array_equal(pair.pixels_j, followed.features.pixels)


def test_what_is_outside_the_mask_is_dropped() -> None:
    anchor, shift = anchor_of(), (2.0, 1.0)
    mask = np.zeros(SIZE[::-1], bool)
    mask[:, :120] = True
    everywhere = followed_to(anchor, picture(*shift), shifted(*shift))
    inside = followed_to(anchor, picture(*shift), shifted(*shift), mask)
    expected = np.round(everywhere.features.pixels[:, 0]) < 120
    assert 0.2 < expected.mean() < 0.8
    np.testing.assert_array_equal(inside.rows, everywhere.rows[expected])
    np.testing.assert_array_equal(inside.features.pixels, everywhere.features.pixels[expected])
    # They are followed on, as a mask may be wrong for once.
    np.testing.assert_array_equal(inside.tracks.followed, everywhere.tracks.followed)


@pytest.mark.parametrize("missing", ["now", "before", "alive"])
def test_without_images_or_features_nothing_is_found_and_nothing_lost(missing: str) -> None:
    anchor = anchor_of()
    if missing == "before":
        anchor = replace(anchor, image=None)
    if missing == "alive":
        anchor = replace(anchor, alive=np.zeros(60, bool))
    followed = followed_to(anchor, None if missing == "now" else picture())
    assert len(followed) == len(followed.pair()) == len(followed.features) == len(followed.before) == 0
    assert followed.tracks is anchor.tracks
    assert (followed.image is None) == (missing == "now")


@pytest.mark.parametrize(("share", "found"), [(0.9, True), (1.1, False)])
def test_what_was_lost_is_looked_for_again_where_its_depth_is_known(share: float, found: bool) -> None:
    anchor = anchor_of(depth_sd=share * KNOWN_DEPTH * RADIUS)
    lost = np.zeros(60, bool)
    lost[::2] = True
    anchor = replace(anchor, tracks=anchor.tracks.keep(~lost))
    followed = followed_to(anchor, picture(3.0, 2.0), shifted(3.0, 2.0))
    again = lost[followed.rows]
    assert again.sum() == 0 if not found else again.sum() > 0.8 * (lost & anchor.alive).sum()
    assert (~again).sum() > 0.9 * (~lost & anchor.alive).sum()
    # Where it was before is not known.
    assert np.isnan(followed.before[again]).all()
    assert np.isfinite(followed.before[~again]).all()
    truth = grid(60)[followed.rows] + [3.0, 2.0]
    assert np.linalg.norm(followed.features.pixels - truth, axis=1).max() < 0.2
