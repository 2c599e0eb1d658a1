"""Followed features end up where the image went, to hundredths of a pixel, and are dropped where it does not show them."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sylpose.features.klt import HALF, Tracks, advance, begin, grey
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.simulate import demo_scene, render_frames

SIZE = (260, 200)


def texture(u: FloatArray, v: FloatArray) -> FloatArray:
    """A picture given by its formula, so that it can be moved without interpolation: waves of many directions."""
    rng = np.random.default_rng(7)
    total = np.zeros_like(u)
    for _ in range(40):
        angle, length, phase = rng.uniform(0, 2 * np.pi), rng.uniform(6, 40), rng.uniform(0, 2 * np.pi)
        total += np.sin(2 * np.pi / length * (u * np.cos(angle) + v * np.sin(angle)) + phase)
    return np.asarray(128 + 14 * total)


def picture(warp: FloatArray | None = None, shift: FloatArray | None = None) -> Image:
    """The texture carried from p to `warp` (p - middle) + middle + shift."""
    places = np.stack(np.meshgrid(np.arange(float(SIZE[0])), np.arange(float(SIZE[1]))), axis=-1)
    middle = np.array(SIZE) / 2
    back = np.linalg.inv(np.eye(2) if warp is None else warp)
    source = (places - middle - (np.zeros(2) if shift is None else shift)) @ back.T + middle
    return np.clip(np.rint(texture(source[..., 0], source[..., 1])), 0, 255).astype(np.uint8)


def spread(n: int = 60, margin: float = 45.0, seed: int = 0) -> FloatArray:
    """Places (n, 2) all over the picture."""
    return np.random.default_rng(seed).uniform(margin, np.array(SIZE) - margin, (n, 2))


def errors(tracks: Tracks, truth: FloatArray) -> FloatArray:
    assert np.isnan(tracks.pixels[~tracks.followed]).all()
    return np.asarray(np.linalg.norm(tracks.pixels - truth, axis=1)[tracks.followed])


# --- precision


@settings(max_examples=10)
@given(du=st.floats(-6, 6), dv=st.floats(-6, 6))
def test_a_shift_is_recovered(du: float, dv: float) -> None:
    shift, pixels = np.array([du, dv]), spread()
    tracks = advance(begin(picture(), pixels), picture(), picture(shift=shift))
    assert tracks.followed.mean() > 0.9
    assert np.median(errors(tracks, pixels + shift)) < 0.02
    assert np.quantile(errors(tracks, pixels + shift), 0.9) < 0.05
    # No bias: the centre of the top-left pixel is (0, 0) before and after.
    np.testing.assert_allclose(np.nanmean(tracks.pixels - pixels - shift, axis=0), 0, atol=0.01)


@pytest.mark.parametrize("turn", [-8.0, 5.0])
@pytest.mark.parametrize("stretch", [(1.0, 1.0), (0.85, 1.0), (1.1, 1.1)])
def test_an_affine_warp_is_recovered(turn: float, stretch: tuple[float, float]) -> None:
    c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
    warp = np.array([[c, -s], [s, c]]) @ np.diag(stretch)
    pixels, middle = spread(), np.array(SIZE) / 2
    truth = (pixels - middle) @ warp.T + middle
    guess = truth + np.random.default_rng(1).uniform(-1, 1, truth.shape)
    tracks = advance(begin(picture(), pixels), picture(), picture(warp), guess)
    assert tracks.followed.mean() > 0.85
    assert np.median(errors(tracks, truth)) < 0.03
    np.testing.assert_allclose(np.median(tracks.warps[tracks.followed], axis=0), warp, atol=0.005)


def test_errors_do_not_add_up() -> None:
    pixels, middle = spread(), np.array(SIZE) / 2
    tracks, previous = begin(picture(), pixels), picture()
    for k in range(1, 16):
        warp = np.diag([1 - 0.015 * k, 1.0])  # as a surface that turns away
        current = picture(warp)
        tracks, previous = advance(tracks, previous, current), current
    truth = (pixels - middle) @ warp.T + middle
    assert tracks.followed.mean() > 0.85
    assert np.median(errors(tracks, truth)) < 0.03


@pytest.mark.parametrize(("gain", "bias"), [(0.8, 0.0), (0.8, 40.0), (1.0, -20.0)])
def test_brightness_and_contrast_do_not_matter(gain: float, bias: float) -> None:
    image, pixels, shift = picture(), spread(), np.array([1.3, -0.6])
    calm = np.clip(0.5 * image + 60, 0, 255).astype(np.uint8)  # leaves room on both sides
    moved = 0.5 * picture(shift=shift) + 60
    lit = np.clip(np.rint(gain * moved + bias), 0, 255).astype(np.uint8)
    tracks = advance(begin(calm, pixels), calm, lit, pixels + shift)
    assert tracks.followed.mean() > 0.85
    assert np.median(errors(tracks, pixels + shift)) < 0.05


def test_a_guess_bridges_a_large_motion() -> None:
    pixels, shift = spread(margin=60), np.array([31.4, -22.7])
    start, image, moved = begin(picture(), pixels), picture(), picture(shift=shift)
    off = np.random.default_rng(2).uniform(-2, 2, pixels.shape)
    tracks = advance(start, image, moved, pixels + shift + off)
    assert tracks.followed.mean() > 0.9
    assert np.median(errors(tracks, pixels + shift)) < 0.02
    assert advance(start, image, moved).followed.mean() < 0.2


def test_a_rendered_block_is_followed() -> None:
    whole = demo_scene(frames=40, size=(480, 360), n_cameras=1, turn_deg=60)
    scene = replace(whole, frames=4)
    frames = [grey(images[0]) for images in render_frames(scene)]
    camera, poses, body = scene.rig.cameras[0], scene.poses(), scene.actors[0].body
    # The faces that are seen best and are large enough for a patch in their middle to lie on one plane.
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
    tracks = begin(frames[0], camera.project(poses[0].apply(body_points)))
    for k in range(1, 4):
        tracks = advance(tracks, frames[k - 1], frames[k])
    assert tracks.followed.mean() > 0.8
    assert np.median(errors(tracks, camera.project(poses[3].apply(body_points)))) < 0.1


# --- what is dropped


def test_plain_ground_is_not_followed() -> None:
    flat = np.full(SIZE[::-1], 90, np.uint8)
    assert not begin(flat, spread()).followed.any()
    noisy = np.clip(flat + np.random.default_rng(0).normal(0, 1.0, flat.shape), 0, 255).astype(np.uint8)
    assert begin(noisy, spread()).followed.mean() < 0.05
    edge = flat.copy()
    edge[:, 130:] = 200  # a straight edge leaves the place along it open
    on_edge = np.array([[130.0, 60.0], [129.5, 100.0]])
    assert not begin(edge, on_edge).followed.any()
    assert not advance(begin(edge, on_edge), edge, edge, on_edge).followed.any()  # nor if it is looked for


def test_an_occluded_feature_is_dropped_and_found_again() -> None:
    image, pixels = picture(), spread()
    covered = image.copy()
    covered[:, :130] = picture(shift=np.array([61.0, 47.0]))[:, :130]  # as much texture, but another
    hidden, clear = pixels[:, 0] < 130 - HALF, pixels[:, 0] > 130 + HALF
    tracks = advance(begin(image, pixels), image, covered)
    assert tracks.followed[hidden].mean() < 0.1
    assert tracks.followed[clear].all()
    np.testing.assert_allclose(tracks.pixels[clear], pixels[clear], atol=0.02)
    tracks = tracks.keep(~hidden)
    assert not advance(tracks, covered, image).followed[hidden].any()  # nobody says where to look
    again = advance(tracks, covered, image, pixels + 0.5)
    assert again.followed[hidden].mean() > 0.9
    np.testing.assert_allclose(again.pixels[again.followed], pixels[again.followed], atol=0.03)


def test_what_leaves_the_image_is_dropped() -> None:
    shift = np.array([5.0, 0.0])
    pixels = np.column_stack([np.arange(200.0, SIZE[0]), np.full(SIZE[0] - 200, 100.0)])
    tracks = advance(begin(picture(), pixels), picture(), picture(shift=shift))
    rim = SIZE[0] - 1 - HALF
    assert not tracks.followed[pixels[:, 0] + shift[0] > rim + 1].any()
    assert tracks.followed[pixels[:, 0] + shift[0] < rim - 1].mean() > 0.9
    # Patches that were not whole at the keyframe are not followed either, wherever it is.
    corners = np.array([[0.0, 0.0], [3.0, 100.0], [SIZE[0] - 1.0, SIZE[1] - 1.0], [-50.0, 20.0], [1e9, 1e9]])
    assert not begin(picture(), corners).followed.any()


@pytest.mark.parametrize("place", [(-1000.0, 50.0), (1e12, -1e12), (np.inf, 3.0), (np.nan, np.nan)])
def test_a_guess_outside_the_image_harms_only_its_feature(place: tuple[float, float]) -> None:
    pixels = spread(20)
    guess = pixels.copy()
    guess[0] = place
    tracks = advance(begin(picture(), pixels), picture(), picture(), guess)
    assert tracks.followed[1:].all()
    assert tracks.followed[0] == (not np.isfinite(place).all())  # without a guess, the place before is one


def test_outliers_are_lost_by_hand() -> None:
    tracks = begin(picture(), spread(10))
    mask = np.arange(10) > 3
    kept = tracks.keep(mask)
    np.testing.assert_array_equal(kept.followed, mask)
    assert np.isnan(kept.pixels[:4]).all()
    np.testing.assert_array_equal(kept.pixels[4:], tracks.pixels[4:])


# --- input


def test_colour_and_grey_are_the_same() -> None:
    image = picture()
    colour = cv2.merge([image, image, image])
    np.testing.assert_array_equal(grey(np.asarray(colour, dtype=np.uint8)), image)
    assert grey(image[::2, ::2]).flags.c_contiguous


def test_a_cut_out_gives_the_same() -> None:
    # The area around the features is looked at, whatever the size of the image.
    pixels, shift = spread(margin=70), np.array([1.4, 2.2])
    images = [picture(), picture(shift=shift)]
    whole = advance(begin(images[0], pixels), *images)
    corner = np.array([20, 15])
    parts = [image[corner[1] : -10, corner[0] : -12] for image in images]
    cut = advance(begin(parts[0], pixels - corner), parts[0], parts[1])
    np.testing.assert_array_equal(cut.followed, whole.followed)
    np.testing.assert_allclose(cut.pixels + corner, whole.pixels, atol=0.01)


def test_nothing_to_follow() -> None:
    image = picture()
    for empty in (np.empty((0, 2)), np.empty(0)):
        tracks = advance(begin(image, empty), image, image, empty)
        assert len(tracks) == len(tracks.patches) == 0
        assert tracks.pixels.shape == (0, 2)
    lost = begin(image, spread(5)).keep(np.zeros(5, bool))
    assert not advance(lost, image, image).followed.any()
    tiny = image[:5, :5]
    assert not advance(begin(tiny, [[2.0, 2.0]]), tiny, tiny).followed.any()


def test_inputs_are_left_as_they_are() -> None:
    image, pixels = picture(), spread(20)
    tracks, guess = begin(image, pixels), pixels + 0.3
    before, asked = (tracks.pixels.copy(), tracks.warps.copy()), guess.copy()
    advance(tracks, image, picture(np.diag([0.98, 1.0])), guess)
    np.testing.assert_array_equal(tracks.pixels, before[0])
    np.testing.assert_array_equal(tracks.warps, before[1])
    np.testing.assert_array_equal(guess, asked)


def test_bad_input_is_named() -> None:
    image, pixels = picture(), spread(5)
    tracks = begin(image, pixels)
    for wrong in (image.astype(float), np.zeros((4, 5, 2), np.uint8), np.zeros((0, 5), np.uint8)):
        with pytest.raises(ValueError, match="an image must be uint8"):
            grey(wrong)
    with pytest.raises(ValueError, match="image: must be a grey image"):
        begin(np.zeros((9, 9, 3), np.uint8), pixels)
    with pytest.raises(ValueError, match="current: must be a grey image"):
        advance(tracks, image, image.astype(np.float32))
    with pytest.raises(ValueError, match="of one camera must have one size"):
        advance(tracks, image, image[:-1])
    with pytest.raises(ValueError, match=r"pixels: must be \(n, 2\)"):
        begin(image, np.zeros((3, 3)))
    with pytest.raises(ValueError, match="pixels: those of a keyframe must be finite"):
        begin(image, [[np.nan, 3.0]])
    with pytest.raises(ValueError, match="guess: 4 places for 5 features"):
        advance(tracks, image, image, pixels[:4])
