"""SIFT: unbiased keypoints, unaffected by cropping; matches are mutual, distinct and one-to-one."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sylpose.features import sift
from sylpose.features.sift import (
    Features,
    detect_features,
    find_static_features,
    match_features,
    match_guided,
    reduce_image,
)
from sylpose.geometry.arrays import BoolArray, FloatArray, Image, IntArray
from sylpose.matches import Matches
from sylpose.rig import Camera
from sylpose.simulate import make_demo_scene, render_frames, ring


@pytest.fixture(scope="module")
def camera() -> Camera:
    return make_demo_scene(frames=2, size=(480, 360), n_cameras=1).rig.cameras[0]


@pytest.fixture(scope="module")
def images() -> list[Image]:
    """Two images of one camera: the block rotates by 8 degrees in front of a static room."""
    return [frame[0] for frame in render_frames(make_demo_scene(frames=2, size=(480, 360), n_cameras=1, angle_deg=8))]


def grey_of(image: Image) -> Image:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def box_mask(left: int, top: int, right: int, bottom: int) -> BoolArray:
    mask = np.zeros((360, 480), bool)
    mask[top:bottom, left:right] = True
    return mask


def random_features(n: int, rng: np.random.Generator, size: float = 400.0) -> Features:
    descriptors = rng.gamma(0.5, size=(n, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    pixels = rng.uniform(0, size, (n, 2))
    return Features(pixels, pixels / 500, descriptors)


# --- detection


def test_keypoints_depend_on_the_image_only(
    images: list[Image], camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`tests.remembered` relies on it: in other threads, in another order, with threads of OpenCV's own or none."""

    def detect(image: Image) -> Features:
        return detect_features(image, camera, box_mask(100, 80, 400, 300))

    remembered = [detect(image) for image in images]
    monkeypatch.setattr(sift, "_cv2", cv2)
    threads = cv2.getNumThreads()
    try:
        for count in (1, 4):
            cv2.setNumThreads(count)
            with ThreadPoolExecutor(2) as pool:
                found = list(pool.map(detect, [*images, *images[::-1]]))
            for new, known in zip(found, [*remembered, *remembered[::-1]], strict=True):
                for field in fields(Features):
                    np.testing.assert_array_equal(getattr(new, field.name), getattr(known, field.name))
    finally:
        cv2.setNumThreads(threads)


def test_descriptors_are_rootsift(images: list[Image], camera: Camera) -> None:
    features = detect_features(images[0], camera)
    assert len(features) > 200
    assert features.descriptors.shape == (len(features), 128)
    assert features.descriptors.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1e-5)
    assert (features.descriptors >= 0).all()
    # The squares of RootSIFT are SIFT with a sum of one.
    np.testing.assert_allclose((features.descriptors**2).sum(axis=1), 1, atol=1e-5)


def test_normalized_points_are_undistorted_pixels(images: list[Image], camera: Camera) -> None:
    features = detect_features(images[0], camera)
    np.testing.assert_array_equal(features.normalized, camera.normalize_to_grid(features.pixels))
    # On a grid of at most 1/128 pixel, with an error of at most half of that.
    off = camera.focal * np.abs(features.normalized - camera.normalize(features.pixels))
    assert 1e-5 < off.max() <= 1 / 256
    np.testing.assert_allclose(camera.denormalize(features.normalized), features.pixels, atol=1 / 256 + 1e-3)


@pytest.mark.parametrize("sigma", [2.0, 3.0, 5.0])
def test_keypoints_are_unbiased(sigma: float) -> None:
    # The center of the top-left pixel is (0, 0): by default, OpenCV's SIFT has a bias of a quarter of a pixel.
    camera, rng = ring(1, size=(320, 240)).cameras[0], np.random.default_rng(3)
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    errors = []
    for _ in range(5):
        middle = rng.uniform(60, 180, 2)
        blob = 100 + 100 * np.exp(-((u - middle[0]) ** 2 + (v - middle[1]) ** 2) / (2 * sigma**2))
        pixels = detect_features(np.rint(blob).astype(np.uint8), camera).pixels
        errors.append(pixels[np.argmin(np.linalg.norm(pixels - middle, axis=1))] - middle)
    np.testing.assert_allclose(np.mean(errors, axis=0), 0, atol=0.05)


