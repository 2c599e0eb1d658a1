"""Kinds of `benchmarks/trust.py`: regular takes, rigs that are wrong as a whole, and single faulty cameras."""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_scenes import draw_direction, index_by_name, make_board
from benchmarks.trust_effects import (
    change_images,
    cover,
    exchange,
    flip,
    freeze,
    make_dirt,
    make_net,
    rotate_cameras,
    stamp,
    zoom,
)
from benchmarks.trust_takes import (
    Take,
    draw_take,
    draw_trust_rig,
    flip_boxes,
    pace_path,
    place_boxes,
)
from sylpose.geometry.arrays import Image
from sylpose.rig import Camera, Rig
from sylpose.simulate import Actor

__all__ = ["ONE_CAMERA", "REGULAR", "WHOLE_RIG", "TakeKind"]

TakeKind = Callable[[np.random.Generator], Take]
UP = np.array([0.0, -1.0, 0.0])


# --- regular --------------------------------------------------------------------------------------------------------------


def turn_in_place(rng: np.random.Generator) -> Take:
    """An object on a turntable."""
    return draw_take(rng, axis=UP, travel=0.0)


def free_motion(rng: np.random.Generator) -> Take:
    """Rotation and translation."""
    return draw_take(rng)


def hand_board(rng: np.random.Generator) -> Take:
    """A board that is held towards the cameras and swings by 20 to 50 degrees."""
    swing, period = float(rng.uniform(20, 50)), float(rng.uniform(30, 60))
    return draw_take(
        rng, speed=(1.0, 1.0), pace=lambda t: swing * np.sin(2 * np.pi * t / period), body=make_board, travel=0.2
    )


def carried(rng: np.random.Generator) -> Take:
    """A box that is carried two to three radii through the view and turns little."""
    rig, radius = draw_trust_rig(rng, share=0.35)
    take = draw_take(rng, rig=(rig, radius), speed=(0.2, 0.8), travel=0.1)
    swaying, step = take.scene.actors[0].path, rng.uniform(0.06, 0.12) * radius * draw_direction(rng) * [1, 0.4, 1]
    middle = take.scene.frames / 2

    def path(frame: float) -> RigidTransform:
        return RigidTransform.from_translation((frame - middle) * step) * swaying(frame)

    take = replace(take, scene=replace(take.scene, actors=(Actor(take.scene.actors[0].body, path),)))
    return take if take.boxes is None else place_boxes(take)


def slow_turn(rng: np.random.Generator) -> Take:
    """0.1 to 0.4 degrees per frame."""
    return draw_take(rng, speed=(0.1, 0.4), travel=0.1, frames=40)


def fast_turn(rng: np.random.Generator) -> Take:
    """5 to 9 degrees per frame."""
    return draw_take(rng, speed=(5.0, 9.0))


def long_lens(rng: np.random.Generator) -> Take:
    """Narrow views, nearly orthographic."""
    return draw_take(rng, rig=draw_trust_rig(rng, focal_ratio=float(rng.uniform(4, 8))))


def wide_angle(rng: np.random.Generator) -> Take:
    """Short focal lengths with barrel distortion."""
    rig, radius = draw_trust_rig(rng, focal_ratio=float(rng.uniform(0.6, 0.8)), share=0.55)
    lens = np.array([-rng.uniform(0.1, 0.25), rng.uniform(0.01, 0.04), 0.0005, -0.0003, 0.0])
    return draw_take(rng, rig=(Rig([replace(camera, distortion=lens) for camera in rig], rig.unit), radius))


def six_per_second(rng: np.random.Generator) -> Take:
    """Six frames per second: 5 to 10 degrees and a tenth of the radius between frames."""
    return replace(draw_take(rng, speed=(1.0, 2.0), pace=lambda frame: 5.0 * frame, travel=0.3), rate=6.0)


def staggered(rng: np.random.Generator) -> Take:
    """Cameras that run freely and have correct time stamps: each up to half a frame off."""
    take = draw_take(rng)
    delays = rng.uniform(-0.5, 0.5, len(take.scene.rig))
    delays -= delays.mean()  # frame sets have the mean time
    clocks = {c: partial(operator.add, float(delay)) for c, delay in enumerate(delays)}
    return replace(take, clocks=clocks, stamped=True)


# --- whole rig ------------------------------------------------------------------------------------------------------------


def all_mirrored(rng: np.random.Generator) -> Take:
    """All images mirrored."""
    take = draw_take(rng)
    return replace(flip_boxes(take, True, False), effects=(flip(True, False),))


