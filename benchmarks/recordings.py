"""Transfer of a learned object from one recording to another: accuracy in the object's common frame.

    python benchmarks/recordings.py [--seeds 0:12] [--rig same] [--calibrated-anew 0.0]

A textured box rotates in front of four cameras for 50 frames. A second recording of 10 frames starts elsewhere: the box
rotates, slides, is static, rotates four times as fast, or shows a side that was never seen. Poses are compared with the
truth in the object frame of the first recording. *Wrong and sure*: the error exceeds 3 degrees or as much of the object's
radius, and its NEES has a probability below one in a million.

`--calibrated-anew` is the calibration error of each camera of the second recording, degrees, and ten times as many
millimeters (one standard deviation). With `--rig` the second recording has another rig: `others` (three cameras elsewhere,
with other focal lengths and sizes), `two` of these, or `one`.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.frames import FrameSet
from sylpose.geometry.robust_loss import chi_squared_bound
from sylpose.rig import Rig
from sylpose.simulate import Actor, Scene, arc, chamfered_box, render_frames
from sylpose.tracking.tracker import Tracker

__all__ = ["main"]

Path = Callable[[float], RigidTransform]
RIG = arc(4, 35, 1.5, 500, (480, 360), height=0.4)
OTHERS = arc(3, 50, 1.8, 650, (640, 480), height=0.15)
RIGS = {
    "same": RIG,
    "others": OTHERS,
    "two": Rig(OTHERS.cameras[:2], OTHERS.unit),
    "one": Rig(OTHERS.cameras[1:2], OTHERS.unit),
}
N_LEARNING_FRAMES, N_TEST_FRAMES = 50, 10
WRONG_RAD, WRONG_NEES = np.radians(3.0), chi_squared_bound(6, 1e-6)


def make_path(seed: int, speed: float) -> Path:
    """Return an oscillating path with a rotation of `speed` radians per frame about a random axis."""
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    phase, start = rng.uniform(0, 6, 4), Rotation.from_rotvec(0.25 * rng.normal(size=3))

    def path(k: float) -> RigidTransform:
        rotation = Rotation.from_rotvec(speed * (k + 2 * np.sin(k / 4 + phase[0])) * axis) * start
        position = 0.05 * np.sin(k / 9 + phase[1]), 0.03 * np.sin(k / 8 + phase[2]), 0.04 * np.sin(k / 11 + phase[3])
        return RigidTransform.from_components(position, rotation)

    return path


def make_test_paths(seed: int) -> dict[str, Path]:
    """Return the paths of the second recording, by kind."""
    regular_path, fast_path = make_path(seed, 0.03), make_path(seed, 0.12)
    first = regular_path(0)
    half_turn = Rotation.from_rotvec([0, 1.5, 0])
    return {
        "rotates": regular_path,
        "slides": lambda k: RigidTransform.from_components([0.04 - 0.006 * k, 0.01, 0.002 * k], first.rotation),
        "static": lambda _: first,
        "rotates fast": fast_path,
        "unseen side": lambda k: RigidTransform.from_components(
            regular_path(k).translation, regular_path(k).rotation * half_turn
        ),
    }


def render_frame_sets(rig: Rig, path: Path, frames: int, seed: int) -> Iterator[FrameSet]:
    scene = Scene(rig, (Actor(chamfered_box([0.3, 0.22, 0.26], 300), path),), frames, seed)
    for k, images in enumerate(render_frames(scene)):
        yield FrameSet(k, k / 30, (None,) * len(images), tuple(images), (None,) * len(images))


def calibrated_anew(rig: Rig, rng: np.random.Generator, degrees: float) -> Rig:
    off = (np.radians(degrees) * rng.normal(size=(2, len(rig), 3))) * [[[1.0]], [[0.01 / np.radians(1.0)]]]
    moved = [RigidTransform.from_components(d, Rotation.from_rotvec(w)) for w, d in off.swapaxes(0, 1)]
    return Rig(
        [replace(c, camera_from_world=m * c.camera_from_world) for c, m in zip(rig, moved, strict=True)], rig.unit
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="0:12")
    parser.add_argument("--rig", default="same", choices=[*RIGS])
    parser.add_argument("--calibrated-anew", type=float, default=0.0, help="degrees")
    options = parser.parse_args()
    begin, end = map(int, options.seeds.split(":"))
    counts, errors, nees_values = Counter[tuple[str, str]](), dict[str, list[float]](), dict[str, list[float]]()
    for seed in range(begin, end):
        first_path = make_path(2 * seed, 0.03)
        with Tracker(RIG) as tracker:
            found = [
                t.pose
                for frames in render_frame_sets(RIG, first_path, N_LEARNING_FRAMES, seed)
                for t in tracker.step(frames)
            ]
            known_object = tracker.build_known_object()
        first = next(pose for pose in found if pose.world_from_object is not None)
        if known_object is None or first.world_from_object is None:
            print(f"seed {seed}: no object was learned")
            continue
        actor_from_object = first_path(first.index).inv() * first.world_from_object
        true_rig = RIGS[options.rig]
        rig = calibrated_anew(true_rig, np.random.default_rng(seed), options.calibrated_anew)
        for kind, path in make_test_paths(2 * seed + 1).items():
            with Tracker(rig, known_object=known_object) as tracker:
                poses = [
                    t.pose
                    for frames in render_frame_sets(true_rig, path, N_TEST_FRAMES, seed + 100)
                    for t in tracker.step(frames)
                ]
            for pose in poses:
                if pose.world_from_object is None or not pose.is_measured:
                    counts[kind, "none"] += 1
                    continue
                true = path(pose.index) * actor_from_object
                w = (pose.world_from_object.rotation * true.rotation.inv()).as_rotvec()
                d = pose.world_from_object.translation - true.translation
                error = np.concatenate([w, d])
                nees = float(error @ np.linalg.solve(pose.covariance, error))
                is_large = np.linalg.norm(w) > WRONG_RAD or np.linalg.norm(d) > WRONG_RAD * known_object.radius
                counts[kind, "wrong" if is_large and nees > WRONG_NEES else "found"] += 1
                errors.setdefault(kind, []).append(float(np.degrees(np.linalg.norm(w))))
                nees_values.setdefault(kind, []).append(nees / 6)
    print(f"{'kind':14}{'found':>8}{'none':>8}{'wrong':>8}{'median':>9}{'worst':>8}{'NEES':>8}{'worst':>8}")
    for kind in make_test_paths(0):
        row = [counts[kind, what] for what in ("found", "none", "wrong")]
        e, s = errors.get(kind, [np.nan]), nees_values.get(kind, [np.nan])
        print(
            f"{kind:14}{row[0]:8}{row[1]:8}{row[2]:8}{np.median(e):8.2f}°{max(e):7.2f}°{np.mean(s):8.2f}{max(s):8.2f}"
        )


if __name__ == "__main__":
    main()
