"""User-defined worlds: all definitions agree, files round-trip, and invalid ones are rejected."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.io.calibration.world import World, load_world, parse_up_world, save_world, transform_rig, world_with_up
from sylpose.rig import Rig
from sylpose.simulate import arc

RIG = Rig(arc(4, 40.0, 1.5, 900.0, (1280, 960), height=0.6, distortion=(-0.1, 0.02, 0, 0, 0)).cameras, "m")
# Not symmetric, so that a transposed rotation is detected.
TURN = Rotation.from_rotvec([0.4, -1.1, 0.7])
POSE = RigidTransform.from_components([0.3, -0.2, 0.5], TURN)


def camera_centers(rig: Rig) -> FloatArray:
    return np.array([camera.center for camera in rig])


def write_world(folder: Path, text: str) -> Path:
    path = folder / "world.toml"
    path.write_text(text, encoding="utf-8")
    return path


# --- a rig in a world


def test_projections_are_unchanged_in_a_world() -> None:
    """Points and cameras transform together, also with a scale."""
    points = np.random.default_rng(0).uniform(-0.2, 0.2, (20, 3))
    for world in (World(POSE, "", "m", 1.0, "m"), World(POSE, "", "m", 1000.0, "mm"), World(POSE, "", "m", 2.5, "")):
        rig = transform_rig(RIG, world)
        assert rig.unit == world.world_unit
        assert rig.names == RIG.names
        for before, after in zip(RIG, rig, strict=True):
            moved = world.scale * POSE.apply(points)
            np.testing.assert_allclose(after.project(moved), before.project(points), atol=1e-8)


def test_world_units() -> None:
    world = World(POSE, "", "m", 1.0, "m")
    in_millimeters = transform_rig(RIG.in_unit("mm"), world)
    assert in_millimeters.unit == "mm"
    np.testing.assert_allclose(
        camera_centers(in_millimeters), 1000 * camera_centers(transform_rig(RIG, world)), rtol=1e-12
    )
    scaled = World(POSE, "", "m", 3.0, "ft")
    np.testing.assert_allclose(
        camera_centers(transform_rig(RIG.in_unit("mm"), scaled)), camera_centers(transform_rig(RIG, scaled)), rtol=1e-12
    )
    with pytest.raises(ValueError, match="defined in m, and the calibration is in an unknown unit"):
        transform_rig(Rig(RIG.cameras), world)
    nameless = World(POSE)
    np.testing.assert_allclose(
        camera_centers(transform_rig(Rig(RIG.cameras), nameless)), POSE.apply(camera_centers(RIG)), rtol=1e-12
    )


# --- files


def test_world_file_round_trip(tmp_path: Path) -> None:
    world = World(POSE, 'a "board"\nand more', "m", 0.5, "ft")
    save_world(world, tmp_path / "world.toml")
    back = load_world(tmp_path / "world.toml", RIG)
    assert (back.description, back.unit, back.scale, back.world_unit) == (world.description, "m", 0.5, "ft")
    np.testing.assert_array_equal(back.world_from_calibration.as_matrix(), POSE.as_matrix())


def test_matrices_and_quaternions_are_read(tmp_path: Path) -> None:
    matrix, quaternion = POSE.as_matrix(), TURN.as_quat().tolist()
    for given in (
        f"matrix = {matrix.tolist()}",
        f"matrix = {matrix[:3].tolist()}",
        f"quaternion = {quaternion}\ntranslation = [0.3, -0.2, 0.5]",
        f"rotation = {matrix[:3, :3].tolist()}\ntranslation = [0.3, -0.2, 0.5]",
    ):
        world = load_world(write_world(tmp_path, f'unit = "m"\n[world_from_calibration]\n{given}\n'), RIG)
        np.testing.assert_allclose(world.world_from_calibration.as_matrix(), matrix, atol=1e-12)
        assert (world.unit, world.scale, world.world_unit) == ("m", 1.0, "m")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("world_from_calibration = 3", "world_from_calibration: expected `object`, got `int`"),
        ("[world_from_calibration]", "must have a matrix"),
        ("[world_from_calibration]\nquaternion = [0, 0, 0, 1]", "must have a matrix"),
        ("[world_from_calibration]\nquaternion = [0, 0, 0, 2]\ntranslation = [0, 0, 0]", "must have length 1"),
        ("[world_from_calibration]\nquaternion = [0, 0, 1]\ntranslation = [0, 0, 0]", "the quaternion must be"),
        ("[world_from_calibration]\nmatrix = [[1, 0], [0, 1]]", "must be a 3x4 or 4x4 matrix"),
        ("[world_from_calibration]\nmatrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]]", "a reflection"),
        ("[world_from_calibration]\nmatrix = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0]]", "not a rotation matrix"),
        ("[world_from_calibration]\nmatrix = [[1, 0, 0, nan], [0, 1, 0, 0], [0, 0, 1, 0]]", "not finite"),
        ('format = "sylpose-world-9"\n[world_from_calibration]', "the format is 'sylpose-world-9'"),
        ("scale = -1\n[world_from_calibration]\nquaternion = [0, 0, 0, 1]\ntranslation = [0, 0, 0]", "scale"),
        ("[origin", "not valid TOML"),
        ("hello = 1", "'hello' is neither origin, x, xy"),
        ("[origin]\ncam_0 = [1, 2]", "x is missing"),
        ("origin = [0, 0, 0]\nx = [1, 0, 0]", "xy is missing"),
        ("origin = [0, 0, 0]\nx = [1, 0, 0]\nxy = [2, 0.01, 0]", "its points are collinear"),
        ("origin = [0, 0, 0]\nx = [0, 0, 0]\nxy = [2, 1, 0]", "two of its points coincide"),
        ("origin = [0, 0, 0]\nx = [1, 0, 0]\nxy = [0, 0, 0]", "two of its points coincide"),
        ("origin = [0, 0]\nx = [1, 0, 0]\nxy = [0, 1, 0]", "origin: three coordinates are expected"),
        ("origin = 5\nx = [1, 0, 0]\nxy = [0, 1, 0]", "origin: pixels by camera, or three coordinates"),
        ("origin = [0, 0, 0]\nx = [1, 0, 0]\n[xy]\ncam_0 = [1, 2]", "xy: pixels in at least two cameras"),
        (
            "origin = [0, 0, 0]\nx = [1, 0, 0]\n[xy]\ncam_9 = [1, 2]",
            "xy: 'cam_9' is not a camera of the calibration (cam_0",
        ),
        ("origin = [0, 0, 0]\nx = [1, 0, 0]\n[xy]\ncam_0 = [1, 2]\ncam_1 = [3]", "xy: cam_1: two pixels are expected"),
        ("distance = 0\norigin = [0, 0, 0]\nx = [1, 0, 0]\nxy = [0, 1, 0]", "distance must be a positive length"),
        (
            'distance = "2 leagues"\norigin = [0, 0, 0]\nx = [1, 0, 0]\nxy = [0, 1, 0]',
            "distance: 'leagues' is not a unit",
        ),
    ],
)
def test_invalid_worlds_are_rejected(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ValueError) as caught:  # noqa: PT011 - the message is checked below
        load_world(write_world(tmp_path, text), RIG)
    sentence = str(caught.value)
    assert said in sentence
    assert sentence.startswith(str(tmp_path / "world.toml"))
    assert sentence.isprintable()


# --- up direction


def test_up_becomes_z_and_x_stays_horizontal() -> None:
    world = parse_up_world("up=0,-2,0", "m")
    assert world is not None
    pose = world.world_from_calibration
    np.testing.assert_allclose(
        pose.rotation.apply([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15
    )
    for text in ("up=-y", " up = -y ", "up=0,-1e-3,0.0"):
        same = parse_up_world(text, "m")
        assert same is not None
        np.testing.assert_allclose(same.world_from_calibration.as_matrix(), pose.as_matrix(), atol=1e-15)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        up, origin = rng.normal(size=3), rng.normal(size=3)
        pose = world_with_up(up, origin).world_from_calibration
        np.testing.assert_allclose(
            pose.apply([origin, origin + up]), np.outer([0.0, np.linalg.norm(up)], [0, 0, 1]), atol=1e-12
        )
        x = pose.rotation.apply([1, 0, 0])
        assert abs(x[1]) < 1e-12
        assert x[0] > 0
    # x is vertical: y defines it.
    np.testing.assert_allclose(
        world_with_up([1, 0, 0]).world_from_calibration.rotation.apply([0, 1, 0]), [1, 0, 0], atol=1e-15
    )


@pytest.mark.parametrize("between", [",", " ", ", ", ";"])
def test_up_with_origin(between: str) -> None:
    world = parse_up_world(f"up=-y{between}origin=0.1, 0.2,-3e-1")
    assert world is not None
    np.testing.assert_allclose(world.world_from_calibration.apply([0.1, 0.2, -0.3]), 0, atol=1e-15)


def test_invalid_up_is_rejected() -> None:
    assert parse_up_world("chessboard:9x6,square=1") is None
    assert parse_up_world("upwards.toml") is None
    for text in ("up=", "up=1,2", "up=w", "up=1,2,3,4", "up=-y origin=1,2", "up=-y origin=1,2,3 4", "up=nan,0,1"):
        with pytest.raises(ValueError, match="is expected"):
            parse_up_world(text)
    with pytest.raises(ValueError, match="up must be a direction"):
        parse_up_world("up=0,0,0")


# --- three points


def format_pixels(
    place: FloatArray, cameras: tuple[str, ...] = RIG.names, noise: Callable[[], Any] | None = None
) -> str:
    lines = []
    for name in cameras:
        pixel = RIG[name].project(place)[0] + (0 if noise is None else noise())
        lines.append(f"{name} = {pixel.tolist()}")
    return "\n".join(lines)


def test_points_by_pixels_and_coordinates_agree(tmp_path: Path) -> None:
    true = POSE.inv().apply(np.array([[0, 0, 0], [0.3, 0, 0], [-0.1, 0.2, 0]]))
    by_hand = "".join(f"{name} = {place.tolist()}\n" for name, place in zip(("origin", "x", "xy"), true, strict=True))
    by_pixels = "".join(
        f"[{name}]\n{format_pixels(place)}\n" for name, place in zip(("origin", "x", "xy"), true, strict=True)
    )
    for text in (by_hand, by_pixels):
        world = load_world(write_world(tmp_path, text), RIG)
        np.testing.assert_allclose(world.world_from_calibration.as_matrix(), POSE.as_matrix(), atol=1e-7)
        assert (world.unit, world.scale, world.world_unit) == ("m", 1.0, "m")
    # A measured distance sets the scale.
    for distance, scale, unit in (("'600 mm'", 2000.0, "mm"), ("0.6", 2.0, "m")):
        world = load_world(write_world(tmp_path, f"distance = {distance}\n{by_hand}"), RIG)
        assert world.scale == pytest.approx(scale)
        assert world.world_unit == unit
        rig = transform_rig(RIG, world)
        np.testing.assert_allclose(camera_centers(rig), scale * POSE.apply(camera_centers(RIG)), rtol=1e-7)


def test_more_points_improve_the_plane(tmp_path: Path) -> None:
    """With manual picks, more points reduce the plane's tilt error; both are correct to the pick accuracy."""
    corners = {
        "origin": (0, 0),
        "x": (0.4, 0),
        "xy": (0, 0.3),
        "xy2": (0.4, 0.3),
        "xy3": (0.2, 0.3),
        "xy_far": (0.4, 0.15),
    }
    off: dict[int, list[float]] = {3: [], 6: []}
    for seed in range(12):
        rng = np.random.default_rng(seed)
        tables = [
            f"[{name}]\n{format_pixels(POSE.inv().apply([x, y, 0]), noise=partial(rng.normal, 0, 1.0, 2))}\n"
            for name, (x, y) in corners.items()
        ]
        for n in off:
            world = load_world(write_world(tmp_path, "".join(tables[:n])), RIG)
            z = world.world_from_calibration.rotation.inv().apply([0, 0, 1])
            off[n].append(float(np.degrees(np.arccos(min(z @ TURN.inv().apply([0, 0, 1]), 1)))))
    assert 0.02 < np.mean(off[6]) < np.mean(off[3]) < 1.0


