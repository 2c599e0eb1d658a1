"""Rendered, seeded recordings of one moving object for `benchmarks/self_calibration.py`: kinds, scenes, tracks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation, Slerp

from benchmarks.kinds_feature_poor import blur_textures, reduce_contrast
from benchmarks.kinds_scenes import compress_h264
from benchmarks.trust_people import hold_with, make_person
from sylpose.frames import Box, FrameSet
from sylpose.geometry.arrays import FloatArray, Image
from sylpose.rig import Camera, Rig, intersect_rays
from sylpose.rig_calibration.camera_tracks import RefinedTrack, refine_track, track_alone
from sylpose.simulate import Actor, Scene, arc, compute_demo_truth, render_frames
from sylpose.simulate.recordings import FRAME_RATE, OBJECT_SHARE
from sylpose.simulate.render import Path, chamfered_box

SIZE, DISTANCE = (640, 480), 1.2
# Camera that is wrong, late, or sees little.
ODD = 1


@dataclass(frozen=True)
class Kind:
    """Kind of recording.

    Attributes:
        cameras, spacing_deg: number of cameras on an arc, and the angle between neighbors.
        size: of the images, pixels.
        focal: focal length in widths of the image; the distance grows with it.
        frames: number of frames.
        angle_deg: length of the path of rotations.
        wobble: how much the axis of rotation changes; 0: one axis only.
        carried: extent of the path of positions, relative to the object's length.
        sides: of the object, relative to its length.
        share: of the object's length in the image's height, relative to `OBJECT_SHARE`.
        focal_error, principal_error: relative errors of all focal lengths given; of principal points, in widths.
        wrong_camera: whether one camera observes another object.
        free: what is estimated of the lenses.
        late_frames: frames that one camera lacks at the beginning; it then has no box.
        seen_frames: frames that one camera has at all, from the beginning; 0: all.
        has_boxes: whether boxes are given.
        has_person: whether a person holds the object.
        contrast: of the object's texture.
        exposure: in frames.
        crf: of a compression with H.264; 0: none.
        jitter: standard deviation of the instants of each camera's images, frames.
        offset: frames by which one camera's images are late, which is not known.
        expected: "accepted", "refused" where the motion does not determine the rig, or "either".
    """

    cameras: int = 4
    spacing_deg: float = 40.0
    size: tuple[int, int] = SIZE
    focal: float = 1.3
    frames: int = 75
    angle_deg: float = 300.0
    wobble: float = 0.8
    carried: float = 1.0
    sides: tuple[float, float, float] = (1.0, 0.74, 0.86)
    share: float = 1.0
    focal_error: float = 0.0
    principal_error: float = 0.0
    wrong_camera: bool = False
    free: tuple[str, ...] = ()
    late_frames: int = 0
    seen_frames: int = 0
    has_boxes: bool = True
    has_person: bool = False
    contrast: float = 1.0
    exposure: float = 0.0
    crf: int = 0
    jitter: float = 0.0
    offset: float = 0.0
    expected: str = "accepted"


KINDS = {
    "near": Kind(),
    "far": Kind(spacing_deg=90.0),
    "opposite": Kind(cameras=2, spacing_deg=180.0),
    "little": Kind(angle_deg=40.0),
    "planar": Kind(angle_deg=150.0, sides=(1.0, 0.8, 0.05)),
    "focal": Kind(focal_error=0.05),
    "fov": Kind(focal_error=0.2, free=("fov",)),
    "wrong": Kind(wrong_camera=True),
    "late": Kind(late_frames=25),
    "axis": Kind(wobble=0.0, expected="refused"),
    "place": Kind(carried=0.0, expected="refused"),
}
SMALL_KIND = Kind(cameras=3, size=(320, 240), frames=40, angle_deg=200.0)
# Kinds of small images and few frames. "either": it is no fault to refuse, but to be wrong.
SMALL_KINDS = {
    "ordinary": SMALL_KIND,
    "wide-apart": replace(SMALL_KIND, spacing_deg=90.0),
    "two": replace(SMALL_KIND, cameras=2),
    "opposite": replace(SMALL_KIND, cameras=2, spacing_deg=180.0),
    "planar": replace(SMALL_KIND, angle_deg=120.0, sides=(1.0, 0.8, 0.05)),
    "long-lens": replace(SMALL_KIND, focal=6.0),
    "small": replace(SMALL_KIND, share=0.5, expected="either"),
    "nearly-one-axis": replace(SMALL_KIND, wobble=0.12, expected="either"),
    "one-axis": replace(SMALL_KIND, wobble=0.0, expected="refused"),
    "in-place": replace(SMALL_KIND, carried=0.0, expected="refused"),
    "hardly-carried": replace(SMALL_KIND, carried=0.15, expected="either"),
    "small-turn": replace(SMALL_KIND, angle_deg=20.0, expected="either"),
    "fast": replace(SMALL_KIND, frames=20, angle_deg=240.0, expected="either"),
    "wrong": replace(SMALL_KIND, cameras=4, wrong_camera=True),
    "wrong-of-two": replace(SMALL_KIND, cameras=2, wrong_camera=True, expected="refused"),
    "late": replace(SMALL_KIND, late_frames=15),
    "hardly-seen": replace(SMALL_KIND, seen_frames=9),
    "person": replace(SMALL_KIND, has_person=True),
    "person-no-boxes": replace(SMALL_KIND, has_person=True, has_boxes=False, expected="either"),
    "no-boxes": replace(SMALL_KIND, has_boxes=False),
    "focal-5-percent": replace(SMALL_KIND, focal_error=0.05),
    "principal-2-percent": replace(SMALL_KIND, principal_error=0.02, expected="either"),
    "blurred": replace(SMALL_KIND, exposure=0.7),
    "compressed": replace(SMALL_KIND, crf=30),
    "faint": replace(SMALL_KIND, contrast=0.25),
    "webcams": replace(SMALL_KIND, jitter=0.1),
    "half-a-frame-late": replace(SMALL_KIND, offset=0.5, expected="either"),
}


def draw_smooth_path(rng: np.random.Generator) -> Callable[[float], np.ndarray]:
    """Return a smooth random curve of three coordinates over [0, 1]: four harmonics."""
    k = np.arange(1, 5)
    sines, cosines = rng.normal(size=(2, 4, 3)) / k[:, None]
    return lambda s: np.sin(np.pi * k * s) @ sines + (np.cos(np.pi * k * s) - 1.0) @ cosines


def make_scene(kind: Kind, seed: int) -> Scene:
    """Build a scene: a textured block that tumbles about changing axes and is carried about."""
    rng = np.random.default_rng([seed, 77])
    heights = rng.uniform(-0.3, 0.5, kind.cameras)
    stretch = kind.focal / 1.3
    rig = arc(
        kind.cameras,
        kind.spacing_deg,
        stretch * DISTANCE,
        kind.focal * max(kind.size),
        kind.size,
        height=stretch * heights,
    )
    target = intersect_rays([c.center for c in rig], [c.direction for c in rig])
    resolution = np.array([c.focal / c.camera_from_world.apply(target)[2] for c in rig]).max()
    length = kind.share * OBJECT_SHARE * min(kind.size) / resolution
    body = chamfered_box(length * np.array(kind.sides), 1.25 * resolution, seed=seed)
    if kind.contrast < 1.0:
        body = blur_textures(reduce_contrast(body, kind.contrast), 1.0)
    turning, carrying = draw_smooth_path(rng), draw_smooth_path(rng)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    s = np.linspace(0.0, 1.0, 400)
    velocity = axis + np.array([kind.wobble * turning(x) for x in s])
    velocity *= np.radians(kind.angle_deg) / np.linalg.norm(velocity, axis=1).mean()
    rotations = [Rotation.identity()]
    for step in velocity[1:] / (len(s) - 1):
        rotations.append(Rotation.from_rotvec(step) * rotations[-1])
    rotation = Slerp(s, Rotation.concatenate(rotations))
    places = np.array([carrying(x) for x in s])
    places -= places.mean(axis=0)
    places *= 0.5 * kind.carried * length / np.abs(places).max()

    def path(frame: float) -> RigidTransform:
        x = float(np.clip(frame / (kind.frames - 1), 0.0, 1.0))
        return RigidTransform.from_components(target + [np.interp(x, s, column) for column in places.T], rotation(x))

    actors: tuple[Actor, ...] = (Actor(body, path),)
    if kind.has_person:
        hold = hold_with(path, 0.3 * length * rng.normal(size=3))
        actors += make_person(rng, rig, 0.5 * length, behind=2.5, aside=float(rng.uniform(-1.0, 1.0)), left=hold)
    return Scene(rig, actors, kind.frames, seed, exposure=kind.exposure)


def _delay(path: Path, delays: FloatArray) -> Path:
    """Return a path whose frame k shows the instant k - delays[k]."""
    numbers = np.arange(len(delays))
    return lambda frame: path(frame - float(np.interp(frame, numbers, delays)))


def _film(scene: Scene, camera: int, delays: FloatArray, crf: int) -> list[Image]:
    """Return a camera's images, late by delays (n,) frames."""
    actors = tuple(Actor(actor.body, _delay(actor.path, delays)) for actor in scene.actors)
    own = replace(scene, rig=Rig([scene.rig[camera]]), actors=actors, seed=scene.seed + 31 * camera)
    images = [frame[0] for frame in render_frames(own)]
    return compress_h264(images, crf) if crf else images


