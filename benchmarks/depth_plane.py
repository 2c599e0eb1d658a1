"""Depth plane compared with depth ignored: errors, covariance and time on synthetic scenes and real recordings.

    python benchmarks/depth_plane.py [--seeds 40] [--shared ../shared]

Synthetic scenes have 60 matches per camera, 0.5 px of noise, f = 1000 px and a distance of 1.5 m. The object of 0.15 m has
a random orientation, rotates about a random axis and translates by 20 mm. Real recordings use SIFT matches between frames
within each camera, restricted to inliers of `estimate_motion`; on board4 the object's region follows the ground truth. NEES
is the squared error in units of the covariance; its mean is 3 for a consistent covariance. NEES covers the solutions with
status OK; the errors cover all solutions. Prints Markdown tables.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import estimate_motion, open_session
from sylpose.features.sift import Features, detect_features, match_features
from sylpose.geometry.arrays import FloatArray
from sylpose.io.capture import Session
from sylpose.matches import Matches
from sylpose.moments import PairMoments
from sylpose.rig import Rig
from sylpose.simulate import Body, arc, box, ellipsoid, plane, random_motion, ring, simulate_matches
from sylpose.status import Status
from sylpose.sylvester.centralized import solve_centralized
from sylpose.sylvester.depth_plane import DepthPlaneSolution, solve_depth_plane
from sylpose.tracking.camera_side.frame import project_outline, rasterize_outline
from sylpose.tracking.joint_side.object_model import carve_box_volume

BODIES = {
    "sphere": ellipsoid((0.15, 0.15, 0.15)),
    "ellipsoid": ellipsoid((0.15, 0.12, 0.1)),
    "box": box(),
    "plane": plane(),
}


class Problem(NamedTuple):
    """Camera rotations (C, 3, 3), moments, true rotation, and the epipolar solver's rotation if it was computed."""

    rotations: FloatArray
    moments: list[PairMoments]
    truth: FloatArray
    epipolar: FloatArray | None = None


def make_ring_rig(n: int) -> Rig:
    """Return a rig of `n` cameras around the object, alternately above and below it."""
    return ring(n, height=[0.4 * (-1) ** k for k in range(n)])


def simulate_problem(seed: int, rig: Rig, body: Body, turn_deg: float, *, epipolar: bool = True) -> Problem:
    """Simulate one scene."""
    rng = np.random.default_rng(seed)
    motion = random_motion(turn_deg, 0.02, rng)
    start = RigidTransform.from_rotation(Rotation.random(rng=rng))
    matches = simulate_matches(rig, body, motion, rng=rng, start=start).matches
    return _make_problem(rig, matches, motion.rotation.as_matrix(), epipolar)


def _make_problem(rig: Rig, matches: Sequence[Matches], truth: FloatArray, epipolar: bool) -> Problem:
    found = estimate_motion(rig, matches).motion if epipolar else None
    return Problem(
        np.array([camera.rotation for camera in rig]),
        [PairMoments.from_matches(m.x, m.y) for m in matches],
        truth,
        None if found is None else found.rotation.as_matrix(),
    )


def simulate_model_problem(seed: int) -> Problem:
    """Simulate what the model assumes: four orthographic cameras that each see a tilted, slightly rough plane."""
    rng = np.random.default_rng(seed)
    rotations, moments = np.asarray(Rotation.random(4, rng=rng).as_matrix()), []
    truth = random_motion(5.0, 0.0, rng).rotation.as_matrix()
    for q in rotations:
        x = 0.05 * rng.standard_normal((60, 2))
        points = np.column_stack([x, x @ rng.uniform(-1, 1, 2) + 0.01 * rng.standard_normal(60)])
        y = (points @ (q @ truth @ q.T).T)[:, :2]
        moments.append(PairMoments.from_matches(*(p + 5e-4 * rng.standard_normal(p.shape) for p in (x, y))))
    return Problem(rotations, moments, truth)


def match_recording(session: Session, truth: Path, every: int) -> list[tuple[Rig, list[Matches], FloatArray]]:
    """Match every `every`-th frame of a recording; return rig, inlier matches and true rotation of each pair."""
    rows = np.loadtxt(truth)
    poses = [RigidTransform.from_components(row[1:4], Rotation.from_quat(row[4:])) for row in rows]
    volume = carve_box_volume(session.rig, session.boxes)[1] if session.boxes else None
    out: list[tuple[Rig, list[Matches], FloatArray]] = []
    previous_features: list[Features] = []
    previous_pose = RigidTransform.identity()
    for frames in session.frames(every=every):
        pose = poses[int(np.argmin(np.abs(rows[:, 0] - frames.time)))]
        features = []
        for camera, image in zip(session.rig, frames.images, strict=True):
            mask = None
            if volume is not None:
                outline = project_outline(camera, (pose * poses[0].inv()).apply(volume), 0.05)
                mask = rasterize_outline(outline, camera.size)
            features.append(Features.empty() if image is None else detect_features(image, camera, mask))
        if previous_features:
            matches = []
            for a, b in zip(previous_features, features, strict=True):
                pairs = match_features(a, b)
                matches.append(Matches(a.normalized[pairs[:, 0]], b.normalized[pairs[:, 1]]))
            inliers = estimate_motion(session.rig, matches).inliers
            inlier_matches = [Matches(m.x[i], m.y[i]) for m, i in zip(matches, inliers, strict=True)]
            out.append((session.rig, inlier_matches, (pose.rotation * previous_pose.rotation.inv()).as_matrix()))
        previous_features, previous_pose = features, pose
    return out


