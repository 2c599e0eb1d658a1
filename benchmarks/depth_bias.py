"""What surfaces do to the estimators that ignore depth: do their covariances hold?

    python benchmarks/depth_bias.py [--seeds 40] [--first 0] [--shared ../shared]

Prints Markdown tables. Synthetic scenes as in benchmarks/depth_plane.py: 60 matches per camera, 0.5 px, a body of any
orientation that turns about any axis. NEES is the squared error of the turn in units of the covariance, 3 in the mean
where that is right; "noise" counts noise alone, as if depth were uncorrelated with the image. Then the recordings: adjacent
frames, where each camera's better mirrored answer is compared with that of all cameras, and whole trajectories, whose NEES
is of six unknowns and should be 6.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.depth_plane import BODIES, Problem, around, degrees, recorded, synthetic
from benchmarks.live import difference, scene_of
from sylpose import open_session, track
from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.results import Status
from sylpose.rig import Rig
from sylpose.simulate import arc, dome, ring
from sylpose.sylvester.centralized import CentralizedSolution, solve_centralized
from sylpose.sylvester.one_camera import solve_one_camera

RIGS: dict[str, Rig] = {
    "4 around": around(4),
    "8 around": around(8),
    "16 around": around(16),
    "dome of 4": dome(4),
    "dome of 16": dome(16),
    "4 on an arc, 0.3 m above and below": arc(4, 30.0, height=[0.3, -0.3, 0.3, -0.3]),
    "ring of 4, level": ring(4),
    "ring of 16, level": ring(16),
    "4 on a level arc, as temple's": arc(4, 38.0),
    "3 on a level arc": arc(3, 30.0),
    "2, 60° apart": arc(2, 60.0),
    "2, opposite": around(2),
}
TURNS = (0.5, 1.0, 2.0, 5.0, 15.0, 40.0)


def off(solution: CentralizedSolution, truth: FloatArray) -> FloatArray:
    """(3,) w by which a rotation is off."""
    return np.asarray(Rotation.from_matrix(truth @ solution.rotation.T).as_rotvec())


def row(name: str, problems: Sequence[Problem]) -> str:
    """One line of the tables."""
    found = [(solve_centralized(p.rotations, p.moments), p.truth) for p in problems]
    errors = [off(s, truth) for s, truth in found]
    angles = np.degrees(np.linalg.norm(errors, axis=1))
    sd = [np.degrees(np.sqrt(1 / max(np.linalg.eigvalsh(s.information)[0], 1e-9))) for s, _ in found]
    noise = [w @ s.noise_information @ w for (s, _), w in zip(found, errors, strict=True)]
    nees = np.array([w @ s.information @ w for (s, _), w in zip(found, errors, strict=True)])
    ok = np.array([s.status is Status.OK for s, _ in found])
    unseen = sum(s.status is Status.TURN_NOT_OBSERVABLE for s, _ in found)
    of_ok = f"{nees[ok].mean():.1f}, {nees[ok].max():.1f}" if ok.any() else ""
    certified = sum(s.certified for s, _ in found)
    return (
        f"| {name} | {np.median(angles):.2f}, {angles.max():.1f} | {np.median(sd):.2f} | {np.mean(noise):.0f} | "
        f"{nees.mean():.1f}, {nees.max():.0f} | {of_ok} | {certified}, {ok.sum()}, {unseen} of {len(found)} |"
    )


def table(title: str, rows: Sequence[tuple[str, Sequence[Problem]]]) -> None:
    print(f"\n### {title}\n")
    print(
        "| scene | degrees: median, worst | sd | NEES, noise | NEES: mean, worst | of OK | certified, OK, turn not seen |"
    )
    print("|---|---|---|---|---|---|---|")
    for name, problems in rows:
        print(row(name, problems), flush=True)


def alone(name: str, pairs: Sequence[tuple[Rig, list[PairMoments], FloatArray]]) -> None:
    """Each camera's own answer, the better of the two mirrored ones, against that of all."""
    better, together = [], []
    for rig, moments, truth in pairs:
        Q = np.array([camera.rotation for camera in rig])
        together.append(degrees(solve_centralized(Q, moments).rotation, truth))
        answers = [solve_one_camera(q, m).rotations for q, m in zip(Q, moments, strict=True) if m.count >= 5]
        better.append([min(degrees(R, truth) for R in two) for two in answers] + [np.inf] * (len(Q) - len(answers)))
    wins = (np.array(better) < np.array(together)[:, None]).sum(axis=0)
    best = (np.min(better, axis=1) < together).sum()
    own = np.round(np.median(better, axis=0), 1).tolist()
    print(f"| {name} | {np.median(together):.2f} | {own} | {wins.tolist()} | {best} | {len(pairs)} |", flush=True)


