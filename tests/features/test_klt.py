"""KLT: tracked features reach their true positions to hundredths of a pixel; invisible ones are dropped."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sylpose.features.klt import PATCH_RADIUS, Tracks, start_tracks, to_gray, track_features
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.simulate import make_demo_scene, render_frames

SIZE = (260, 200)


def texture(u: FloatArray, v: FloatArray) -> FloatArray:
    """An analytic image, so that it can be warped without interpolation: waves of many directions."""
    rng = np.random.default_rng(7)
    total = np.zeros_like(u)
    for _ in range(40):
        angle, length, phase = rng.uniform(0, 2 * np.pi), rng.uniform(6, 40), rng.uniform(0, 2 * np.pi)
        total += np.sin(2 * np.pi / length * (u * np.cos(angle) + v * np.sin(angle)) + phase)
    return np.asarray(128 + 14 * total)


def warp_texture(warp: FloatArray | None = None, shift: FloatArray | None = None) -> Image:
    """The texture carried from p to `warp` (p - middle) + middle + shift."""
    places = np.stack(np.meshgrid(np.arange(float(SIZE[0])), np.arange(float(SIZE[1]))), axis=-1)
    middle = np.array(SIZE) / 2
    back = np.linalg.inv(np.eye(2) if warp is None else warp)
    source = (places - middle - (np.zeros(2) if shift is None else shift)) @ back.T + middle
    return np.clip(np.rint(texture(source[..., 0], source[..., 1])), 0, 255).astype(np.uint8)


def spread_points(n: int = 60, margin: float = 45.0, seed: int = 0) -> FloatArray:
    """Return positions (n, 2) across the image."""
    return np.random.default_rng(seed).uniform(margin, np.array(SIZE) - margin, (n, 2))


def errors(tracks: Tracks, truth: FloatArray) -> FloatArray:
    assert np.isnan(tracks.pixels[~tracks.tracked]).all()
    return np.asarray(np.linalg.norm(tracks.pixels - truth, axis=1)[tracks.tracked])


# --- precision


@settings(max_examples=10)
@given(du=st.floats(-6, 6), dv=st.floats(-6, 6))
def test_translation_is_recovered(du: float, dv: float) -> None:
    shift, pixels = np.array([du, dv]), spread_points()
    tracks = track_features(start_tracks(warp_texture(), pixels), warp_texture(), warp_texture(shift=shift))
    assert tracks.tracked.mean() > 0.9
    assert np.median(errors(tracks, pixels + shift)) < 0.02
    assert np.quantile(errors(tracks, pixels + shift), 0.9) < 0.05
    # No bias: the center of the top-left pixel is (0, 0) before and after.
    np.testing.assert_allclose(np.nanmean(tracks.pixels - pixels - shift, axis=0), 0, atol=0.01)


@pytest.mark.parametrize("turn", [-8.0, 5.0])
@pytest.mark.parametrize("stretch", [(1.0, 1.0), (0.85, 1.0), (1.1, 1.1)])
def test_affine_warp_is_recovered(turn: float, stretch: tuple[float, float]) -> None:
    c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
    warp = np.array([[c, -s], [s, c]]) @ np.diag(stretch)
    pixels, middle = spread_points(), np.array(SIZE) / 2
    truth = (pixels - middle) @ warp.T + middle
    guess = truth + np.random.default_rng(1).uniform(-1, 1, truth.shape)
    tracks = track_features(start_tracks(warp_texture(), pixels), warp_texture(), warp_texture(warp), guess)
    assert tracks.tracked.mean() > 0.85
    assert np.median(errors(tracks, truth)) < 0.03
    np.testing.assert_allclose(np.median(tracks.warps[tracks.tracked], axis=0), warp, atol=0.005)


def test_errors_do_not_accumulate() -> None:
    pixels, middle = spread_points(), np.array(SIZE) / 2
    tracks, previous = start_tracks(warp_texture(), pixels), warp_texture()
    for k in range(1, 16):
        warp = np.diag([1 - 0.015 * k, 1.0])  # like a surface rotating away
        current = warp_texture(warp)
        tracks, previous = track_features(tracks, previous, current), current
    truth = (pixels - middle) @ warp.T + middle
    assert tracks.tracked.mean() > 0.85
    assert np.median(errors(tracks, truth)) < 0.03


@pytest.mark.parametrize(("gain", "bias"), [(0.8, 0.0), (0.8, 40.0), (1.0, -20.0)])
def test_invariant_to_brightness_and_contrast(gain: float, bias: float) -> None:
    image, pixels, shift = warp_texture(), spread_points(), np.array([1.3, -0.6])
    calm = np.clip(0.5 * image + 60, 0, 255).astype(np.uint8)  # leaves headroom on both sides
    moved = 0.5 * warp_texture(shift=shift) + 60
    lit = np.clip(np.rint(gain * moved + bias), 0, 255).astype(np.uint8)
    tracks = track_features(start_tracks(calm, pixels), calm, lit, pixels + shift)
    assert tracks.tracked.mean() > 0.85
    assert np.median(errors(tracks, pixels + shift)) < 0.05


def test_guess_enables_large_motion() -> None:
    pixels, shift = spread_points(margin=60), np.array([31.4, -22.7])
    start, image, moved = start_tracks(warp_texture(), pixels), warp_texture(), warp_texture(shift=shift)
    off = np.random.default_rng(2).uniform(-2, 2, pixels.shape)
    tracks = track_features(start, image, moved, pixels + shift + off)
    assert tracks.tracked.mean() > 0.9
    assert np.median(errors(tracks, pixels + shift)) < 0.02
    assert track_features(start, image, moved).tracked.mean() < 0.2


def test_motion_may_grow_with_the_image_size() -> None:
    # An image of 2080x1600 pixels shows more detail than one of 260x200; its motion of 5 pixels becomes one of 40.
    scale, pixels, shift = 8, spread_points(margin=50), np.array([4, -3])
    noise = np.random.default_rng(3).normal(0.0, 60.0, (SIZE[1] * scale, SIZE[0] * scale))
    detail = cv2.GaussianBlur(noise, (0, 0), 1.5)
    large = []
    for moved in (np.zeros(2, int), shift):
        coarse = cv2.resize(warp_texture(shift=moved).astype(float), None, fx=scale, fy=scale)
        image = 0.6 * coarse + np.roll(detail, scale * moved[::-1], axis=(0, 1))
        large.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    start, guess = start_tracks(large[0], scale * pixels), scale * (pixels + 0.5 * shift)
    tracks = track_features(start, large[0], large[1], guess)
    assert tracks.tracked.mean() > 0.9
    assert np.median(errors(tracks, scale * (pixels + shift))) < 0.05


def test_small_object_in_large_image_is_tracked_as_in_its_crop() -> None:
    # The windows of the coarsest level are not wider than the object, whatever surrounds it.
    pixels, shift = np.array([130, 100]) + np.random.default_rng(1).uniform(-20, 20, (30, 2)), np.array([1.4, 2.2])
    images = [warp_texture(), warp_texture(shift=shift)]
    alone = track_features(start_tracks(images[0], pixels), *images)
    corner, large = np.array([1500, 900]), []
    for image in images:
        canvas = np.full((1900, 2600), 128, np.uint8)
        canvas[corner[1] : corner[1] + SIZE[1], corner[0] : corner[0] + SIZE[0]] = image
        large.append(canvas)
    tracks = track_features(start_tracks(large[0], pixels + corner), *large)
    np.testing.assert_array_equal(tracks.tracked, alone.tracked)
    np.testing.assert_allclose(tracks.pixels - corner, alone.pixels, atol=0.01)


def test_rendered_block_is_tracked() -> None:
    whole = make_demo_scene(frames=40, size=(480, 360), n_cameras=1, angle_deg=60)
    scene = replace(whole, frames=4)
    frames = [to_gray(images[0]) for images in render_frames(scene)]
    camera, poses, body = scene.rig.cameras[0], scene.object_poses(), scene.actors[0].body
    # The faces seen best, and large enough that a patch in their center is planar.
    centres = np.array([body.vertices[face].mean(axis=0) for face in body.faces])
    view = camera.center - poses[0].apply(centres)
    facing = np.einsum("ni,ni->n", poses[0].rotation.apply(body.normals), view) / np.linalg.norm(view, axis=1)
    large = np.array([min(t.shape[:2]) for t in body.textures]) > 40
    faces = np.flatnonzero((facing > 0.5) & large)
    texels = np.array([[u, v, 1.0] for u in (-12, -4, 4, 12) for v in (-12, -4, 4, 12)])
    points = []
    for face in faces:
        middle = np.array([*(np.array(body.textures[face].shape[1::-1]) / 2), 0.0])
        points.append((texels + middle) @ body.plane_from_texture[face].T)
    body_points = np.concatenate(points)
    tracks = start_tracks(frames[0], camera.project(poses[0].apply(body_points)))
    for k in range(1, 4):
        tracks = track_features(tracks, frames[k - 1], frames[k])
    assert tracks.tracked.mean() > 0.8
    assert np.median(errors(tracks, camera.project(poses[3].apply(body_points)))) < 0.1


# --- what is dropped


def test_textureless_features_are_not_tracked() -> None:
    flat = np.full(SIZE[::-1], 90, np.uint8)
    assert not start_tracks(flat, spread_points()).tracked.any()
    noisy = np.clip(flat + np.random.default_rng(0).normal(0, 1.0, flat.shape), 0, 255).astype(np.uint8)
    assert start_tracks(noisy, spread_points()).tracked.mean() < 0.05
    edge = flat.copy()
    edge[:, 130:] = 200  # the position along a straight edge is undetermined
    on_edge = np.array([[130.0, 60.0], [129.5, 100.0]])
    assert not start_tracks(edge, on_edge).tracked.any()
    assert not track_features(start_tracks(edge, on_edge), edge, edge, on_edge).tracked.any()  # nor with a guess


def test_occluded_feature_is_dropped_and_recovered() -> None:
    image, pixels = warp_texture(), spread_points()
    covered = image.copy()
    covered[:, :130] = warp_texture(shift=np.array([61.0, 47.0]))[:, :130]  # a different texture of the same strength
    hidden, clear = pixels[:, 0] < 130 - PATCH_RADIUS, pixels[:, 0] > 130 + PATCH_RADIUS
    tracks = track_features(start_tracks(image, pixels), image, covered)
    assert tracks.tracked[hidden].mean() < 0.1
    assert tracks.tracked[clear].all()
    np.testing.assert_allclose(tracks.pixels[clear], pixels[clear], atol=0.02)
    tracks = tracks.keep(~hidden)
    assert not track_features(tracks, covered, image).tracked[hidden].any()  # without a guess
    again = track_features(tracks, covered, image, pixels + 0.5)
    assert again.tracked[hidden].mean() > 0.9
    np.testing.assert_allclose(again.pixels[again.tracked], pixels[again.tracked], atol=0.03)


def test_features_leaving_the_image_are_dropped() -> None:
    shift = np.array([5.0, 0.0])
    pixels = np.column_stack([np.arange(200.0, SIZE[0]), np.full(SIZE[0] - 200, 100.0)])
    tracks = track_features(start_tracks(warp_texture(), pixels), warp_texture(), warp_texture(shift=shift))
    rim = SIZE[0] - 1 - PATCH_RADIUS
    assert not tracks.tracked[pixels[:, 0] + shift[0] > rim + 1].any()
    assert tracks.tracked[pixels[:, 0] + shift[0] < rim - 1].mean() > 0.9
    # Patches that were incomplete in the template frame are not tracked, whatever the guess.
    corners = np.array([[0.0, 0.0], [3.0, 100.0], [SIZE[0] - 1.0, SIZE[1] - 1.0], [-50.0, 20.0], [1e9, 1e9]])
    assert not start_tracks(warp_texture(), corners).tracked.any()


@pytest.mark.parametrize("place", [(-1000.0, 50.0), (1e12, -1e12), (np.inf, 3.0), (np.nan, np.nan)])
def test_guess_outside_image_affects_only_its_feature(place: tuple[float, float]) -> None:
    pixels = spread_points(20)
    guess = pixels.copy()
    guess[0] = place
    tracks = track_features(start_tracks(warp_texture(), pixels), warp_texture(), warp_texture(), guess)
    assert tracks.tracked[1:].all()
    assert tracks.tracked[0] == (not np.isfinite(place).all())  # the fallback is the previous position


def test_keep_drops_outliers() -> None:
    tracks = start_tracks(warp_texture(), spread_points(10))
    mask = np.arange(10) > 3
    kept = tracks.keep(mask)
    np.testing.assert_array_equal(kept.tracked, mask)
    assert np.isnan(kept.pixels[:4]).all()
    np.testing.assert_array_equal(kept.pixels[4:], tracks.pixels[4:])


# --- input


def test_color_and_gray_are_equivalent() -> None:
    image = warp_texture()
    colour = cv2.merge([image, image, image])
    np.testing.assert_array_equal(to_gray(np.asarray(colour, dtype=np.uint8)), image)
    assert to_gray(image[::2, ::2]).flags.c_contiguous


def test_crop_gives_same_tracks() -> None:
    # Only the area around the features is processed, whatever the image size.
    pixels, shift = spread_points(margin=70), np.array([1.4, 2.2])
    images = [warp_texture(), warp_texture(shift=shift)]
    whole = track_features(start_tracks(images[0], pixels), *images)
    corner = np.array([20, 15])
    parts = [image[corner[1] : -10, corner[0] : -12] for image in images]
    cut = track_features(start_tracks(parts[0], pixels - corner), parts[0], parts[1])
    np.testing.assert_array_equal(cut.tracked, whole.tracked)
    np.testing.assert_allclose(cut.pixels + corner, whole.pixels, atol=0.01)


def test_no_features() -> None:
    image = warp_texture()
    for empty in (np.empty((0, 2)), np.empty(0)):
        tracks = track_features(start_tracks(image, empty), image, image, empty)
        assert len(tracks) == len(tracks.filters) == 0
        assert tracks.pixels.shape == (0, 2)
    lost = start_tracks(image, spread_points(5)).keep(np.zeros(5, bool))
    assert not track_features(lost, image, image).tracked.any()
    tiny = image[:5, :5]
    assert not track_features(start_tracks(tiny, [[2.0, 2.0]]), tiny, tiny).tracked.any()


def test_inputs_are_not_modified() -> None:
    image, pixels = warp_texture(), spread_points(20)
    tracks, guess = start_tracks(image, pixels), pixels + 0.3
    before, arguments = (tracks.pixels.copy(), tracks.warps.copy()), guess.copy()
    track_features(tracks, image, warp_texture(np.diag([0.98, 1.0])), guess)
    np.testing.assert_array_equal(tracks.pixels, before[0])
    np.testing.assert_array_equal(tracks.warps, before[1])
    np.testing.assert_array_equal(guess, arguments)


def test_invalid_input_is_rejected() -> None:
    image, pixels = warp_texture(), spread_points(5)
    tracks = start_tracks(image, pixels)
    for wrong in (image.astype(float), np.zeros((4, 5, 2), np.uint8), np.zeros((0, 5), np.uint8)):
        with pytest.raises(ValueError, match="an image must be uint8"):
            to_gray(wrong)
    with pytest.raises(ValueError, match="image: must be a gray image"):
        start_tracks(np.zeros((9, 9, 3), np.uint8), pixels)
    with pytest.raises(ValueError, match="current: must be a gray image"):
        track_features(tracks, image, image.astype(np.float32))
    with pytest.raises(ValueError, match="of one camera must have the same size"):
        track_features(tracks, image, image[:-1])
    with pytest.raises(ValueError, match=r"pixels: must be \(n, 2\)"):
        start_tracks(image, np.zeros((3, 3)))
    with pytest.raises(ValueError, match="pixels: must be finite in a template frame"):
        start_tracks(image, [[np.nan, 3.0]])
    with pytest.raises(ValueError, match="guess: 4 positions for 5 features"):
        track_features(tracks, image, image, pixels[:4])
