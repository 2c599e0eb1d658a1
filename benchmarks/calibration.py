"""Reduction of calibration errors by `--refine-calibration`, on perturbed rigs with known truth.

    python benchmarks/calibration.py [--seeds 4] [--turn-deg 0 20 60 180] [--off 0 0.2 1 3] [--features 60] [--matched]
    python benchmarks/calibration.py --rendered [--seeds 4] [--off 0 0.2 1 3]

Simulated tracks of a moving body, seen by the true rig, are solved with a perturbed rig. The perturbations have standard
deviations of `--off` degrees about each axis, 3 mm, 1 % of the focal length, 5 px of the principal point and 0.02 of the
radial coefficient. Each row gives, before and after the refinement: the RMS errors of the camera rotations and positions
after the best common similarity, of the focal lengths and of the last pose, and the median NEES of the poses. It also gives
the reported standard deviation of the refined rotations, and the estimated rotation errors as a share of the prior. With
--matched the prior equals the true perturbations.

With --rendered, rendered images of a block that rotates by 70 degrees are tracked with the perturbed rig; neighboring
features then have correlated errors. The cells are median (worst) over the seeds; for an exact rig, the last cell is the RMS
of the corrections in their standard deviations.
"""

from __future__ import annotations

import argparse
from itertools import product

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.translation_only import compute_pose_error, simulate_tracks
from sylpose import FrameSet, track
from sylpose.bundle_adjustment.bundle import BundleOptions, Observations, bundle_adjust
from sylpose.bundle_adjustment.calibration_refinement import CalibrationPrior, correct_rig, default_calibration_prior
from sylpose.frames import Box
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.simulate import arc, box, compute_demo_truth, make_demo_scene, render_frames, ring
from sylpose.smoothing import Track, smooth_tracks

LENS = (-0.11, 0.03, 0.0004, -0.0003, 0)
RIGS = {
    "ring of 4": ring(4, 1.5, 1000.0, height=(0.4, -0.1, 0.2, 0.5), distortion=LENS),
    "4 in 120°": arc(4, 40.0, 1.5, 1000.0, height=(0.3, -0.1, 0.2, 0.1), distortion=LENS),
    "2 in 40°": arc(2, 40.0, 1.5, 1000.0, height=(0.2, -0.1), distortion=LENS),
}


def simulate_poses(frames: int, degrees: float) -> RigidTransform:
    """Return poses with a rotation about a varying axis and a translation of about the object's length."""
    s = np.linspace(0.0, 1.0, frames)[:, None]
    wave = np.deg2rad(degrees) * 0.3 * np.hstack([np.sin(6 * s), 0 * s, 1 - np.cos(5 * s)])
    rotation = Rotation.from_rotvec(wave) * Rotation.from_rotvec(np.deg2rad(degrees) * s * np.array([0.25, 0.9, 0.35]))
    position = 0.12 * np.hstack([s, 0.6 * np.sin(4 * s), 0.7 * np.sin(6 * s)])
    poses = RigidTransform.from_components(position, rotation)
    return poses * poses[0].inv()


def perturb_rig(rig: Rig, degrees: float, seed: int) -> Rig:
    """Perturb a rig by random errors: `degrees` of rotation, and the other parameters in proportion up to 1 degree."""
    rng, n, share = np.random.default_rng(seed), len(rig), min(degrees, 1.0)
    sizes = np.concatenate([np.full(3, np.deg2rad(degrees)), share * np.array([0.003] * 3 + [0.01, 5.0, 5.0, 0.02])])
    return correct_rig(rig, np.hstack([np.zeros((n, 4)), sizes * rng.standard_normal((n, 10))]))


def make_matched_prior(rig: Rig, degrees: float) -> CalibrationPrior:
    """Return the prior that matches the errors of `perturb_rig`."""
    degrees, n = max(degrees, 1e-6), len(rig)  # a prior needs a positive standard deviation
    share = min(degrees, 1.0)
    lens = np.tile(share * np.array([0.01, 5.0, 5.0, 0.02]), (n, 1))
    return CalibrationPrior(np.full(n, np.deg2rad(degrees)), np.full(n, 0.003 * share), lens, np.full(n, -1))