def test_gray_and_color_are_equivalent(images: list[Image], camera: Camera) -> None:
    colour, grey = detect_features(images[0], camera), detect_features(grey_of(images[0]), camera)
    np.testing.assert_array_equal(colour.pixels, grey.pixels)
    np.testing.assert_array_equal(colour.descriptors, grey.descriptors)


def test_image_views_equal_copies(images: list[Image], camera: Camera) -> None:
    grey = grey_of(images[0])
    wide = np.zeros((360, 900), np.uint8)
    wide[:, 100:580] = grey
    np.testing.assert_array_equal(
        detect_features(wide[:, 100:580], camera).pixels, detect_features(grey, camera).pixels
    )


@pytest.mark.parametrize(
    "window", [(100, 80, 300, 250), (101, 81, 300, 250), (99, 83, 311, 240), (0, 0, 200, 180), (250, 131, 480, 360)]
)
def test_mask_preserves_keypoints_well_inside(
    images: list[Image], camera: Camera, window: tuple[int, int, int, int]
) -> None:
    left, top, right, bottom = window
    full, part = detect_features(images[0], camera), detect_features(images[0], camera, box_mask(*window))
    assert ((part.pixels >= [left - 1, top - 1]) & (part.pixels <= [right, bottom])).all()
    # A large keypoint near the border may extend over the crop's edge; this does not apply to the image's edge.
    low = [left + 24 if left else 0, top + 24 if top else 0]
    high = [right - 24 if right < 480 else 480, bottom - 24 if bottom < 360 else 360]
    inside = ((full.pixels >= low) & (full.pixels <= high)).all(axis=1)
    assert inside.sum() > 50
    gap, nearest = cKDTree(part.pixels).query(full.pixels[inside])
    same = gap < 0.02
    # SIFT halves the image repeatedly: a crop that starts at an odd pixel shifts the sampling of large keypoints.
    assert same.mean() > (0.97 if left % 4 == top % 4 == 0 else 0.8)
    # Several orientations share a position: each descriptor must be found.
    look = (full.descriptors[inside] @ part.descriptors.T).max(axis=1)
    assert (look[same] > 0.99).mean() > 0.97
    assert nearest.max() < len(part)


def test_mask_may_have_any_shape(images: list[Image], camera: Camera) -> None:
    v, u = np.mgrid[:360, :480]
    disc = (u - 240) ** 2 + (v - 180) ** 2 < 90**2
    features = detect_features(images[0], camera, disc)
    assert len(features) > 30
    assert (np.linalg.norm(features.pixels - [240, 180], axis=1) < 91).all()


def test_no_keypoints(images: list[Image], camera: Camera) -> None:
    for features in (
        detect_features(images[0], camera, np.zeros((360, 480), bool)),
        detect_features(np.zeros((360, 480, 3), np.uint8), camera),
        detect_features(np.full((360, 480), 128, np.uint8), camera),
        detect_features(images[0], camera, box_mask(200, 200, 201, 201)),
    ):
        assert len(features) <= 1
        assert features.pixels.shape == features.normalized.shape == (len(features), 2)
        assert features.descriptors.shape == (len(features), 128)


def test_number_of_features_is_bounded(images: list[Image], camera: Camera) -> None:
    # OpenCV also keeps ties with the last one.
    assert len(detect_features(images[0], camera, max_features=50)) <= 60
    assert len(detect_features(images[0], camera)) > 200


def test_detection_is_deterministic(images: list[Image], camera: Camera) -> None:
    a, b = detect_features(images[1], camera), detect_features(images[1], camera)
    np.testing.assert_array_equal(a.pixels, b.pixels)
    np.testing.assert_array_equal(a.descriptors, b.descriptors)


