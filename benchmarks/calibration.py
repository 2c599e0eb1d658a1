"""How much of a calibration's errors does `--refine-calibration` take out? Rigs with known truth, disturbed.

    python benchmarks/calibration.py [--seeds 4] [--turn-deg 0 20 60 180] [--off 0 0.2 1 3] [--features 60] [--matched]
    python benchmarks/calibration.py --rendered [--seeds 4] [--off 0 0.2 1 3]

Simulated tracks of a body that turns and moves about, seen by the true rig, are told to be of a rig whose cameras are turned
by so many degrees about each axis, shifted by 3 mm, focal lengths by 1 %, principal points by 5 px, radial coefficients by
0.02 (one standard deviation each). For each row, before and after: the rms error of the cameras' turns and shifts after the
best common similarity, of the focal lengths, of the last pose, and the median NEES of the poses with the given and with the
refined calibration; the standard deviation that is said of the refined turns; and by what share of what was believed of them
the given turns seemed to be off. With --matched what is believed is what they are off by.

With --rendered images of a block that turns by 70 degrees are tracked, with the rig as told: errors of neighbouring features
are alike then. Median and worst over the seeds; of an exact rig also what is refined in its standard deviations, rms.
"""

from __future__ import annotations

import argparse
from itertools import product

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.translation_only import error, tracks
from sylpose import FrameSet, track
from sylpose.bundle_adjustment.bundle import Observations, bundle
from sylpose.bundle_adjustment.calibration_refinement import Doubt, corrected, usual_doubt
from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import arc, box, demo_scene, demo_truth, render_frames, ring
from sylpose.smoothing.trajectory import Track, smooth

LENS = (-0.11, 0.03, 0.0004, -0.0003, 0)
RIGS = {
    "4 around": ring(4, 1.5, 1000.0, height=(0.4, -0.1, 0.2, 0.5), distortion=LENS),
    "4 in 120°": arc(4, 40.0, 1.5, 1000.0, height=(0.3, -0.1, 0.2, 0.1), distortion=LENS),
    "2 in 40°": arc(2, 40.0, 1.5, 1000.0, height=(0.2, -0.1), distortion=LENS),
}


def path(frames: int, degrees: float) -> RigidTransform:
    """A turn about a changing axis, and a way about as long as the object."""
    s = np.linspace(0.0, 1.0, frames)[:, None]
    wave = np.deg2rad(degrees) * 0.3 * np.hstack([np.sin(6 * s), 0 * s, 1 - np.cos(5 * s)])
    turn = Rotation.from_rotvec(wave) * Rotation.from_rotvec(np.deg2rad(degrees) * s * np.array([0.25, 0.9, 0.35]))
    place = 0.12 * np.hstack([s, 0.6 * np.sin(4 * s), 0.7 * np.sin(6 * s)])
    poses = RigidTransform.from_components(place, turn)
    return poses * poses[0].inv()


def disturbed(rig: Rig, degrees: float, seed: int) -> Rig:
    """The rig as a calibration might have it that is off by so many degrees, and by other things in proportion up to 1."""
    rng, n, share = np.random.default_rng(seed), len(rig), min(degrees, 1.0)
    sizes = np.concatenate([np.full(3, np.deg2rad(degrees)), share * np.array([0.003] * 3 + [0.01, 5.0, 5.0, 0.02])])
    return corrected(rig, np.hstack([np.zeros((n, 4)), sizes * rng.standard_normal((n, 10))]))


def as_disturbed(rig: Rig, degrees: float) -> Doubt:
    """What is true of `disturbed`."""
    degrees, n = max(degrees, 1e-6), len(rig)  # nothing at all cannot be believed
    share = min(degrees, 1.0)
    lens = np.tile(share * np.array([0.01, 5.0, 5.0, 0.02]), (n, 1))
    return Doubt(np.full(n, np.deg2rad(degrees)), np.full(n, 0.003 * share), lens, np.full(n, -1))


