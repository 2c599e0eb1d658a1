"""Depth bias of the estimators that ignore depth: consistency of their covariances.

    python benchmarks/depth_bias.py [--seeds 40] [--first 0] [--shared ../shared]

Synthetic scenes are those of benchmarks/depth_plane.py: 60 matches per camera, 0.5 px, a body of random orientation that
rotates about a random axis. NEES is the squared rotation error in units of the covariance, mean 3 for a consistent one;
"noise" is the covariance of the noise alone, as if depth were uncorrelated with the image. The recordings follow. For
adjacent frames, the better of each camera's two mirrored solutions is compared with the solution of all cameras. For whole
trajectories, NEES has six unknowns and mean 6. Prints Markdown tables.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.depth_plane import (
    BODIES,
    Problem,
    make_ring_rig,
    match_recording,
    rotation_angle_deg,
    simulate_problem,
)
from benchmarks.live import compute_error_vector, load_scene
from sylpose import open_session, track
from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.rig import Rig
from sylpose.simulate import arc, dome, ring
from sylpose.status import Status
from sylpose.sylvester.centralized import CentralizedSolution, solve_centralized
from sylpose.sylvester.one_camera import solve_one_camera

RIGS: dict[str, Rig] = {
    "ring of 4": make_ring_rig(4),
    "ring of 8": make_ring_rig(8),
    "ring of 16": make_ring_rig(16),
    "dome of 4": dome(4),
    "dome of 16": dome(16),
    "arc of 4, 0.3 m above and below": arc(4, 30.0, height=[0.3, -0.3, 0.3, -0.3]),
    "level ring of 4": ring(4),
    "level ring of 16": ring(16),
    "level arc of 4, as in temple": arc(4, 38.0),
    "level arc of 3": arc(3, 30.0),
    "2 cameras 60° apart": arc(2, 60.0),
    "2 opposite cameras": make_ring_rig(2),
}
ROTATIONS_DEG = (0.5, 1.0, 2.0, 5.0, 15.0, 40.0)


def compute_rotation_error(solution: CentralizedSolution, truth: FloatArray) -> FloatArray:
    """Return the rotation error as a rotation vector (3,)."""
    return np.asarray(Rotation.from_matrix(truth @ solution.rotation.T).as_rotvec())


def format_row(name: str, problems: Sequence[Problem]) -> str:
    """Solve problems and format their table row."""
    found = [(solve_centralized(p.rotations, p.moments), p.truth) for p in problems]
    errors = [compute_rotation_error(s, truth) for s, truth in found]
    angles = np.degrees(np.linalg.norm(errors, axis=1))
    sd = [np.degrees(np.sqrt(1 / max(np.linalg.eigvalsh(s.information)[0], 1e-9))) for s, _ in found]
    noise = [w @ s.noise_information @ w for (s, _), w in zip(found, errors, strict=True)]
    nees = np.array([w @ s.information @ w for (s, _), w in zip(found, errors, strict=True)])
    ok = np.array([s.status is Status.OK for s, _ in found])
    n_unobservable = sum(s.status is Status.ROTATION_NOT_OBSERVABLE for s, _ in found)
    ok_text = f"{nees[ok].mean():.1f}, {nees[ok].max():.1f}" if ok.any() else ""
    certified = sum(s.certified for s, _ in found)
    return (
        f"| {name} | {np.median(angles):.2f}, {angles.max():.1f} | {np.median(sd):.2f} | {np.mean(noise):.0f} | "
        f"{nees.mean():.1f}, {nees.max():.0f} | {ok_text} | {certified}, {ok.sum()}, {n_unobservable} of {len(found)} |"
    )


def print_table(title: str, rows: Sequence[tuple[str, Sequence[Problem]]]) -> None:
    print(f"\n### {title}\n")
    print(
        "| scene | rotation error, deg: median, worst | sd, deg | NEES, noise | NEES: mean, worst | NEES of OK: mean, worst "
        "| certified, OK, rotation unobservable |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, problems in rows:
        print(format_row(name, problems), flush=True)


def print_single_cameras(name: str, pairs: Sequence[tuple[Rig, list[PairMoments], FloatArray]]) -> None:
    """Compare each camera's solution, the better of its two mirrored ones, with that of all cameras."""
    single_errors, joint_errors = [], []
    for rig, moments, truth in pairs:
        Q = np.array([camera.rotation for camera in rig])
        joint_errors.append(rotation_angle_deg(solve_centralized(Q, moments).rotation, truth))
        answers = [solve_one_camera(q, m).rotations for q, m in zip(Q, moments, strict=True) if m.count >= 5]
        single_errors.append(
            [min(rotation_angle_deg(R, truth) for R in mirrored) for mirrored in answers]
            + [np.inf] * (len(Q) - len(answers))
        )
    n_better = (np.array(single_errors) < np.array(joint_errors)[:, None]).sum(axis=0)
    n_any_better = (np.min(single_errors, axis=1) < joint_errors).sum()
    single_medians = np.round(np.median(single_errors, axis=0), 1).tolist()
    print(
        f"| {name} | {np.median(joint_errors):.2f} | {single_medians} | "
        f"{n_better.tolist()} | {n_any_better} | {len(pairs)} |",
        flush=True,
    )