def test_faint_features_are_below_normal_contrast(images: list[Image], camera: Camera) -> None:
    usual = detect_features(images[0], camera, None, 4000)
    every = detect_features(images[0], camera, None, 4000, faint=True)
    assert not usual.faint.any()
    assert 0.2 * len(every) < every.faint.sum() < 0.9 * len(every)
    # Those that are not faint include all normal ones; the others are on edges.
    strong = every.subset(~every.faint)
    assert len(strong) >= len(usual)
    assert cKDTree(strong.pixels).query(usual.pixels)[0].max() < 1e-3
    faint = every.subset(every.faint)
    assert np.isin(np.round(faint.pixels, 3), np.round(usual.pixels, 3)).all(axis=1).mean() < 0.02


def test_faint_flag_is_preserved() -> None:
    features = random_features(4, np.random.default_rng(0))
    assert not features.faint.any()
    some = replace(features, faint=np.array([True, False, True, False]))
    assert some.subset(np.array([2, 1])).faint.tolist() == [True, False]
    assert Features.concatenate([features, some]).faint.tolist() == [False] * 4 + [True, False, True, False]


def test_subset_by_mask_and_index() -> None:
    features = random_features(6, np.random.default_rng(0))
    mask = np.array([True, False, True, False, False, True])
    for some in (features.subset(mask), features.subset(np.array([0, 2, 5]))):
        np.testing.assert_array_equal(some.pixels, features.pixels[[0, 2, 5]])
        np.testing.assert_array_equal(some.normalized, features.normalized[[0, 2, 5]])
        np.testing.assert_array_equal(some.descriptors, features.descriptors[[0, 2, 5]])
    assert len(Features.empty()) == len(features.subset(np.zeros(6, bool))) == 0


# --- matching


def naive_matches(a: Features, b: Features, ratio: float) -> set[tuple[int, int]]:
    """The definition, pair by pair, from distances instead of inner products."""

    def ranked(one: NDArray[np.float32], many: NDArray[np.float32]) -> list[tuple[float, int]]:
        return sorted((float(np.linalg.norm(one.astype(float) - other)), j) for j, other in enumerate(many))

    found = set()
    for i, descriptor in enumerate(a.descriptors):
        (best, j), (second, _) = ranked(descriptor, b.descriptors)[:2]
        if best <= ratio * second and ranked(b.descriptors[j], a.descriptors)[0][1] == i:
            found.add((i, j))
    return found


def noisy_copy(a: Features, rng: np.random.Generator, noise: float, extra: int) -> tuple[Features, IntArray]:
    """Return the same features, shuffled, perturbed and among others; and the new index of each."""
    order = rng.permutation(len(a))
    descriptors = a.descriptors[order] + noise * rng.standard_normal((len(a), 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    others = random_features(extra, rng)
    pixels = np.concatenate([a.pixels[order] + 3.0, others.pixels])
    return Features(pixels, pixels / 500, np.concatenate([descriptors, others.descriptors])), np.argsort(order)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    n=st.integers(2, 30),
    extra=st.integers(2, 20),
    noise=st.sampled_from([0.0, 0.03, 0.07]),
    ratio=st.sampled_from([0.6, 0.8, 1.0]),
)
def test_matching_equals_definition(seed: int, n: int, extra: int, noise: float, ratio: float) -> None:
    rng = np.random.default_rng(seed)
    a = random_features(n, rng)
    b, _ = noisy_copy(a, rng, noise, extra)
    pairs = match_features(a, b, ratio)
    assert {(i, j) for i, j in pairs.tolist()} == naive_matches(a, b, ratio)
    assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)


def test_matching_recovers_permutation() -> None:
    rng = np.random.default_rng(1)
    a = random_features(200, rng)
    b, went_to = noisy_copy(a, rng, 0.02, 100)
    pairs = match_features(a, b)
    assert len(pairs) > 190
    np.testing.assert_array_equal(pairs[:, 1], went_to[pairs[:, 0]])


def test_matching_is_symmetric_without_ratio() -> None:
    rng = np.random.default_rng(2)
    a = random_features(60, rng)
    b, _ = noisy_copy(a, rng, 0.05, 30)
    there = {(i, j) for i, j in match_features(a, b, 1.0).tolist()}
    back = {(i, j) for j, i in match_features(b, a, 1.0).tolist()}
    assert there == back