def followed(name: str, method: str, shared: Path) -> str:
    """One trajectory."""
    scene = scene_of(name, shared / "data")
    poses = [t.pose for t in track(scene.frames, scene.rig, scene.boxes, method=method)]
    first = next(k for k, pose in enumerate(poses) if pose.measured)
    have = [k for k, pose in enumerate(poses) if k > first and pose.world_from_object is not None]
    e = np.array([difference(scene, first, poses[first], k, poses[k]) for k in have])
    C = np.array([poses[k].covariance for k in have])
    nees = np.einsum("ki,ki->k", e, np.linalg.solve(C, e[..., None])[..., 0])
    of_turn = np.einsum("ki,ki->k", e[:, :3], np.linalg.solve(C[:, :3, :3], e[:, :3, None])[..., 0])
    sd = np.degrees(np.sqrt(np.linalg.eigvalsh(C[:, :3, :3])[:, -1]))
    angles = np.degrees(np.linalg.norm(e[:, :3], axis=1))
    status = ", ".join(f"{sum(poses[k].status is s for k in have)} {s.value}" for s in {poses[k].status for k in have})
    return (
        f"| {name} | {method} | {status} | {np.median(angles):.1f}, {angles.max():.1f} | "
        f"{np.median(sd):.1f}, {sd.max():.1f} | {nees.mean():.1f}, {nees.max():.1f} | {of_turn.mean():.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--shared", type=Path, default=Path(__file__).parents[2] / "shared")
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)

    def scenes(rig: Rig, body: str, turn_deg: float) -> list[Problem]:
        return [synthetic(seed, rig, BODIES[body], turn_deg, epipolar=False) for seed in seeds]

    four = RIGS["4 around"]
    table("Turns, 4 around", [(f"{b}, {t}°", scenes(four, b, t)) for b in ("ellipsoid", "box", "plane") for t in TURNS])
    table("Sphere", [("sphere, 5°", scenes(four, "sphere", 5.0))])
    table(
        "Rigs",
        [(f"{r}, {b}, 6°", scenes(rig, b, 6.0)) for r, rig in RIGS.items() for b in ("ellipsoid", "box", "plane")],
    )
    if not (options.shared / "data").exists():
        return
    print("\n### Each camera alone\n")
    print(
        "| recording | all: median | each alone, its better answer | better than all, pairs | the best of them | pairs |"
    )
    print("|---|---|---|---|---|---|")
    pairs_of = {}
    for name, every in (("temple", 1), ("board4", 1)):
        found = recorded(
            open_session(options.shared / "data" / name), options.shared / "data" / name / "groundtruth.tum", every
        )
        pairs_of[name] = [(rig, [PairMoments.from_matches(m.x, m.y) for m in ms], truth) for rig, ms, truth in found]
        alone(name, pairs_of[name])
    rows = {
        name: [Problem(np.array([c.rotation for c in rig]), moments, truth) for rig, moments, truth in pairs]
        for name, pairs in pairs_of.items()
    }
    table("Adjacent frames of the recordings", list(rows.items()))
    print("\n### Trajectories\n")
    print(
        "| recording | method | frames | degrees: median, worst | said: median, worst | NEES: mean, worst | of the turn |"
    )
    print("|---|---|---|---|---|---|---|")
    for name in ("temple", "board4", "demo:0"):
        for method in ("sylvester", "one-camera", "unconstrained") if name != "demo:0" else ("sylvester",):
            print(followed(name, method, options.shared), flush=True)


if __name__ == "__main__":
    main()