def staggered_mirrored(rng: np.random.Generator) -> Take:
    """All images mirrored, of cameras that run freely and have correct time stamps."""
    take = staggered(rng)
    return replace(flip_boxes(take, True, False), effects=(flip(True, False),))


def all_upside_down(rng: np.random.Generator) -> Take:
    """All images turned by 180 degrees."""
    take = draw_take(rng)
    return replace(flip_boxes(take, True, True), effects=(flip(True, True),))


def exchange_cameras(take: Take, order: list[int]) -> Take:
    """Give camera c the images and the box of camera order[c]."""
    names = take.scene.rig.names
    boxes = None if take.boxes is None else {names[c]: take.boxes[names[source]] for c, source in enumerate(order)}
    return replace(take, boxes=boxes, effects=(exchange(order),))


def all_exchanged(rng: np.random.Generator) -> Take:
    """Each camera shows the images of the next one."""
    take = draw_take(rng)
    return exchange_cameras(take, list(np.roll(range(len(take.scene.rig)), -1)))


def calibrate_with(take: Take, change: Callable[[Camera], Camera]) -> Take:
    """Give a calibration with changed cameras."""
    return replace(take, given=Rig([change(camera) for camera in take.scene.rig], take.scene.rig.unit))


def poses_inverted(rng: np.random.Generator) -> Take:
    """The cameras' poses in the world are given as the world's poses in the cameras."""
    return calibrate_with(draw_take(rng), lambda c: replace(c, camera_from_world=c.camera_from_world.inv()))


def opengl_axes(rng: np.random.Generator) -> Take:
    """The cameras' axes are those of OpenGL: y up, z backwards."""
    flipped = RigidTransform.from_rotation(Rotation.from_matrix(np.diag([1.0, -1.0, -1.0])))
    return calibrate_with(draw_take(rng), lambda c: replace(c, camera_from_world=flipped * c.camera_from_world))


def reflect(pose: RigidTransform) -> RigidTransform:
    """Reflect a pose: the y axes of both frames change sign."""
    mirror = np.diag([1.0, -1.0, 1.0])
    rotation = Rotation.from_matrix(mirror @ pose.rotation.as_matrix() @ mirror)
    return RigidTransform.from_components(mirror @ pose.translation, rotation)


def left_handed(rng: np.random.Generator) -> Take:
    """The calibration is of a left-handed world with y upwards; the motion is accepted in either world."""
    take = calibrate_with(draw_take(rng), lambda c: replace(c, camera_from_world=reflect(c.camera_from_world)))
    path = take.scene.actors[0].path
    return replace(take, truths=(path, lambda frame: reflect(path(frame))))


def scale_translation(pose: RigidTransform, factor: float) -> RigidTransform:
    """Scale the translation of a pose."""
    return RigidTransform.from_components(factor * pose.translation, pose.rotation)


def wrong_unit(rng: np.random.Generator) -> Take:
    """The translation of one camera is in another unit."""
    take, factor = draw_take(rng), float(rng.choice([0.001, 0.01, 0.3048, 0.0254, 10.0, 1000.0]))
    name = take.scene.rig.names[int(rng.integers(len(take.scene.rig)))]
    return calibrate_with(
        take,
        lambda c: c if c.name != name else replace(c, camera_from_world=scale_translation(c.camera_from_world, factor)),
    )


def rig_scaled(rng: np.random.Generator) -> Take:
    """All translations scaled: images cannot show it, and the truth is in the calibration's unit."""
    take, factor = draw_take(rng), float(np.exp(rng.uniform(-1.0, 1.0)))
    take = calibrate_with(take, lambda c: replace(c, camera_from_world=scale_translation(c.camera_from_world, factor)))
    path = take.scene.actors[0].path
    truths = (lambda frame: scale_translation(path(frame), factor),)
    return replace(take, truths=truths, radius=factor * take.radius)


def all_zoomed(rng: np.random.Generator) -> Take:
    """All focal lengths are given 20 to 40 % too short or too long."""
    factor = float(rng.choice([1 / 1.4, 1 / 1.2, 1.2, 1.4]))
    return calibrate_with(draw_take(rng), lambda c: magnify(c, factor))


def magnify(camera: Camera, factor: float) -> Camera:
    """Scale a camera's focal lengths."""
    return replace(camera, matrix=camera.matrix @ np.diag([factor, factor, 1.0]))