def rotation_angle_deg(a: FloatArray, b: FloatArray) -> float:
    """Return the angle between two rotations in degrees."""
    return float(np.rad2deg(Rotation.from_matrix(a @ b.T).magnitude()))


def compute_nees(solution: DepthPlaneSolution, truth: FloatArray) -> float:
    """Return the squared rotation error in units of the covariance."""
    error = Rotation.from_matrix(truth @ solution.rotation.T).as_rotvec()
    return float(error @ solution.information @ error)


def format_row(name: str, problems: Sequence[Problem]) -> str:
    """Solve problems by all methods and format their table row."""
    ignored_errors, plane_errors, epipolar_errors, values, ok, seconds = [], [], [], [], 0, 0.0
    for rotations, moments, truth, perspective in problems:
        start = time.perf_counter()
        solution = solve_depth_plane(rotations, moments)
        seconds += time.perf_counter() - start
        if solution.status is Status.TOO_FEW_MATCHES:
            continue
        ignored_errors.append(rotation_angle_deg(solve_centralized(rotations, moments).rotation, truth))
        plane_errors.append(rotation_angle_deg(solution.rotation, truth))
        if perspective is not None:
            epipolar_errors.append(rotation_angle_deg(perspective, truth))
        if solution.status is Status.OK:
            ok += 1
            values.append(compute_nees(solution, truth))
    epipolar_text = f"{np.median(epipolar_errors):.2f}" if epipolar_errors else ""
    nees_text = f"{np.mean(values):.1f} / {np.median(values):.1f}" if values else ""
    return (
        f"| {name} | {np.median(ignored_errors):.2f} | {np.median(plane_errors):.3f} | "
        f"{np.quantile(plane_errors, 0.9):.2f} | "
        f"{max(plane_errors):.2f} | {epipolar_text} | {nees_text} | "
        f"{ok} of {len(problems)} | {1e3 * seconds / len(problems):.0f} |"
    )


def print_table(title: str, rows: Sequence[tuple[str, Sequence[Problem]]]) -> None:
    """Print a table row by row."""
    print(f"\n### {title}\n")
    print(
        "| scene | depth ignored: median error, deg | depth plane: median | 90 % | maximum | epipolar solver: median "
        "| NEES: mean / median | OK | ms |\n|---|---|---|---|---|---|---|---|---|"
    )
    for name, problems in rows:
        print(format_row(name, problems), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[2] / "shared")
    options = parser.parse_args()
    seeds = range(options.seeds)

    def simulate_problems(rig: Rig, body: str, turn_deg: float = 5.0) -> list[Problem]:
        return [simulate_problem(seed, rig, BODIES[body], turn_deg) for seed in seeds]

    print_table(
        "Rotation angles, 4 cameras around an ellipsoid",
        [(f"{t}°", simulate_problems(make_ring_rig(4), "ellipsoid", t)) for t in (1, 2, 5, 10, 15)],
    )
    print_table("Object shapes, 4 cameras, 5°", [(body, simulate_problems(make_ring_rig(4), body)) for body in BODIES])
    rigs = {f"{n} cameras on a ring": make_ring_rig(n) for n in (2, 3, 8)} | {
        "2 cameras 60° apart": arc(2, 60),
        "3 cameras 30° apart": arc(3, 30),
    }
    print_table("Rigs, ellipsoid, 5°", [(name, simulate_problems(rig, "ellipsoid")) for name, rig in rigs.items()])
    print_table("Rigs, box, 5°", [(name, simulate_problems(rig, "box")) for name, rig in rigs.items()])

    model = [simulate_model_problem(seed) for seed in range(4 * options.seeds)]
    solutions = [solve_depth_plane(p.rotations, p.moments, aim=False) for p in model]
    values = [compute_nees(s, p.truth) for s, p in zip(solutions, model, strict=True) if s.status is Status.OK]
    print(
        f"\nScenes that satisfy the model (rough planes, orthographic, 5°): NEES {np.mean(values):.2f} (mean), ",
        end="",
    )
    print(f"{np.median(values):.2f} (median; 2.37 expected), {len(values)} of {len(model)} OK.")

    for name, every, choices in (
        ("temple", 1, ("0123", "012", "123", "013", "023", "01", "03")),
        ("board4", 2, ("0123", "012")),
    ):
        folder = options.shared / "data" / name
        if not folder.exists():
            continue
        pairs = match_recording(open_session(folder), folder / "groundtruth.tum", every)
        rows = []
        for cameras in choices:
            indices = [int(c) for c in cameras]
            problems = [
                _make_problem(Rig([rig.cameras[c] for c in indices], rig.unit), [m[c] for c in indices], truth, True)
                for rig, m, truth in pairs
            ]
            rows.append((f"cameras {', '.join(cameras)}", problems))
        print_table(f"{name}, {len(pairs)} pairs, frame distance {every}", rows)


if __name__ == "__main__":
    main()
