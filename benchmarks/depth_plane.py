"""The depth plane against depth ignored: errors, covariance and time on synthetic scenes and on the real recordings.

    python benchmarks/depth_plane.py [--seeds 40] [--shared ../shared]

Prints Markdown tables. Synthetic scenes: 60 matches per camera, 0.5 px, f = 1000 px, 1.5 m, an object of 0.15 m of any
orientation that turns about any axis and moves by 20 mm. Real recordings: SIFT matches between frames within each
camera, inliers of `estimate_motion`; on board4 the object's region follows the ground truth. NEES is the squared error in
units of the covariance: 3 on average where the covariance is right. Only solutions that `status` calls OK count as such;
the errors are of all.
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
from sylpose.capture import Session
from sylpose.features.sift import Features, detect, match_features
from sylpose.geometry.arrays import FloatArray
from sylpose.matches import Matches
from sylpose.moments import PairMoments
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.simulate import Body, arc, box, ellipsoid, plane, random_motion, ring, simulate_matches
from sylpose.sylvester.centralized import solve_centralized
from sylpose.sylvester.depth_plane import DepthPlaneSolution, solve_depth_plane
from sylpose.tracking.region import polygon_mask, region_polygon, volume_from_boxes

BODIES = {
    "sphere": ellipsoid((0.15, 0.15, 0.15)),
    "ellipsoid": ellipsoid((0.15, 0.12, 0.1)),
    "box": box(),
    "plane": plane(),
}


class Problem(NamedTuple):
    """Rotations of the cameras, their moments, the true rotation, and the epipolar solver's if it was asked."""

    rotations: FloatArray
    moments: list[PairMoments]
    truth: FloatArray
    epipolar: FloatArray | None = None


def around(n: int) -> Rig:
    """`n` cameras around the object, alternately above and below it."""
    return ring(n, height=[0.4 * (-1) ** k for k in range(n)])


def synthetic(seed: int, rig: Rig, body: Body, turn_deg: float, *, epipolar: bool = True) -> Problem:
    """One scene."""
    rng = np.random.default_rng(seed)
    motion = random_motion(turn_deg, 0.02, rng)
    start = RigidTransform.from_rotation(Rotation.random(rng=rng))
    matches = simulate_matches(rig, body, motion, rng=rng, start=start).matches
    return _problem(rig, matches, motion.rotation.as_matrix(), epipolar)


def _problem(rig: Rig, matches: Sequence[Matches], truth: FloatArray, epipolar: bool) -> Problem:
    found = estimate_motion(rig, matches).motion if epipolar else None
    return Problem(
        np.array([camera.rotation for camera in rig]),
        [PairMoments.from_matches(m.x, m.y) for m in matches],
        truth,
        None if found is None else found.rotation.as_matrix(),
    )


def modelled(seed: int) -> Problem:
    """Four orthographic cameras that each see a tilted plane with relief: what the model describes."""
    rng = np.random.default_rng(seed)
    rotations, moments = np.asarray(Rotation.random(4, rng=rng).as_matrix()), []
    truth = random_motion(5.0, 0.0, rng).rotation.as_matrix()
    for q in rotations:
        x = 0.05 * rng.standard_normal((60, 2))
        points = np.column_stack([x, x @ rng.uniform(-1, 1, 2) + 0.01 * rng.standard_normal(60)])
        y = (points @ (q @ truth @ q.T).T)[:, :2]
        moments.append(PairMoments.from_matches(*(p + 5e-4 * rng.standard_normal(p.shape) for p in (x, y))))
    return Problem(rotations, moments, truth)


def recorded(session: Session, truth: Path, every: int) -> list[tuple[Rig, list[Matches], FloatArray]]:
    """Inlying matches between every so many frames, and the true rotations."""
    rows = np.loadtxt(truth)
    poses = [RigidTransform.from_components(row[1:4], Rotation.from_quat(row[4:])) for row in rows]
    volume = volume_from_boxes(session.rig, session.boxes)[1] if session.boxes else None
    out: list[tuple[Rig, list[Matches], FloatArray]] = []
    before: list[Features] = []
    last = RigidTransform.identity()
    for frames in session.frames(every=every):
        pose = poses[int(np.argmin(np.abs(rows[:, 0] - frames.time)))]
        now = []
        for camera, image in zip(session.rig, frames.images, strict=True):
            mask = None
            if volume is not None:
                outline = region_polygon(camera, (pose * poses[0].inv()).apply(volume), 0.05)
                mask = polygon_mask(outline, camera.size)
            now.append(Features.none() if image is None else detect(image, camera, mask))
        if before:
            matches = []
            for a, b in zip(before, now, strict=True):
                pairs = match_features(a, b)
                matches.append(Matches(a.normalized[pairs[:, 0]], b.normalized[pairs[:, 1]]))
            good = estimate_motion(session.rig, matches).inliers
            kept = [Matches(m.x[i], m.y[i]) for m, i in zip(matches, good, strict=True)]
            out.append((session.rig, kept, (pose.rotation * last.rotation.inv()).as_matrix()))
        before, last = now, pose
    return out