def seen_as(seen: Observations, rig: Rig, told: Rig) -> Observations:
    """The same pixels, normalised by another calibration."""
    image = seen.image.copy()
    for c, (true, other) in enumerate(zip(rig, told, strict=True)):
        mine = seen.camera == c
        image[mine] = other.normalize(true.denormalize(image[mine]))
    return Observations(seen.frame, seen.camera, seen.landmark, image)


def common(rig: Rig, truth: Rig) -> tuple[float, Rotation, FloatArray, FloatArray]:
    """Scale, turn and shift that take the rig's world to the true one, and (C, 2) what is left of each camera: degrees, mm.

    The turn is that of the cameras' axes, which two cameras tell as well as many.
    """
    turn = Rotation.concatenate(
        [t.camera_from_world.rotation.inv() * c.camera_from_world.rotation for c, t in zip(rig, truth, strict=True)]
    )
    mean = turn.mean()
    mine, true = mean.apply(np.array([c.center for c in rig])), np.array([c.center for c in truth])
    a, b = mine - mine.mean(axis=0), true - true.mean(axis=0)
    scale = float((a * b).sum() / (a * a).sum())
    shift = true.mean(axis=0) - scale * mine.mean(axis=0)
    left = np.rad2deg((mean.inv() * turn).magnitude())
    return scale, mean, shift, np.column_stack([left, 1e3 * np.linalg.norm(scale * mine + shift - true, axis=1)])


def pose_errors(found: RigidTransform, rig: Rig, truth: Rig, true: RigidTransform) -> FloatArray:
    """(N, 6) errors of (w, d) of poses that a rig was told, in the true world after the best common similarity."""
    scale, turn, shift, _ = common(rig, truth)
    out = []
    for k in range(len(true)):
        # The motion since the first frame, in the true world.
        now, first = found[k], found[0]
        moved = now * first.inv()
        w = turn * moved.rotation * turn.inv()
        t = scale * turn.apply(moved.translation) + shift - w.apply(shift)
        whole = RigidTransform.from_components(t, w) * true[0]
        out.append(error(true[k], whole))
    return np.array(out)


def scored(found: RigidTransform, covariance: FloatArray, now: Rig, rig: Rig, true: RigidTransform) -> FloatArray:
    """(6,) degrees, mm and focal lengths in percent that the cameras are off, degrees and mm of the last pose, and the
    median NEES, of poses (N) with covariances (N, 6, 6)."""
    left = np.sqrt((common(now, rig)[3] ** 2).mean(axis=0))
    focal = 100 * np.sqrt(np.mean([(a.focal / b.focal - 1) ** 2 for a, b in zip(now, rig, strict=True)]))
    e = pose_errors(found, now, rig, true)
    nees = [x @ np.linalg.solve(c, x) for x, c in zip(e[1:], covariance[1:], strict=True)]
    last = [np.rad2deg(np.linalg.norm(e[-1, :3])), 1e3 * np.linalg.norm(e[-1, 3:])]
    return np.array([*left, focal, *last, np.median(nees)])


def tracked(seed: int, degrees: float, frames: int = 60) -> tuple[list[Track], Rig, Rig, RigidTransform]:
    """Rendered images of a turn, tracked with a rig that is off; that rig, the true one, and the true poses."""
    scene = demo_scene(frames=frames, turn_deg=70.0, size=(320, 240), n_cameras=4, seed=seed)
    truth, nothing = demo_truth(scene), (None,) * len(scene.rig)
    told = disturbed(scene.rig, degrees, seed) if degrees else scene.rig
    sets = (FrameSet(k, k / 30, nothing, images, nothing) for k, images in enumerate(render_frames(scene)))
    boxes = {name: Box(*box) for name, box in truth.boxes.items()}
    return [Track.of(f) for f in track(sets, told, boxes)], told, scene.rig, truth.world_from_object


