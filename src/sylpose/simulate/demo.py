"""The built-in sequence: a painted block turns and drifts in front of a rig, written as a session with its truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig, nearest_point_to_rays
from sylpose.simulate.recording_files import FRAME_RATE, session_folder, write_boxes, write_truth, write_videos
from sylpose.simulate.render import Actor, Scene, chamfered_box, render_frames
from sylpose.simulate.rigs import arc

__all__ = ["DemoTruth", "demo_scene", "demo_truth", "render_sequence", "write_sequence"]


# The block's longest side, as a share of the image's shorter side.
OBJECT_SHARE = 0.45
# One lens per camera, in turn: mild barrels, as of webcams.
LENSES = ((-0.11, 0.03, 0.0004, -0.0003, 0), (-0.08, 0.01, -0.0005, 0.0002, 0), (-0.13, 0.04, 0.0002, 0.0006, 0))


@dataclass(frozen=True, eq=False)
class DemoTruth:
    """What is true about a rendered sequence.

    Attributes:
        rig: the cameras.
        times: (n,) seconds.
        world_from_object: (n,) poses; the object's frame has the world's axes in the first frame and the body's centre
            as its origin.
        vertices: (v, 3) the body's corners in the object's frame.
        boxes: of the object in the first frame, by camera: x, y, width, height in pixels; without cameras that do not
            see it then.
    """

    rig: Rig
    times: FloatArray
    world_from_object: RigidTransform
    vertices: FloatArray
    boxes: dict[str, tuple[int, int, int, int]]


def demo_scene(
    *,
    rig: Rig | None = None,
    frames: int = 60,
    turn_deg: float = 90.0,
    seed: int = 0,
    size: tuple[int, int] = (640, 480),
    n_cameras: int = 4,
    others: Sequence[Actor] = (),
    noise: float = 1.5,
    exposure: float = 0.0,
) -> Scene:
    """A painted block that turns by `turn_deg` in all, about a tilted axis with some wobble, and drifts by about its
    own size along a curve.

    Args:
        rig: None is an arc of `n_cameras` over 120 degrees at changing heights, with lens distortion and images of
            `size`. Any other should look at one place; the block is put there, as large as fits the images.
        frames: at 30 per second.
        others: bodies that move otherwise: distractors, occluders.
        noise, exposure: as in `Scene`.

    Raises:
        ValueError: no frames, a size under 64 pixels, or a rig that does not see one place.
    """
    if frames < 1:
        raise ValueError(f"a sequence needs at least one frame, got {frames}")
    rig = _demo_rig(n_cameras, size) if rig is None else rig
    rng = np.random.default_rng(seed)
    target = nearest_point_to_rays([c.center for c in rig], [c.direction for c in rig])
    if len(rig) == 1:  # one camera's axis has no nearest point: one unit of length in front of it
        target = rig.cameras[0].center + rig.cameras[0].direction
    depths = np.array([camera.camera_from_world.apply(target)[2] for camera in rig])
    if (depths <= 0).any():
        raise ValueError(f"camera {rig.names[int(np.argmin(depths))]}: it does not look where the others look")
    pixels_per_unit = np.array([camera.focal for camera in rig]) / depths
    span = OBJECT_SHARE * float(np.min([min(camera.size) for camera in rig] / pixels_per_unit))
    body = chamfered_box(span * np.array([1.0, 0.74, 0.86]), 1.25 * float(pixels_per_unit.max()), seed=seed)
    axis = Rotation.from_rotvec(rng.normal(0, 0.1, 3)).apply([0.25, 0.9, 0.35])
    axis = axis / np.linalg.norm(axis)
    drift = span * Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix()

    def path(frame: float) -> RigidTransform:
        s = frame / max(frames - 1, 1)
        wave, arch = np.sin(2 * np.pi * s), np.sin(np.pi * s)
        # The wobble vanishes at both ends: the turn in all is exactly `turn_deg`.
        wobble = Rotation.from_rotvec(np.deg2rad(6) * np.array([wave, 0.3 * arch, -arch]))
        turn = Rotation.from_rotvec(np.deg2rad(turn_deg) * (s - 0.06 * wave) * axis)
        return RigidTransform.from_components(
            target + drift @ np.array([0.7 * s - 0.35, 0.16 * wave, 0.45 * arch - 0.2]), wobble * turn
        )

    return Scene(rig, (Actor(body, path), *others), frames, seed, noise, exposure)


def demo_truth(scene: Scene) -> DemoTruth:
    """What is true about a scene, at 30 frames per second."""
    poses = scene.poses()
    first = poses[0]
    # A path may start with any turn; the object's frame has the world's axes there.
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
    turn_deg: float = 90.0,
    seed: int = 0,
    size: tuple[int, int] = (640, 480),
    n_cameras: int = 4,
    boxes: bool = False,
) -> DemoTruth:
    """Render `demo_scene` of these arguments and write it with `write_sequence`, which see."""
    scene = demo_scene(rig=rig, frames=frames, turn_deg=turn_deg, seed=seed, size=size, n_cameras=n_cameras)
    return write_sequence(out_dir, scene, boxes=boxes)


def write_sequence(out_dir: str | Path, scene: Scene, *, boxes: bool = False) -> DemoTruth:
    """Render a scene and write it as a session: one video per camera (`cam_0.mp4`, ...), `calibration.toml`, and the
    truth: `groundtruth.tum` (`time tx ty tz qx qy qz qw`, world_from_object, seconds) and `dataset.toml` (the object's
    centre in the first frame).

    Args:
        out_dir: made when absent; files of these names in it are replaced.
        boxes: write `boxes.toml` too, the object's boxes in the first frame.

    Raises:
        OSError: a folder or file that cannot be written.
        ValueError: images of odd width or height, which videos cannot hold.
    """
    out = session_folder(out_dir, scene.rig)
    truth = demo_truth(scene)
    write_truth(out, {"object": truth.world_from_object})
    write_boxes(out, {"object": truth.boxes} if boxes else {})
    write_videos(out, scene.rig, render_frames(scene), scene.frames)
    return truth


def _demo_rig(n: int, size: tuple[int, int]) -> Rig:
    """Cameras 1.2 m around the world's origin, alternately above and below its height."""
    if n < 1 or min(size) < 64:
        raise ValueError(f"the demo needs at least one camera and images of 64 pixels or more, got {n} and {size}")
    heights = np.where(np.arange(n) % 2, -0.15, 0.45)
    rig = arc(n, min(40.0, 360.0 / n), 1.2, 1.3 * max(size), size, height=heights)
    lenses = [np.array(LENSES[i % len(LENSES)], dtype=float) for i in range(n)]
    cameras = [
        type(c)(c.name, c.size, c.matrix, lens, c.camera_from_world) for c, lens in zip(rig, lenses, strict=True)
    ]
    return Rig(cameras, rig.unit)