def degrees(a: FloatArray, b: FloatArray) -> float:
    """The angle between two rotations."""
    return float(np.rad2deg(Rotation.from_matrix(a @ b.T).magnitude()))


def nees(solution: DepthPlaneSolution, truth: FloatArray) -> float:
    """The squared error in units of the covariance."""
    error = Rotation.from_matrix(truth @ solution.rotation.T).as_rotvec()
    return float(error @ solution.information @ error)


def row(name: str, problems: Sequence[Problem]) -> str:
    """One line of the tables."""
    plain, plane_errors, epipolar, values, ok, seconds = [], [], [], [], 0, 0.0
    for rotations, moments, truth, perspective in problems:
        start = time.perf_counter()
        solution = solve_depth_plane(rotations, moments)
        seconds += time.perf_counter() - start
        if solution.status is Status.TOO_FEW_MATCHES:
            continue
        plain.append(degrees(solve_centralized(rotations, moments).rotation, truth))
        plane_errors.append(degrees(solution.rotation, truth))
        if perspective is not None:
            epipolar.append(degrees(perspective, truth))
        if solution.status is Status.OK:
            ok += 1
            values.append(nees(solution, truth))
    of_epipolar = f"{np.median(epipolar):.2f}" if epipolar else ""
    of_nees = f"{np.mean(values):.1f} / {np.median(values):.1f}" if values else ""
    return (
        f"| {name} | {np.median(plain):.2f} | {np.median(plane_errors):.3f} | {np.quantile(plane_errors, 0.9):.2f} | "
        f"{max(plane_errors):.2f} | {of_epipolar} | {of_nees} | "
        f"{ok} of {len(problems)} | {1e3 * seconds / len(problems):.0f} |"
    )


def table(title: str, rows: Sequence[tuple[str, Sequence[Problem]]]) -> None:
    """Prints one, line by line."""
    print(f"\n### {title}\n")
    print(
        "| scene | depth ignored, median degrees | depth plane: median | 90 % | worst | epipolar solver: median "
        "| NEES: mean / median | OK | ms |\n|---|---|---|---|---|---|---|---|---|"
    )
    for name, problems in rows:
        print(row(name, problems), flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[2] / "shared")
    options = parser.parse_args()
    seeds = range(options.seeds)

    def scenes(rig: Rig, body: str, turn_deg: float = 5.0) -> list[Problem]:
        return [synthetic(seed, rig, BODIES[body], turn_deg) for seed in seeds]

    table(
        "Turns, 4 cameras around an ellipsoid",
        [(f"{t}°", scenes(around(4), "ellipsoid", t)) for t in (1, 2, 5, 10, 15)],
    )
    table("Bodies, 4 cameras, 5°", [(body, scenes(around(4), body)) for body in BODIES])
    rigs = {f"{n} around": around(n) for n in (2, 3, 8)} | {"2, 60° apart": arc(2, 60), "3, 30° apart": arc(3, 30)}
    table("Rigs, ellipsoid, 5°", [(name, scenes(rig, "ellipsoid")) for name, rig in rigs.items()])
    table("Rigs, box, 5°", [(name, scenes(rig, "box")) for name, rig in rigs.items()])

    model = [modelled(seed) for seed in range(4 * options.seeds)]
    solutions = [solve_depth_plane(p.rotations, p.moments, aim=False) for p in model]
    values = [nees(s, p.truth) for s, p in zip(solutions, model, strict=True) if s.status is Status.OK]
    print(
        f"\nScenes that fit the model (planes with relief, orthographic, 5°): NEES {np.mean(values):.2f} (mean), ",
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
        pairs = recorded(open_session(folder), folder / "groundtruth.tum", every)
        rows = []
        for cameras in choices:
            of = [int(c) for c in cameras]
            problems = [
                _problem(Rig([rig.cameras[c] for c in of], rig.unit), [m[c] for c in of], truth, True)
                for rig, m, truth in pairs
            ]
            rows.append((f"cameras {', '.join(cameras)}", problems))
        table(f"{name}, {len(pairs)} pairs of frames, {every} apart", rows)


if __name__ == "__main__":
    main()