def track_and_format(name: str, method: str, shared: Path) -> str:
    """Track a recording and format its table row."""
    scene = load_scene(name, shared / "data")
    poses = [t.pose for t in track(scene.frames, scene.rig, scene.boxes, method=method)]
    first = next(k for k, pose in enumerate(poses) if pose.is_measured)
    with_pose = [k for k, pose in enumerate(poses) if k > first and pose.world_from_object is not None]
    e = np.array([compute_error_vector(scene, first, poses[first], k, poses[k]) for k in with_pose])
    C = np.array([poses[k].covariance for k in with_pose])
    nees = np.einsum("ki,ki->k", e, np.linalg.solve(C, e[..., None])[..., 0])
    rotation_nees = np.einsum("ki,ki->k", e[:, :3], np.linalg.solve(C[:, :3, :3], e[:, :3, None])[..., 0])
    sd = np.degrees(np.sqrt(np.linalg.eigvalsh(C[:, :3, :3])[:, -1]))
    angles = np.degrees(np.linalg.norm(e[:, :3], axis=1))
    status = ", ".join(
        f"{sum(poses[k].status is s for k in with_pose)} {s.value}" for s in {poses[k].status for k in with_pose}
    )
    return (
        f"| {name} | {method} | {status} | {np.median(angles):.1f}, {angles.max():.1f} | "
        f"{np.median(sd):.1f}, {sd.max():.1f} | {nees.mean():.1f}, {nees.max():.1f} | {rotation_nees.mean():.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[2] / "shared")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)

    def simulate_problems(rig: Rig, body: str, turn_deg: float) -> list[Problem]:
        return [simulate_problem(seed, rig, BODIES[body], turn_deg, epipolar=False) for seed in seeds]

    four = RIGS["ring of 4"]
    print_table(
        "Rotation angles, ring of 4",
        [(f"{b}, {t}°", simulate_problems(four, b, t)) for b in ("ellipsoid", "box", "plane") for t in ROTATIONS_DEG],
    )
    print_table("Sphere", [("sphere, 5°", simulate_problems(four, "sphere", 5.0))])
    print_table(
        "Rigs",
        [
            (f"{r}, {b}, 6°", simulate_problems(rig, b, 6.0))
            for r, rig in RIGS.items()
            for b in ("ellipsoid", "box", "plane")
        ],
    )
    if not (options.shared / "data").exists():
        return
    print("\n### Single cameras\n")
    print(
        "| recording | all cameras: median error, deg | single cameras: median error, deg "
        "| pairs in which each is better | pairs in which any is better | pairs |"
    )
    print("|---|---|---|---|---|---|")
    pairs_of = {}
    for name, every in (("temple", 1), ("board4", 1)):
        found = match_recording(
            open_session(options.shared / "data" / name), options.shared / "data" / name / "groundtruth.tum", every
        )
        pairs_of[name] = [(rig, [PairMoments.from_matches(m.x, m.y) for m in ms], truth) for rig, ms, truth in found]
        print_single_cameras(name, pairs_of[name])
    rows = {
        name: [Problem(np.array([c.rotation for c in rig]), moments, truth) for rig, moments, truth in pairs]
        for name, pairs in pairs_of.items()
    }
    print_table("Adjacent frames of the recordings", list(rows.items()))
    print("\n### Trajectories\n")
    print(
        "| recording | method | frames | rotation error, deg: median, worst | reported sd, deg: median, worst "
        "| NEES: mean, worst | rotation NEES |"
    )
    print("|---|---|---|---|---|---|---|")
    for name in ("temple", "board4", "demo:0"):
        print(track_and_format(name, "sylvester", options.shared), flush=True)


if __name__ == "__main__":
    main()