# --- one camera -----------------------------------------------------------------------------------------------------------


def draw_with_fault(rng: np.random.Generator) -> tuple[Take, int]:
    """Draw a take and the number of its faulty camera."""
    take = draw_take(rng)
    return take, int(rng.integers(len(take.scene.rig)))


def one_mirrored(rng: np.random.Generator) -> Take:
    """One camera's images are mirrored."""
    take, c = draw_with_fault(rng)
    return replace(flip_boxes(take, True, False, (c,)), effects=(flip(True, False, [c]),))


def one_upside_down(rng: np.random.Generator) -> Take:
    """One camera's images are turned by 180 degrees."""
    take, c = draw_with_fault(rng)
    return replace(flip_boxes(take, True, True, (c,)), effects=(flip(True, True, [c]),))


def frozen(rng: np.random.Generator) -> Take:
    """One camera repeats its first image."""
    take, c = draw_with_fault(rng)
    return replace(take, effects=(freeze(c, 0),))


def frozen_later(rng: np.random.Generator) -> Take:
    """One camera repeats its image from a frame on."""
    take, c = draw_with_fault(rng)
    return replace(take, effects=(freeze(c, int(rng.integers(5, take.scene.frames - 8))),))


def motionless_picture(rng: np.random.Generator) -> Take:
    """One camera films a picture of the scene: its noise is new in each image."""
    take, c = draw_with_fault(rng)
    return replace(take, clocks={c: lambda _frame: 0.0})


def make_late(rng: np.random.Generator, frames: int) -> Take:
    """One camera is late by whole frames; of two cameras either may be meant to be in time."""
    take, c = draw_with_fault(rng)
    path = take.scene.actors[0].path
    truths = (path, pace_path(path, lambda t: t - frames)) if len(take.scene.rig) == 2 else ()
    return replace(take, clocks={c: lambda frame: frame - frames}, truths=truths)


def late_1(rng: np.random.Generator) -> Take:
    """One camera is late by a frame."""
    return make_late(rng, 1)


def late_2(rng: np.random.Generator) -> Take:
    """One camera is late by two frames."""
    return make_late(rng, 2)


def late_3(rng: np.random.Generator) -> Take:
    """One camera is late by three frames."""
    return make_late(rng, 3)


def clock_drift(rng: np.random.Generator) -> Take:
    """One camera's clock is 2 to 10 % slow or fast."""
    take, c = draw_with_fault(rng)
    rate = 1 + float(rng.choice([-1, 1]) * rng.uniform(0.02, 0.1))
    path = take.scene.actors[0].path
    truths = (path, pace_path(path, lambda t: rate * t)) if len(take.scene.rig) == 2 else ()
    return replace(take, clocks={c: lambda frame: rate * frame}, truths=truths)


def bumped(rng: np.random.Generator) -> Take:
    """One camera rotates by 0.5 to 5 degrees in the middle of the take."""
    take, c = draw_with_fault(rng)
    rotations = np.zeros((take.scene.frames, len(take.scene.rig), 3))
    rotations[int(rng.integers(8, take.scene.frames - 8)) :, c] = np.radians(rng.uniform(0.5, 5)) * draw_direction(rng)
    return replace(take, effects=(rotate_cameras(rotations),))


def miscalibrate(rng: np.random.Generator, change: Callable[[Camera], Camera]) -> Take:
    """Give a calibration in which one camera is changed."""
    take, c = draw_with_fault(rng)
    name = take.scene.rig.names[c]
    return calibrate_with(take, lambda camera: change(camera) if camera.name == name else camera)


def zoomed_5(rng: np.random.Generator) -> Take:
    """One focal length is given 5 % too short or too long."""
    factor = float(rng.choice([0.95, 1.05]))
    return miscalibrate(rng, lambda c: magnify(c, factor))


def zoomed_20(rng: np.random.Generator) -> Take:
    """One focal length is given 20 % too short or too long."""
    factor = float(rng.choice([0.8, 1.25]))
    return miscalibrate(rng, lambda c: magnify(c, factor))


def zooms_in(rng: np.random.Generator) -> Take:
    """One camera zooms by 5 to 20 % in the middle of the take."""
    take, c = draw_with_fault(rng)
    return replace(take, effects=(zoom(c, float(rng.uniform(1.05, 1.2)), int(rng.integers(8, 20))),))


