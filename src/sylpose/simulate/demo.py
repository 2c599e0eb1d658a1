"""Demo sequence: a textured block rotates and drifts in front of a rig; written as a session with ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig, intersect_rays
from sylpose.simulate.recording_files import (
    FRAME_RATE,
    create_session_folder,
    write_boxes,
    write_ground_truth,
    write_videos,
)
from sylpose.simulate.render import Actor, Scene, chamfered_box, render_frames
from sylpose.simulate.rigs import arc

__all__ = ["DemoTruth", "compute_demo_truth", "make_demo_scene", "render_sequence", "write_sequence"]


# The block's longest side, as a share of the image's shorter side.
OBJECT_SHARE = 0.45
# Lens distortion, assigned to the cameras cyclically: mild barrel distortion, as of webcams.
LENS_DISTORTIONS = (
    (-0.11, 0.03, 0.0004, -0.0003, 0),
    (-0.08, 0.01, -0.0005, 0.0002, 0),
    (-0.13, 0.04, 0.0002, 0.0006, 0),
)


@dataclass(frozen=True, eq=False)
class DemoTruth:
    """Ground truth of a rendered sequence.

    Attributes:
        rig: the cameras.
        times: (n,) seconds.
        world_from_object: (n,) poses; the object's frame has the world's axes in the first frame and its origin at the
            body's center.
        vertices: (v, 3) the body's corners in the object's frame.
        boxes: the object's box in the first frame per camera: x, y, width, height in pixels; only for cameras in which
            it is visible.
    """

    rig: Rig
    times: FloatArray
    world_from_object: RigidTransform
    vertices: FloatArray
    boxes: dict[str, tuple[int, int, int, int]]


def make_demo_scene(
    *,
    rig: Rig | None = None,
    frames: int = 60,
    angle_deg: float = 90.0,
    seed: int = 0,
    size: tuple[int, int] = (640, 480),
    n_cameras: int = 4,
    other_actors: Sequence[Actor] = (),
    noise: float = 1.5,
    exposure: float = 0.0,
) -> Scene:
    """Build the demo scene: a textured block that rotates about a tilted axis, wobbles and drifts by about its size.

    Args:
        rig: None: an arc of `n_cameras` over 120 degrees at alternating heights, with lens distortion and images of
            `size`. The cameras of any other rig should look at one point; the block is placed there, as large as fits
            the images.
        frames: number of frames, at 30 per second.
        angle_deg: total rotation angle, degrees.
        seed: seed of textures, background and noise.
        size: (width, height) of the images, pixels.
        n_cameras: number of cameras of the default rig.
        other_actors: bodies that move differently: distractors, occluders.
        noise, exposure: as in `Scene`.

    Returns:
        The scene; its first actor is the block.

    Raises:
        ValueError: there are no frames, the size is under 64 pixels, or the rig does not look at one point.
    """
    if frames < 1:
        raise ValueError(f"a sequence needs at least one frame, got {frames}")
    rig = _make_demo_rig(n_cameras, size) if rig is None else rig
    rng = np.random.default_rng(seed)
    target = intersect_rays([c.center for c in rig], [c.direction for c in rig])
    if len(rig) == 1:  # a single axis has no nearest point: use one unit of length in front of the camera
        target = rig.cameras[0].center + rig.cameras[0].direction
    depths = np.array([camera.camera_from_world.apply(target)[2] for camera in rig])
    if (depths <= 0).any():
        raise ValueError(f"camera {rig.names[int(np.argmin(depths))]} does not look at the point the others look at")
    pixels_per_unit = np.array([camera.focal for camera in rig]) / depths
    span = OBJECT_SHARE * float(np.min([min(camera.size) for camera in rig] / pixels_per_unit))
    body = chamfered_box(span * np.array([1.0, 0.74, 0.86]), 1.25 * float(pixels_per_unit.max()), seed=seed)
    axis = Rotation.from_rotvec(rng.normal(0, 0.1, 3)).apply([0.25, 0.9, 0.35])
    axis = axis / np.linalg.norm(axis)
    drift = span * Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix()

    def path(frame: float) -> RigidTransform:
        s = frame / max(frames - 1, 1)
        wave, arch = np.sin(2 * np.pi * s), np.sin(np.pi * s)
        # The wobble is zero at both ends: the total rotation angle is exactly `angle_deg`.
        wobble = Rotation.from_rotvec(np.deg2rad(6) * np.array([wave, 0.3 * arch, -arch]))
        turn = Rotation.from_rotvec(np.deg2rad(angle_deg) * (s - 0.06 * wave) * axis)
        return RigidTransform.from_components(
            target + drift @ np.array([0.7 * s - 0.35, 0.16 * wave, 0.45 * arch - 0.2]), wobble * turn
        )

    return Scene(rig, (Actor(body, path), *other_actors), frames, seed, noise, exposure)


def compute_demo_truth(scene: Scene) -> DemoTruth:
    """Compute the ground truth of a scene at 30 frames per second."""
    poses = scene.object_poses()
    first = poses[0]
    # A path may start with any rotation; the object's frame has the world's axes in the first frame.
    vertices = first.rotation.apply(scene.actors[0].body.vertices)
    world_from_object = poses * RigidTransform.from_rotation(first.rotation.inv())
    boxes = {}
    for camera in scene.rig:
        corners = camera.project(world_from_object[0].apply(vertices))
        low = np.maximum(np.floor(corners.min(axis=0)), 0)
        high = np.minimum(np.ceil(corners.max(axis=0)) + 1, camera.size)
        if (high > low).all():  # false for NaN, too
            boxes[camera.name] = (int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1]))
    return DemoTruth(scene.rig, np.arange(scene.frames) / FRAME_RATE, world_from_object, vertices, boxes)


def render_sequence(
    out_dir: str | Path,
    *,
    rig: Rig | None = None,
    frames: int = 60,
    angle_deg: float = 90.0,
    seed: int = 0,
    size: tuple[int, int] = (640, 480),
    n_cameras: int = 4,
    boxes: bool = False,
) -> DemoTruth:
    """Render `make_demo_scene` with these arguments and write it with `write_sequence`.

    Args:
        out_dir: output folder, as in `write_sequence`.
        rig, frames, angle_deg, seed, size, n_cameras: as in `make_demo_scene`.
        boxes: as in `write_sequence`.

    Returns:
        The ground truth.
    """
    scene = make_demo_scene(rig=rig, frames=frames, angle_deg=angle_deg, seed=seed, size=size, n_cameras=n_cameras)
    return write_sequence(out_dir, scene, boxes=boxes)


def write_sequence(out_dir: str | Path, scene: Scene, *, boxes: bool = False) -> DemoTruth:
    """Render a scene and write it as a session with ground truth.

    Files: one video per camera (`cam_0.mp4`, ...), `calibration.toml`, `groundtruth.tum` (`time tx ty tz qx qy qz qw`,
    world_from_object, seconds) and `dataset.toml` (the object's center in the first frame).

    Args:
        out_dir: output folder, created if missing; files of these names in it are replaced.
        scene: the scene; its first actor is the object.
        boxes: also write `boxes.toml`, the object's boxes in the first frame.

    Returns:
        The ground truth.

    Raises:
        OSError: a folder or file cannot be written.
        ValueError: images have an odd width or height, which videos do not support.
    """
    out = create_session_folder(out_dir, scene.rig)
    truth = compute_demo_truth(scene)
    write_ground_truth(out, {"object": truth.world_from_object})
    write_boxes(out, {"object": truth.boxes} if boxes else {})
    write_videos(out, scene.rig, render_frames(scene), scene.frames)
    return truth


def _make_demo_rig(n: int, size: tuple[int, int]) -> Rig:
    """Build a rig of cameras 1.2 m around the world's origin, alternately above and below it."""
    if n < 1 or min(size) < 64:
        raise ValueError(f"the demo needs at least one camera and images of 64 pixels or more, got {n} and {size}")
    heights = np.where(np.arange(n) % 2, -0.15, 0.45)
    rig = arc(n, min(40.0, 360.0 / n), 1.2, 1.3 * max(size), size, height=heights)
    lenses = [np.array(LENS_DISTORTIONS[i % len(LENS_DISTORTIONS)], dtype=float) for i in range(n)]
    cameras = [
        type(c)(c.name, c.size, c.matrix, lens, c.camera_from_world) for c, lens in zip(rig, lenses, strict=True)
    ]
    return Rig(cameras, rig.unit)