def test_image_matches_are_one_to_one_and_distinct(images: list[Image], camera: Camera) -> None:
    a, b = (detect_features(image, camera) for image in images)
    pairs = match_features(a, b)
    assert len(pairs) > 100
    assert len(np.unique(pairs[:, 0])) == len(np.unique(pairs[:, 1])) == len(pairs)
    places = np.round(np.hstack([a.pixels[pairs[:, 0]], b.pixels[pairs[:, 1]]]), 1)
    assert len(np.unique(places, axis=0)) == len(pairs)


def test_several_orientations_count_once() -> None:
    rng = np.random.default_rng(3)
    a = random_features(20, rng)
    a.pixels[5] = a.pixels[4]
    b = Features(a.pixels + 2, (a.pixels + 2) / 500, a.descriptors)
    pairs = match_features(a, b)
    assert sorted(pairs[:, 0].tolist()) == [i for i in range(20) if i != 5]


def test_distant_matches_are_dropped() -> None:
    a = random_features(30, np.random.default_rng(4))
    shift = np.linspace(0, 29, 30)
    b = Features(a.pixels + np.column_stack([shift, 0 * shift]), a.normalized, a.descriptors)
    assert match_features(a, b, max_displacement_px=10.5)[:, 0].max() == 10
    assert len(match_features(a, b)) == 30


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 5), (5, 0), (1, 5), (5, 1)])
def test_too_few_features(n: int, m: int) -> None:
    # With one candidate there is no second best, so distinctness is unknown.
    rng = np.random.default_rng(5)
    pairs = match_features(random_features(n, rng), random_features(m, rng))
    assert pairs.shape == (0, 2)
    assert np.issubdtype(pairs.dtype, np.integer)


# --- static features


def test_seen_before_requires_same_position_and_descriptor() -> None:
    rng = np.random.default_rng(6)
    earlier = random_features(40, rng)
    pixels = earlier.pixels.copy()
    pixels[10:20] += 5.0
    descriptors = earlier.descriptors.copy()
    descriptors[20:30] = random_features(10, rng).descriptors
    pixels[30:] += rng.uniform(-0.7, 0.7, (10, 2))
    expected = np.r_[np.ones(10, bool), np.zeros(20, bool), np.ones(10, bool)]
    np.testing.assert_array_equal(find_static_features(Features(pixels, pixels, descriptors), earlier), expected)


def test_seen_before_considers_all_orientations() -> None:
    earlier = random_features(3, np.random.default_rng(7))
    earlier.pixels[:] = earlier.pixels[0]
    again = earlier.subset(np.array([2]))
    assert find_static_features(again, earlier).all()


def test_seen_before_without_features() -> None:
    some = random_features(4, np.random.default_rng(8))
    assert find_static_features(Features.empty(), some).shape == (0,)
    np.testing.assert_array_equal(find_static_features(some, Features.empty()), np.zeros(4, bool))
    # Fewer than the queried neighbors.
    assert find_static_features(some, some.subset(np.array([0]))).tolist() == [True, False, False, False]


def test_room_is_seen_before_but_moving_block_is_not(images: list[Image], camera: Camera) -> None:
    first, second = (detect_features(image, camera) for image in images)
    block = np.linalg.norm(second.pixels - [240, 180], axis=1)
    before = find_static_features(second, first)
    pairs = match_features(first, second)
    moved = np.linalg.norm(first.pixels[pairs[:, 0]] - second.pixels[pairs[:, 1]], axis=1)
    of_block = pairs[moved > 4, 1]
    assert len(of_block) > 100
    # Room features may resemble the block at its new position: none with OpenCV 5, one of 236 with OpenCV 4.
    assert before[of_block].mean() < 0.01
    assert before[block > 150].mean() > 0.6


# --- matches