def normalize_by(observations: Observations, rig: Rig, perturbed_rig: Rig) -> Observations:
    """Normalize the same pixels by another calibration."""
    image = observations.image.copy()
    for c, (true, other) in enumerate(zip(rig, perturbed_rig, strict=True)):
        of_camera = observations.camera == c
        image[of_camera] = other.normalize(true.denormalize(image[of_camera]))
    return Observations(observations.frame, observations.camera, observations.landmark, image)


def align_rigs(rig: Rig, truth: Rig) -> tuple[float, Rotation, FloatArray, FloatArray]:
    """Align a rig with the true one by a similarity; return scale, rotation, translation, and residuals (C, 2): deg, mm.

    The rotation comes from the camera axes, so that two cameras suffice.
    """
    rotations = Rotation.concatenate(
        [t.camera_from_world.rotation.inv() * c.camera_from_world.rotation for c, t in zip(rig, truth, strict=True)]
    )
    mean = rotations.mean()
    centers, true = mean.apply(np.array([c.center for c in rig])), np.array([c.center for c in truth])
    a, b = centers - centers.mean(axis=0), true - true.mean(axis=0)
    scale = float((a * b).sum() / (a * a).sum())
    translation = true.mean(axis=0) - scale * centers.mean(axis=0)
    residual_deg = np.rad2deg((mean.inv() * rotations).magnitude())
    return (
        scale,
        mean,
        translation,
        np.column_stack([residual_deg, 1e3 * np.linalg.norm(scale * centers + translation - true, axis=1)]),
    )


def compute_pose_errors(found: RigidTransform, rig: Rig, truth: Rig, true: RigidTransform) -> FloatArray:
    """Return errors (N, 6) of poses estimated with a rig, in the true world after the best common similarity."""
    scale, rotation, translation, _ = align_rigs(rig, truth)
    out = []
    for k in range(len(true)):
        # The motion since the first frame, in the true world.
        now, first = found[k], found[0]
        moved = now * first.inv()
        w = rotation * moved.rotation * rotation.inv()
        t = scale * rotation.apply(moved.translation) + translation - w.apply(translation)
        aligned = RigidTransform.from_components(t, w) * true[0]
        out.append(compute_pose_error(true[k], aligned))
    return np.array(out)


def score_calibration(
    found: RigidTransform, covariance: FloatArray, estimated_rig: Rig, rig: Rig, true: RigidTransform
) -> FloatArray:
    """Score a calibration and the poses (N) with covariances (N, 6, 6) that were estimated with it.

    Returns:
        (6,) RMS errors of the cameras (degrees, mm, focal length in percent), errors of the last pose (degrees, mm), and
        the median NEES.
    """
    camera_errors = np.sqrt((align_rigs(estimated_rig, rig)[3] ** 2).mean(axis=0))
    focal = 100 * np.sqrt(np.mean([(a.focal / b.focal - 1) ** 2 for a, b in zip(estimated_rig, rig, strict=True)]))
    e = compute_pose_errors(found, estimated_rig, rig, true)
    nees = [x @ np.linalg.solve(c, x) for x, c in zip(e[1:], covariance[1:], strict=True)]
    last = [np.rad2deg(np.linalg.norm(e[-1, :3])), 1e3 * np.linalg.norm(e[-1, 3:])]
    return np.array([*camera_errors, focal, *last, np.median(nees)])


def track_rendered(seed: int, degrees: float, frames: int = 60) -> tuple[list[Track], Rig, Rig, RigidTransform]:
    """Track rendered images with a perturbed rig; return tracks, that rig, the true rig and the true poses."""
    scene = make_demo_scene(frames=frames, angle_deg=70.0, size=(320, 240), n_cameras=4, seed=seed)
    truth, no_values = compute_demo_truth(scene), (None,) * len(scene.rig)
    perturbed = perturb_rig(scene.rig, degrees, seed) if degrees else scene.rig
    sets = (FrameSet(k, k / 30, no_values, images, no_values) for k, images in enumerate(render_frames(scene)))
    boxes = {name: Box(*box) for name, box in truth.boxes.items()}
    return [Track.from_tracked(f) for f in track(sets, perturbed, boxes)], perturbed, scene.rig, truth.world_from_object