def of_rendered(seed: int, degrees: float) -> FloatArray:
    """(14,) `scored` with the rig as told and refined, the standard deviation of the refined turns, degrees, and how far
    what is refined is from nothing, in its standard deviations."""
    tracks, told, rig, true = tracked(seed, degrees)
    rows = []
    for recalibrate in (False, True):
        smoothed = smooth(tracks, told, doubt=usual_doubt(told), recalibrate=recalibrate)
        poses = [pose for pose in smoothed.poses if pose.measured]
        found = RigidTransform.concatenate([p.world_from_object for p in poses if p.world_from_object is not None])
        now = told if smoothed.correction is None else smoothed.correction.rig.subset(rig.names)
        covariance = np.array([pose.covariance for pose in poses])
        rows.append(scored(found, covariance, now, rig, true[[pose.index for pose in poses]]))
    assert smoothed.correction is not None
    values, sd = smoothed.correction.values[: len(rig)], smoothed.correction.sd[: len(rig)]
    said = np.rad2deg(np.sqrt((sd[:, :3] ** 2).sum(axis=1).mean()))
    return np.array([*rows[0], *rows[1], said, np.sqrt(((values / sd) ** 2).mean())])


def main_rendered(seeds: range, off: list[float]) -> None:
    print("| off by | degrees | mm | focal, % | pose, degrees | pose, mm | NEES | said, degrees | refined, sd |")
    print("|---|---|---|---|---|---|---|---|---|")
    for degrees in off:
        rows = np.array([of_rendered(seed, degrees) for seed in seeds])
        middle, worst = ([f"{x:.2g}" for x in how(rows, axis=0)] for how in (np.median, np.max))
        both = [f"{m} ({w})" for m, w in zip(middle, worst, strict=True)]
        cells = [f"{a} → {b}" for a, b in zip(both[:6], both[6:12], strict=True)]
        print(f"| {degrees:g}° | {' | '.join([*cells, both[12], '' if degrees else both[13]])} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=0, help="seed to begin with")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--features", type=int, default=60, help="per camera")
    parser.add_argument("--matched", action="store_true", help="believe what is true of the disturbances")
    parser.add_argument("--turn-deg", type=float, nargs="+", default=[20.0, 60.0, 180.0])
    parser.add_argument("--off", type=float, nargs="+", default=[0.0, 0.2, 1.0, 3.0])
    parser.add_argument("--rendered", action="store_true", help="images, which are tracked")
    options = parser.parse_args()
    if options.rendered:
        main_rendered(range(options.first, options.first + options.seeds), options.off)
        return
    print("| rig | turn | off by | degrees | mm | focal, % | pose, degrees | pose, mm | NEES | said, degrees | share |")
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    body = box((0.24, 0.18, 0.2))
    for (name, rig), degrees, off in product(RIGS.items(), options.turn_deg, options.off):
        rows = []
        for seed in range(options.first, options.first + options.seeds):
            true, told = path(options.frames, degrees), disturbed(rig, off, seed)
            seen = seen_as(tracks(body, true, rig, options.features, 0.3, seed), rig, told)
            doubt = as_disturbed(told, off) if options.matched else usual_doubt(told)
            given, refined = (bundle(told, seen, true, body.radius, doubt=doubt, recalibrate=r) for r in (False, True))
            assert refined.correction is not None
            both = ((given, told), (refined, refined.correction.rig))
            row = [scored(found.world_from_object, found.covariance, now, rig, true) for found, now in both]
            sd = np.rad2deg(np.sqrt((refined.correction.sd[:, :3] ** 2).sum(axis=1).mean()))
            rows.append([*np.concatenate(row), sd, given.doubt_shares[1]])
        before, after, (sd, share) = np.split(np.mean(rows, axis=0), [6, 12])
        cells = " | ".join(f"{a:.3g} → {b:.2g}" for a, b in zip(before, after, strict=True))
        print(f"| {name} | {degrees:g}° | {off:g}° | {cells} | {sd:.2g} | {share:.2f} |", flush=True)


if __name__ == "__main__":
    main()