def test_matches_from_pixels_are_undistorted(camera: Camera) -> None:
    pixels = np.random.default_rng(9).uniform(50, 300, (2, 12, 2))
    matches = Matches.from_pixels(camera, *pixels)
    assert len(matches) == 12
    np.testing.assert_allclose(matches.x, camera.normalize(pixels[0]))
    np.testing.assert_allclose(matches.y, camera.normalize(pixels[1]))
    assert len(Matches.empty()) == 0


@pytest.mark.parametrize(
    ("x", "y", "message"),
    [
        (np.zeros((3, 2)), np.zeros((4, 2)), "got 3 and 4"),
        (np.zeros((3, 2)), np.full((3, 2), np.nan), "not finite"),
        (np.full((3, 2), np.inf), np.zeros((3, 2)), "not finite"),
    ],
)
def test_invalid_matches_are_rejected(x: FloatArray, y: FloatArray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Matches(x, y)


def test_match_where_expected_equals_brute_force() -> None:
    rng = np.random.default_rng(3)
    a = random_features(60, rng, 200.0)
    looks = a.descriptors
    order = rng.permutation(60)
    blurred = looks[order] + 0.02 * rng.random((60, 128)).astype(np.float32)
    blurred /= np.linalg.norm(blurred, axis=1, keepdims=True)
    b = Features(a.pixels[order] + rng.uniform(-3, 3, (60, 2)), a.normalized, blurred)
    ends = a.pixels[:, None] + np.array([[-8.0, 0.0], [8.0, 0.0]])
    ends[5] = np.nan
    reach, ratio, look = 4.0, 0.9, 0.5

    def candidates(i: int) -> list[int]:
        away = b.pixels - a.pixels[i]
        outside = np.hypot(np.maximum(np.abs(away[:, 0]) - 8.0, 0.0), away[:, 1])
        return np.flatnonzero(outside <= reach).tolist() if np.isfinite(ends[i]).all() else []

    near = [candidates(i) for i in range(60)]
    similar = a.descriptors @ b.descriptors.T
    wanted = []
    for i in range(60):
        if not near[i]:
            continue
        j = max(near[i], key=lambda j: similar[i, j])
        others = [similar[i, k] for k in near[i] if np.linalg.norm(b.pixels[k] - b.pixels[j]) > 3.0]
        rivals = [similar[k, j] for k in range(60) if j in near[k]]
        if similar[i, j] >= max([look, *rivals]) and 1 - similar[i, j] <= ratio**2 * (1 - max(others, default=-1.0)):
            wanted.append((i, j))
    found = match_guided(a, b, ends, reach, ratio, look)
    assert [tuple(pair) for pair in found.tolist()] == wanted
    assert len(wanted) > 40
    assert sum(order[j] == i for i, j in wanted) > 40
    # No matches without predictions, nor without candidates.
    assert len(match_guided(a, b, ends + 1000.0, reach)) == 0
    assert len(match_guided(a, Features.empty(), ends, reach)) == 0


# --- large images


def test_reduced_image_gives_the_same_features(camera: Camera, images: list[Image]) -> None:
    expected = detect_features(images[0], camera, max_pixels=50_000)
    small = reduce_image(images[0], 50_000)
    assert small.size <= 50_000
    step = np.array(camera.size) / small.shape[::-1]
    for max_pixels in (None, 50_000):
        found = detect_features(small, camera, max_pixels=max_pixels, step=step)
        np.testing.assert_array_equal(found.pixels, expected.pixels)
        np.testing.assert_array_equal(found.descriptors, expected.descriptors)
    np.testing.assert_array_equal(reduce_image(images[0], images[0].size), grey_of(images[0]))


def test_threads_share_the_memory_of_one_large_image() -> None:
    budget, used, most = sift._PixelBudget(100), 0, 0
    lock = threading.Lock()

    def process(n: int) -> None:
        nonlocal used, most
        with budget.take(n):
            with lock:
                used += n
                most = max(most, used)
            time.sleep(0.002)
            with lock:
                used -= n

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(process, [40, 60, 30, 500, 90, 10, 100, 50, 50, 20] * 3))
    assert most == 500  # that image alone
    with budget.take(100):
        pass