def score_rendered(seed: int, degrees: float) -> FloatArray:
    """Score the perturbed and the refined rig on rendered images.

    Returns:
        (14,) `score_calibration` of both rigs, the reported standard deviation of the refined rotations in degrees, and
        the RMS of the corrections in their standard deviations.
    """
    tracks, perturbed, rig, true = track_rendered(seed, degrees)
    rows = []
    for recalibrate in (False, True):
        smoothed = smooth_tracks(
            tracks, perturbed, calibration_prior=default_calibration_prior(perturbed), recalibrate=recalibrate
        )
        poses = [pose for pose in smoothed.poses if pose.is_measured]
        found = RigidTransform.concatenate([p.world_from_object for p in poses if p.world_from_object is not None])
        refined_rig = perturbed if smoothed.correction is None else smoothed.correction.rig.subset(rig.names)
        covariance = np.array([pose.covariance for pose in poses])
        rows.append(score_calibration(found, covariance, refined_rig, rig, true[[pose.index for pose in poses]]))
    assert smoothed.correction is not None
    values, sd = smoothed.correction.values[: len(rig)], smoothed.correction.sd[: len(rig)]
    reported_sd = np.rad2deg(np.sqrt((sd[:, :3] ** 2).sum(axis=1).mean()))
    return np.array([*rows[0], *rows[1], reported_sd, np.sqrt(((values / sd) ** 2).mean())])


def print_rendered_table(seeds: range, off: list[float]) -> None:
    print(
        "| calibration error | cameras, deg | cameras, mm | focal length, % | last pose, deg | last pose, mm | NEES "
        "| reported sd, deg | corrections, sd |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for degrees in off:
        rows = np.array([score_rendered(seed, degrees) for seed in seeds])
        middle, worst = ([f"{x:.2g}" for x in statistic(rows, axis=0)] for statistic in (np.median, np.max))
        median_and_worst = [f"{m} ({w})" for m, w in zip(middle, worst, strict=True)]
        cells = [f"{a} → {b}" for a, b in zip(median_and_worst[:6], median_and_worst[6:12], strict=True)]
        print(
            f"| {degrees:g}° | {' | '.join([*cells, median_and_worst[12], '' if degrees else median_and_worst[13]])} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--features", type=int, default=60, help="number per camera")
    parser.add_argument("--matched", action="store_true", help="use a prior that matches the perturbations")
    parser.add_argument("--turn-deg", type=float, nargs="+", default=[20.0, 60.0, 180.0])
    parser.add_argument("--off", type=float, nargs="+", default=[0.0, 0.2, 1.0, 3.0])
    parser.add_argument("--rendered", action="store_true", help="track rendered images")
    options = parser.parse_args()
    if options.rendered:
        print_rendered_table(range(options.first, options.first + options.seeds), options.off)
        return
    print(
        "| rig | rotation | calibration error | cameras, deg | cameras, mm | focal length, % | last pose, deg "
        "| last pose, mm | NEES | reported sd, deg | error / prior |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|")
    body = box((0.24, 0.18, 0.2))
    for (name, rig), degrees, off in product(RIGS.items(), options.turn_deg, options.off):
        rows = []
        for seed in range(options.first, options.first + options.seeds):
            true, perturbed = simulate_poses(options.frames, degrees), perturb_rig(rig, off, seed)
            observations = normalize_by(simulate_tracks(body, true, rig, options.features, 0.3, seed), rig, perturbed)
            prior = make_matched_prior(perturbed, off) if options.matched else default_calibration_prior(perturbed)
            given, refined = (
                bundle_adjust(
                    perturbed, observations, true, body.radius, BundleOptions(calibration_prior=prior, recalibrate=r)
                )
                for r in (False, True)
            )
            assert refined.correction is not None
            solutions = ((given, perturbed), (refined, refined.correction.rig))
            row = [
                score_calibration(found.corrected_poses, found.covariance, now, rig, true) for found, now in solutions
            ]
            sd = np.rad2deg(np.sqrt((refined.correction.sd[:, :3] ** 2).sum(axis=1).mean()))
            rows.append([*np.concatenate(row), sd, given.calibration_scale])
        before, after, (sd, share) = np.split(np.mean(rows, axis=0), [6, 12])
        cells = " | ".join(f"{a:.3g} → {b:.2g}" for a, b in zip(before, after, strict=True))
        print(f"| {name} | {degrees:g}° | {off:g}° | {cells} | {sd:.2g} | {share:.2f} |", flush=True)


if __name__ == "__main__":
    main()