def rotate_given(rng: np.random.Generator, degrees: float) -> Take:
    """Give a calibration in which one camera is rotated about its center."""
    turn = RigidTransform.from_rotation(Rotation.from_rotvec(np.radians(degrees) * draw_direction(rng)))
    return miscalibrate(rng, lambda c: replace(c, camera_from_world=turn * c.camera_from_world))


def rotated_3(rng: np.random.Generator) -> Take:
    """One camera is given rotated by 3 degrees."""
    return rotate_given(rng, 3.0)


def rotated_10(rng: np.random.Generator) -> Take:
    """One camera is given rotated by 10 degrees."""
    return rotate_given(rng, 10.0)


def displaced(rng: np.random.Generator) -> Take:
    """One camera stands elsewhere by 5 to 15 % of its distance."""
    offset = RigidTransform.from_translation(1.5 * rng.uniform(0.05, 0.15) * draw_direction(rng))
    return miscalibrate(rng, lambda c: replace(c, camera_from_world=c.camera_from_world * offset))


def pair_exchanged(rng: np.random.Generator) -> Take:
    """Two of three or more cameras are exchanged."""
    take = draw_take(rng, cameras=int(rng.integers(3, 6)))
    order = list(range(len(take.scene.rig)))
    i, j = rng.choice(len(order), 2, replace=False)
    order[i], order[j] = order[j], order[i]
    return exchange_cameras(take, order)


def junk_video(rng: np.random.Generator) -> Take:
    """One camera shows another scene, with another object."""
    take, c = draw_with_fault(rng)
    other = draw_take(rng, rig=(take.scene.rig, take.radius), boxes=False)
    return replace(take, stand_ins={c: other.scene})


def net(rng: np.random.Generator) -> Take:
    """A net before one camera or all."""
    take, c = draw_with_fault(rng)
    layers = [make_net(rng, camera.size) for camera in take.scene.rig]
    images, masks = zip(*layers, strict=True)
    return replace(take, effects=(cover(images, masks, None if rng.random() < 0.5 else [c]),))


def dirt(rng: np.random.Generator) -> Take:
    """Dirt on the lens of one camera or of all."""
    take, c = draw_with_fault(rng)
    layers = [make_dirt(rng, camera.size) for camera in take.scene.rig]
    images, masks = zip(*layers, strict=True)
    return replace(take, effects=(cover(images, masks, None if rng.random() < 0.5 else [c]),))


def burnt_in_text(rng: np.random.Generator) -> Take:
    """Name and frame number are burnt into the images."""
    take = draw_take(rng)
    place = float(rng.uniform(0.02, 0.3)), float(rng.choice([0.12, 0.55, 0.95]))
    return replace(
        take,
        effects=(stamp("CAM", 16, (0.03, 0.1), False), stamp("2026-03-14", int(rng.integers(12, 30)), place, True)),
    )


def noisy_camera(rng: np.random.Generator) -> Take:
    """One camera is dark, with noise of 15 to 30 gray levels."""
    take, c = draw_with_fault(rng)
    sd, gain, seed = float(rng.uniform(15, 30)), float(rng.uniform(0.2, 0.5)), int(rng.integers(1 << 30))

    def add_noise(_take: Take, c: int, k: int, image: Image) -> Image:
        noise = np.random.default_rng([seed, c, k]).normal(0, sd, image.shape)
        return np.clip(np.rint(gain * image + noise), 0, 255).astype(np.uint8)

    return replace(take, effects=(change_images(add_noise, [c]),))


REGULAR = index_by_name(
    [
        turn_in_place,
        free_motion,
        hand_board,
        carried,
        slow_turn,
        fast_turn,
        long_lens,
        wide_angle,
        six_per_second,
        staggered,
    ]
)
WHOLE_RIG = index_by_name(
    [
        all_mirrored,
        staggered_mirrored,
        all_upside_down,
        all_exchanged,
        poses_inverted,
        opengl_axes,
        left_handed,
        wrong_unit,
        rig_scaled,
        all_zoomed,
    ]
)
ONE_CAMERA = index_by_name(
    [
        one_mirrored,
        one_upside_down,
        frozen,
        frozen_later,
        motionless_picture,
        late_1,
        late_2,
        late_3,
        clock_drift,
        bumped,
        zoomed_5,
        zoomed_20,
        zooms_in,
        rotated_3,
        rotated_10,
        displaced,
        pair_exchanged,
        junk_video,
        net,
        dirt,
        burnt_in_text,
        noisy_camera,
    ]
)
