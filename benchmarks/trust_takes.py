"""Takes of `benchmarks/trust.py`: variations whose cameras, clocks, light and calibration differ from what is given.

A take is rendered camera by camera into a film, images by camera and frame. Its effects, functions of a whole film,
change the images afterwards.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path as FilePath

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_scenes import (
    DISTANCE,
    Variation,
    compute_boxes,
    draw_body,
    draw_direction,
    draw_rig,
)
from sylpose import Box, FrameSet
from sylpose.geometry.arrays import BoolArray, FloatArray, Image
from sylpose.rig import Camera, Rig
from sylpose.simulate import Actor, Scene, TexturedBody, render_frames
from sylpose.simulate.render import Path

__all__ = [
    "Clock",
    "Effect",
    "Film",
    "Take",
    "draw_motion",
    "draw_photo",
    "draw_take",
    "draw_trust_rig",
    "make_panel",
    "pace_path",
    "place_boxes",
    "show_during",
    "to_cameras",
    "warn_without_photographs",
]

Film = list[list[Image]]
Effect = Callable[["Take", Film], Film]
Clock = Callable[[float], float]

SIZES = ((320, 240), (320, 240), (400, 300))
FRAMES = 30
# Half angle that the cameras span as seen from the object, at most: a person behind it is behind it for all of them.
MAX_ARC_DEG = 150.0
# Distance of the wall with a photograph, in distances of the cameras from the object.
WALL_DISTANCE = 2.6
# Position of a body that is out of all views.
AWAY = (0.0, 1e4, 0.0)
# Object radius that the sizes of persons are for, in units of the scene.
PERSON_RADIUS = 0.2


@dataclass(frozen=True, eq=False)
class Take(Variation):
    """Variation with cameras that differ from their calibration, in image, clock or place.

    Attributes:
        given: calibration for the tracker; None: the scene's rig, which is the true one.
        truths: true motions that are accepted, in the world of the calibration: a run is scored against the one that it
            agrees with best as a whole. Empty: that of the scene's first actor.
        first: first frame in which the object can be seen.
        clocks: by camera, the time (frames) at which its frame k was exposed.
        stamped: whether the time stamps of the images are those of the clocks, else those of the frame sets.
        stand_ins: by camera, the scene that it sees instead.
        photos: by camera, the photograph on the wall behind the scene; None: rooms that are drawn.
        slices: exposure times of the parts of an image, relative to its frame: bands of rows, or fields.
        interlaced: the slices are fields, every so-manieth row.
        effects: changes of the film, in this order.
        rate: frames per second.
    """

    given: Rig | None = None
    truths: tuple[Path, ...] = ()
    first: int = 0
    clocks: Mapping[int, Clock] = field(default_factory=dict)
    stamped: bool = False
    stand_ins: Mapping[int, Scene] = field(default_factory=dict)
    photos: tuple[Image, ...] | None = None
    slices: tuple[float, ...] = (0.0,)
    interlaced: bool = False
    effects: tuple[Effect, ...] = ()
    rate: float = 30.0

    @property
    def calibration(self) -> Rig:
        """Return the rig that the tracker is given."""
        return self.scene.rig if self.given is None else self.given

    def true_poses(self) -> list[RigidTransform]:
        """Return the accepted true poses (frames,) of each truth."""
        count = range(self.scene.frames)
        paths = self.truths or (self.scene.actors[0].path,)
        return [RigidTransform.concatenate([path(float(k)) for k in count]) for path in paths]

    def frames(self) -> Iterator[FrameSet]:
        """Render the frame sets for the tracker."""
        film = [self._film_camera(c) for c in range(len(self.scene.rig))]
        for effect in self.effects:
            film = effect(self, film)
        no_values = (None,) * len(film)
        for k, images in enumerate(zip(*film, strict=True)):
            clocks = [self.clocks.get(c, float) for c in range(len(images))]
            times = tuple(clock(float(k)) / self.rate for clock in clocks) if self.stamped else no_values
            yield FrameSet(k, k / self.rate, times, tuple(images), no_values)

    def outlines(self, c: int, k: int, actors: tuple[Actor, ...] | None = None) -> list[FloatArray]:
        """Return the convex outlines (n, 2), pixels, of the actors (None: of all) that camera c sees in frame k."""
        clock, camera = self.clocks.get(c, float), self.scene.rig.cameras[c]
        outlines = []
        for actor in self.scene.actors if actors is None else actors:
            pixels = camera.project(actor.path(clock(float(k))).apply(actor.body.vertices))
            if np.isfinite(pixels).all() and np.abs(pixels).max() < 1e5:
                outlines.append(np.asarray(cv2.convexHull(pixels.astype(np.float32))[:, 0], dtype=float))
        return outlines

    def mask(self, c: int, k: int, actors: tuple[Actor, ...] | None = None) -> BoolArray:
        """Return the mask (height, width) of the actors (None: of all) in a camera and frame."""
        width, height = self.scene.rig.cameras[c].size
        mask = np.zeros((height, width), np.uint8)
        for outline in self.outlines(c, k, actors):
            cv2.fillConvexPoly(mask, np.rint(outline).astype(np.int32), (1,))
        return mask > 0

    def _film_camera(self, c: int) -> list[Image]:
        films = [self._render_camera(c, delay) for delay in self.slices]
        if len(films) == 1:
            return films[0]
        height = self.scene.rig.cameras[c].size[1]
        rows = np.arange(height)
        chosen = rows % len(films) if self.interlaced else rows * len(films) // height
        return [np.choose(chosen[:, None, None], images).astype(np.uint8) for images in zip(*films, strict=True)]

    def _render_camera(self, c: int, delay: float) -> list[Image]:
        camera, scene = self.scene.rig.cameras[c], self.stand_ins.get(c, self.scene)
        clock = self.clocks.get(c, float)
        actors = [Actor(a.body, _exposed_at(a.path, clock, delay)) for a in scene.actors]
        if self.photos is not None:
            actors.append(make_wall(camera, self.photos[c]))

        seed = scene.seed + 7919 * c
        view = replace(scene, rig=Rig([camera]), actors=tuple(actors), frames=self.scene.frames, seed=seed)
        return [images[0] for images in render_frames(view)]


def _exposed_at(path: Path, clock: Clock, delay: float) -> Path:
    return lambda frame: path(clock(frame + delay))


# --- photographs and panels -----------------------------------------------------------------------------------------------


# Packages that ship photographs: their folder, and the number of photographs that the figures in the documents are of.
PHOTOGRAPHS = {"viser": ("_assets/hdri", 10), "matplotlib": ("mpl-data/sample_data", 1)}


@cache
def _find_photographs(package: str, folder: str) -> tuple[FilePath, ...]:
    """Find the photographs in a folder of a package; none if it is not installed."""
    spec = importlib.util.find_spec(package)
    if spec is None or spec.origin is None:
        return ()
    return tuple(sorted((FilePath(spec.origin).parent / folder).glob("*.jpg")))


def warn_without_photographs() -> None:
    """Print a warning on stderr if takes with photographs differ here from those of the figures in the documents.

    Benchmarks call it once, at the beginning; the takes are drawn later, often by other processes.
    """
    found = {package: len(_find_photographs(package, folder)) for package, (folder, _) in PHOTOGRAPHS.items()}
    wrong = [package for package, (_, count) in PHOTOGRAPHS.items() if found[package] != count]
    if wrong:
        counts = ", ".join(f"{package} has {found[package]} instead of {PHOTOGRAPHS[package][1]}" for package in wrong)
        print(
            f"warning: {counts} photographs here: takes with photographs show others, or drawn rooms, and differ from those "
            f"of other machines and of the documents. Install {' and '.join(wrong)} to repeat these.",
            file=sys.stderr,
            flush=True,
        )


def draw_photo(rng: np.random.Generator, size: tuple[int, int]) -> Image:
    """Draw a part of a photograph that an installed package ships, or a room if none does: `warn_without_photographs`."""
    width, height = size
    # One number of the take's generator, whatever is installed: the rest of the take is the same on every machine.
    rng = np.random.default_rng(int(rng.integers(1 << 30)))
    files = [file for package, (folder, _) in PHOTOGRAPHS.items() for file in _find_photographs(package, folder)]
    photo = cv2.imread(str(files[int(rng.integers(len(files)))])) if files else None
    if photo is None:
        from sylpose.simulate.textures import make_room_image

        return make_room_image(width, height, rng)
    # Panoramas show little at their poles.
    photo = photo[photo.shape[0] // 5 : -photo.shape[0] // 5]
    share = rng.uniform(0.6, 1.0)
    rows = max(int(share * min(photo.shape[0], photo.shape[1] * height / width)), 8)
    columns = max(int(rows * width / height), 8)
    top, left = (int(rng.integers(max(n - m, 0) + 1)) for n, m in zip(photo.shape[:2], (rows, columns), strict=True))
    part = photo[top : top + rows, left : left + columns]
    return np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_CUBIC), dtype=np.uint8)


def make_panel(width: float, height: float, thickness: float, texels_per_unit: float, image: Image) -> TexturedBody:
    """Make an upright board in the x-y plane with an image on its front, towards -z."""
    half = np.array([width, height, thickness]) / 2
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
    body = TexturedBody.from_hull(corners, texels_per_unit)
    front = int(np.argmin(body.normals[:, 2]))
    rows, columns = body.textures[front].shape[:2]
    textures = list(body.textures)
    textures[front] = np.asarray(cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return replace(body, textures=tuple(textures))


def make_wall(camera: Camera, photo: Image) -> Actor:
    """Make a wall with a photograph that fills a camera's view."""
    depth = WALL_DISTANCE * DISTANCE
    width, height = 1.35 * depth * np.array(camera.size) / camera.focal
    body = make_panel(width, height, 0.02 * depth, 1.2 * camera.focal / depth, photo)
    pose = camera.camera_from_world.inv() * RigidTransform.from_translation([0.0, 0.0, depth])
    return Actor(body, lambda _frame: pose)