def test_inconsistent_points_are_reported(tmp_path: Path) -> None:
    true = POSE.inv().apply(np.array([[0, 0, 0], [0.3, 0, 0], [-0.1, 0.2, 0]]))
    off = (
        f"[origin]\ncam_0 = {(RIG['cam_0'].project(true[0])[0] + [50, -60]).tolist()}\n"
        f"{format_pixels(true[0], ('cam_2',))}\n"
    )
    text = f"x = {true[1].tolist()}\nxy = {true[2].tolist()}\n{off}"
    with pytest.raises(
        ValueError, match="origin: the cameras' pixels are inconsistent; the nearest point is missed by cam_0"
    ):
        load_world(write_world(tmp_path, text), RIG)
    twin = Rig(
        [
            *RIG.cameras[:1],
            type(RIG.cameras[0])(
                "twin", *[getattr(RIG.cameras[0], k) for k in ("size", "matrix", "distortion", "camera_from_world")]
            ),
        ],
        "m",
    )
    one = f"{RIG['cam_0'].project(true[0])[0].tolist()}"
    with pytest.raises(ValueError, match="origin: cam_0, twin see it from nearly one direction"):
        load_world(
            write_world(tmp_path, f"x = [1, 0, 0]\nxy = [0, 1, 0]\n[origin]\ncam_0 = {one}\ntwin = {one}\n"), twin
        )