def _misstate(camera: Camera, kind: Kind) -> Camera:
    """Return a camera with the errors of its lens."""
    matrix = camera.matrix.copy()
    matrix[[0, 1], [0, 1]] *= 1.0 + kind.focal_error
    matrix[0, 2] += kind.principal_error * camera.size[0]
    return replace(camera, matrix=matrix)


def track_scene(kind: Kind, seed: int) -> tuple[Rig, list[Camera], list[RefinedTrack | None], float]:
    """Return the true rig, the cameras as given, their tracks, and the first camera's distance from the object."""
    scene, rng = make_scene(kind, seed), np.random.default_rng([seed, 99])
    truth = compute_demo_truth(scene)
    delays = kind.jitter * rng.normal(size=(kind.cameras, kind.frames))
    delays[ODD] += kind.offset
    cameras: list[Camera] = []
    tracks: list[RefinedTrack | None] = []
    for c, camera in enumerate(scene.rig):
        is_odd = c == ODD
        shown = replace(make_scene(kind, seed + 1000), rig=scene.rig) if kind.wrong_camera and is_odd else scene
        boxes = compute_demo_truth(shown).boxes
        first = kind.late_frames if is_odd else 0
        last = kind.seen_frames if is_odd and kind.seen_frames else kind.frames
        has_box = kind.has_boxes and not first and camera.name in boxes
        frames = [
            # A webcam's time stamps are those of its images.
            replace(FrameSet.of([image], (k - (delays[c, k] if kind.jitter else 0.0)) / FRAME_RATE), index=k)
            for k, image in enumerate(_film(shown, c, delays[c], kind.crf))
        ]
        cameras.append(_misstate(camera, kind))
        its = track_alone(frames[first:last], cameras[-1], Box(*boxes[camera.name]) if has_box else None)
        tracks.append(refine_track(its, cameras[-1]))
    distance = np.linalg.norm(scene.rig[0].camera_from_world.apply(truth.world_from_object.translation[0]))
    return scene.rig, cameras, tracks, float(distance)


def list_kinds(names: Sequence[str]) -> dict[str, Kind]:
    """Return kinds by name, those of small images named with a prefix."""
    all_kinds = KINDS | {f"small/{name}": kind for name, kind in SMALL_KINDS.items()}
    return {name: all_kinds[name] for name in (names or all_kinds)}