def show_during(path: Path, begin: float, end: float = np.inf) -> Path:
    """Return a path that is out of all views before `begin` and from `end` on."""
    away = RigidTransform.from_translation(AWAY)
    return lambda frame: path(frame) if begin <= frame < end else away


# --- rigs, motions, takes -------------------------------------------------------------------------------------------------


def draw_trust_rig(
    rng: np.random.Generator,
    cameras: int | None = None,
    *,
    share: float | None = None,
    focal_ratio: float = 1.3,
    size: tuple[int, int] | None = None,
) -> tuple[Rig, float]:
    """Draw 2 to 6 cameras on an arc of at most 150 degrees; return the rig and the object's radius."""
    n = int(rng.choice([2, 2, 3, 3, 4, 4, 5, 6])) if cameras is None else cameras
    size = SIZES[int(rng.integers(len(SIZES)))] if size is None else size
    spacing = float(rng.uniform(15.0, min(65.0, MAX_ARC_DEG / (n - 1))))
    share = float(rng.uniform(0.4, 0.7)) if share is None else share
    return draw_rig(rng, n, size=size, spacing=spacing, share=share, focal=focal_ratio * max(size))


def to_cameras(rig: Rig) -> FloatArray:
    """Return the horizontal direction (3,) from the object to the middle of the cameras."""
    middle = np.mean([camera.center for camera in rig], axis=0) * [1.0, 0.0, 1.0]
    return np.asarray(middle / np.linalg.norm(middle))


def draw_motion(
    rng: np.random.Generator,
    radius: float,
    speed: float,
    *,
    travel: float | None = None,
    axis: FloatArray | None = None,
) -> Path:
    """Draw a smooth motion, defined for all times.

    Args:
        rng: random generator.
        radius: of the object.
        speed: mean speed of rotation, degrees per frame.
        travel: amplitude of the translation, radii; None: 0.1 to 0.5.
        axis: (3,) axis of rotation; None: a random one that wanders slightly.
    """
    travel = float(rng.uniform(0.1, 0.5)) if travel is None else travel
    about, wander = (draw_direction(rng), 0.3 * draw_direction(rng)) if axis is None else (axis, np.zeros(3))
    first = Rotation.from_rotvec(0.3 * draw_direction(rng)) if axis is None else Rotation.identity()
    directions = np.array([draw_direction(rng), draw_direction(rng)])
    periods, phases = rng.uniform(35.0, 90.0, 3), rng.uniform(0, 2 * np.pi, 3)
    unsteadiness = 0.3 * rng.uniform(0, 1)

    def path(frame: float) -> RigidTransform:
        angle = np.radians(speed) * (frame + unsteadiness * periods[2] / 6 * np.sin(6 * frame / periods[2]))
        position = travel * radius * np.sin(2 * np.pi * frame / periods[:2] + phases[:2]) @ directions
        axis_now = about + wander * np.sin(angle)
        rotation = Rotation.from_rotvec(angle * axis_now / np.linalg.norm(axis_now))
        return RigidTransform.from_components(position, rotation * first)

    return path


def pace_path(path: Path, pace: Clock) -> Path:
    """Run through a path at another pace: `pace(frame)` is the time on it."""
    return lambda frame: path(pace(frame))


def draw_take(
    rng: np.random.Generator,
    *,
    rig: tuple[Rig, float] | None = None,
    cameras: int | None = None,
    frames: int = FRAMES,
    speed: tuple[float, float] = (1.0, 4.0),
    travel: float | None = None,
    axis: FloatArray | None = None,
    pace: Clock | None = None,
    boxes: bool | None = None,
    body: Callable[[np.random.Generator, Rig, float], TexturedBody] = draw_body,
    photos: bool | None = None,
) -> Take:
    """Draw a take of an object that moves freely before a wall.

    Args:
        rng: random generator.
        rig: the rig and the object's radius; None: drawn.
        cameras: number of cameras; None: 2 to 6.
        frames: number of frames.
        speed: limits of the rotation, degrees per frame.
        travel, axis: as in `draw_motion`.
        pace: time on the motion by frame; None: the frame.
        boxes: with boxes; None: in every other seed.
        body: draws the object.
        photos: with photographs on the wall; None: in every other seed.
    """
    true_rig, radius = draw_trust_rig(rng, cameras) if rig is None else rig
    path = draw_motion(rng, radius, float(rng.uniform(*speed)), travel=travel, axis=axis)
    actor = Actor(body(rng, true_rig, radius), path if pace is None else pace_path(path, pace))
    seed, noise = int(rng.integers(1 << 30)), float(rng.uniform(0.5, 3.0))
    scene = Scene(true_rig, (actor,), frames, seed, noise)
    with_boxes, with_photos = rng.random(2) < 0.5
    walls = tuple(draw_photo(rng, camera.size) for camera in true_rig)
    take = Take(scene, None, radius, photos=walls if (with_photos if photos is None else photos) else None)
    return place_boxes(take) if (with_boxes if boxes is None else boxes) else take


def place_boxes(take: Take) -> Take:
    """Add the object's boxes in the first frame, a tenth too large."""
    return replace(take, boxes=compute_boxes(take.scene, 1.1))


def flip_boxes(take: Take, horizontal: bool, vertical: bool, cameras: tuple[int, ...] | None = None) -> Take:
    """Flip the boxes with the images of the cameras (None: of all)."""
    if take.boxes is None:
        return take
    boxes = dict(take.boxes)
    for c, camera in enumerate(take.scene.rig):
        if cameras is not None and c not in cameras:
            continue
        box, (width, height) = boxes[camera.name], camera.size
        x = width - 1 - box.x - box.width if horizontal else box.x
        y = height - 1 - box.y - box.height if vertical else box.y
        boxes[camera.name] = Box(x, y, box.width, box.height)
    return replace(take, boxes=boxes)
