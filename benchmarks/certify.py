"""Certificates against the truth: is the error that `sylpose certify` states the true one, or at least never smaller?

    python benchmarks/certify.py [KIND ...] [--seeds 0:2] [--jobs N] [--each] [--list] [--json FILE]
    python benchmarks/certify.py --recording DIR ...
    python benchmarks/certify.py --bar

Each take is rendered, tracked with all cameras, with parts of them and backwards as `sylpose certify` does it, and
certified; the certificate is compared with the true errors of the motion since the first frame with a pose. Recordings need
a groundtruth.tum. Columns, of rotation and of position:

- *True error*: rms over the frames, median of the runs; degrees, and millimeters of the recording's meter (objects of the
  takes have a radius of some 20 cm).
- *Certified / true*: ratio of the certified to the true error: median, least and largest of the runs. Below 1 the
  certificate is optimistic.
- *Bound*: share of the runs whose 95 % bound is above the true error, and the least ratio.
- *Factor / true*: the factor on standard deviations, relative to the one by which they agree with the truth.

--bar renders two textured boxes at the ends of a stiff bar, and prints what `sylpose certify --bar` finds: the truth is a
constant relative pose.

Runs without parts that determine a quantity are not certified and only counted. Kinds named "shared-..." have errors that
all cameras share; a certificate cannot see them. Seeds 0 to 9 are looked at while developing; figures in documents are of
other seeds, looked at once.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.kinds_scenes import draw_direction
from benchmarks.trust_camera_faults import TakeKind, calibrate_with, magnify, scale_translation
from benchmarks.trust_kinds import KINDS as TRUST_KINDS
from benchmarks.trust_takes import Take, draw_take, warn_without_photographs
from sylpose import Box, FrameSet, Rig, Trajectory, open_session, track
from sylpose.bundle_adjustment.calibration_refinement import default_calibration_prior
from sylpose.comparison import associate_timestamps
from sylpose.geometry.arrays import FloatArray
from sylpose.report.files import read_tum
from sylpose.rig import Camera
from sylpose.runs.certificate_page import build_bar_rows, describe_accuracy
from sylpose.runs.certify import (
    POSITION,
    ROTATION,
    Certificate,
    Estimate,
    bound_sphere,
    certify_results,
    certify_session,
    choose_splits,
    compute_motions,
    normalize_differences,
)
from sylpose.simulate import Actor, Scene, arc, chamfered_box, compute_demo_truth, render_frames
from sylpose.simulate.recordings import create_session_folder, write_boxes, write_videos
from sylpose.smoothing import Track, smooth_tracks

# Kinds of `benchmarks/trust.py`.
BORROWED = (
    *("turn-in-place", "free-motion", "hand-board", "carried", "slow-turn", "long-lens", "six-per-second"),
    *("faint", "low-jpeg", "rolling-shutter", "late-1"),
)


def with_cameras(n: int) -> TakeKind:
    """Return free motions with so many cameras."""
    return lambda rng: draw_take(rng, cameras=n)


def misaligned(degrees: float) -> TakeKind:
    """Return takes whose cameras are each given rotated by an angle, with focal lengths off by as many percent."""

    def draw(rng: np.random.Generator) -> Take:
        def change(camera: Camera) -> Camera:
            turn = RigidTransform.from_rotation(Rotation.from_rotvec(np.radians(degrees) * draw_direction(rng)))
            factor = 1 + 0.01 * degrees * float(rng.normal())
            return magnify(replace(camera, camera_from_world=turn * camera.camera_from_world), factor)

        return calibrate_with(draw_take(rng, cameras=int(rng.integers(3, 6))), change)

    return draw


def late_third(rng: np.random.Generator) -> Take:
    """One of four cameras is late by a third of a frame."""
    take, c = draw_take(rng, cameras=4), int(rng.integers(4))
    return replace(take, clocks={c: lambda frame: frame - 1 / 3})


def rig_scaled(rng: np.random.Generator) -> Take:
    """All translations of the calibration are 3 % too long."""
    take = draw_take(rng, cameras=4)
    return calibrate_with(take, lambda c: replace(c, camera_from_world=scale_translation(c.camera_from_world, 1.03)))


def focal_common(rng: np.random.Generator) -> Take:
    """All focal lengths are given 1 % too long."""
    return calibrate_with(draw_take(rng, cameras=4), lambda c: magnify(c, 1.01))


KINDS: dict[str, TakeKind] = {
    **{name: TRUST_KINDS[name] for name in BORROWED},
    "two-cameras": with_cameras(2),
    "three-cameras": with_cameras(3),
    "four-cameras": with_cameras(4),
    "misaligned-0.1": misaligned(0.1),
    "misaligned-0.3": misaligned(0.3),
    "one-late-third": late_third,
    "shared-scale": rig_scaled,
    "shared-focal": focal_common,
}


@dataclass(frozen=True)
class Accuracy:
    """True and certified accuracy in rotation (degrees) or position (length unit times 1000).

    Attributes:
        true: rms error.
        certified, bound: of the certificate; None if it is not certified.
        true_factor: by which the stated standard deviations agree with the truth.
        factor, factor_bound: of the certificate, and its upper limit.
    """

    true: float
    certified: float | None
    bound: float | None
    true_factor: float
    factor: float | None
    factor_bound: float | None


@dataclass(frozen=True)
class Run:
    """Certificate of one recording, and its truth; without accuracies if nothing was tracked."""

    kind: str
    seed: int
    cameras: int
    frames: int
    measured: int
    rotation: Accuracy | None
    position: Accuracy | None


def run_take(kind: str, seed: int) -> Run:
    """Certify a take and compare with its truth."""
    cv2.setNumThreads(1)
    take = KINDS[kind](np.random.default_rng([seed, *kind.encode()]))
    rig, frames = take.calibration, list(take.frames())
    complete, radius = track_frames(frames, rig, take.boxes)
    measured = [frame for frame in complete if frame.is_measured]
    if len(measured) < 4:
        return Run(kind, seed, len(rig), len(frames), len(measured), None, None)
    parts: dict[tuple[str, ...], Trajectory | str] = {}
    for part in sorted({part for split in choose_splits(rig.names) for part in split}):
        boxes = None if take.boxes is None else {name: box for name, box in take.boxes.items() if name in part}
        columns = [rig.names.index(name) for name in part]
        parts[part] = track_frames([take_columns(f, columns) for f in frames], rig.subset(part), boxes)[0]
    turned = [
        replace(frame, index=k, time=frames[-1].time - frame.time)
        for k, frame in enumerate(frames[measured[-1].index :: -1])
    ]
    boxes = None if take.boxes is None else bound_sphere(rig, measured[-1].position, radius)
    found, _ = track_frames(turned, rig, boxes)
    backwards = [replace(pose, index=measured[-1].index - pose.index) for pose in found][::-1]
    certificate = certify_results(kind, complete, parts, Trajectory(backwards, rig.names, rig.unit))
    truth = min(take.true_poses(), key=lambda poses: float(np.mean(compute_true_errors(complete, poses)[0] ** 2)))
    return compare_certificate(kind, seed, complete, certificate, truth)


def take_columns(frames: FrameSet, columns: Sequence[int]) -> FrameSet:
    """Return the frame set of some of the cameras."""
    return replace(
        frames,
        times=tuple(frames.times[c] for c in columns),
        images=tuple(frames.images[c] for c in columns),
        masks=tuple(frames.masks[c] for c in columns),
    )


def track_frames(frames: Sequence[FrameSet], rig: Rig, boxes: Mapping[str, Box] | None) -> tuple[Trajectory, float]:
    """Track and refine frames as `sylpose track` does; return the trajectory and the object's radius.

    An error ends the trajectory at its frame.
    """
    tracks, radius = list[Track](), 0.0
    try:
        for frame in track(frames, rig, boxes, workers=1):
            tracks.append(Track.from_tracked(frame))
            radius = frame.radius if frame.pose.is_measured else radius
    except ValueError:
        pass
    poses = smooth_tracks(tracks, rig, calibration_prior=default_calibration_prior(rig)).poses if tracks else ()
    return Trajectory(poses, rig.names, rig.unit), radius


def run_recording(folder: Path) -> Run:
    """Certify a recording in a folder with groundtruth.tum."""
    session, complete = open_session(folder), list[Trajectory]()
    certificate = certify_session(session, on_result=lambda _, result: complete.append(result)).objects[0]
    times, poses = read_tum(folder / "groundtruth.tum")
    own, others = associate_timestamps(times, complete[0].times)
    kept = Trajectory([complete[0][int(k)] for k in others], complete[0].camera_names, complete[0].unit)
    # Numbered by their truth.
    numbered = Trajectory([replace(f, index=k) for k, f in enumerate(kept)], kept.camera_names, kept.unit)
    return compare_certificate(folder.name, 0, numbered, certificate, poses[own])


def write_bar(folder: Path, frames: int = 30) -> None:
    """Write a recording of two textured boxes that move as one rigid body, with boxes."""
    rig, ends = arc(4, 35, 1.5, 620, (640, 480), height=0.35), {"left": -0.17, "right": 0.17}

    def move(frame: float) -> RigidTransform:
        turn = Rotation.from_rotvec(np.radians(2.0 * frame) * np.array([0.25, 0.9, 0.35]))
        place = [0.06 * np.sin(frame / 9), 0.03 * np.sin(frame / 7), 0.05 * np.sin(frame / 8)]
        return RigidTransform.from_components(place, turn)

    actors, boxes = list[Actor](), dict[str, dict[str, tuple[int, int, int, int]]]()
    for seed, (name, x) in enumerate(ends.items(), start=1):
        end = RigidTransform.from_translation([x, 0.0, 0.0])
        actors.append(Actor(chamfered_box(np.array([0.16, 0.15, 0.16]), 700, seed=seed), partial(_join, move, end)))
        truth = compute_demo_truth(Scene(rig, (actors[-1],), 1, 3, 1.5))
        boxes[name] = truth.boxes
    create_session_folder(folder, rig)
    write_boxes(folder, boxes)
    write_videos(folder, rig, render_frames(Scene(rig, tuple(actors), frames, 3, 1.5)), frames)


def _join(move: Callable[[float], RigidTransform], end: RigidTransform, frame: float) -> RigidTransform:
    return move(frame) * end


def report_bar() -> None:
    """Render, certify and print the bar."""
    with TemporaryDirectory() as folder:
        write_bar(Path(folder))
        certificate = certify_session(open_session(Path(folder)), bar=("left", "right"))
    assert certificate.bar is not None
    print("| | rms | maximum | 99.7th percentile |\n|---|---|---|---|")
    for row in build_bar_rows(certificate.bar, "m"):
        print("| " + " | ".join(row) + " |")
    for item in certificate.objects:
        print(f"{item.name}: {describe_accuracy(item)}")


def compute_true_errors(complete: Trajectory, truth: RigidTransform) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute the errors (n, 3) of rotation and position since the first measured frame, and covariances (n, 6, 6)."""
    frames = {frame.index: frame for frame in complete if frame.is_measured}
    index = sorted(frames)
    center = frames[index[0]].position
    found, true = compute_motions(frames, index, center), truth[np.array(index)] * truth[index[0]].inv()
    rotation = (found.rotations * true[1:].rotation.inv()).as_rotvec()
    return rotation, found.positions - np.asarray(true[1:].apply(center)), found.covariance


def compare_certificate(
    kind: str, seed: int, complete: Trajectory, certificate: Certificate, truth: RigidTransform
) -> Run:
    """Compare a certificate with the true poses, by frame number."""
    rotation, position, covariance = compute_true_errors(complete, truth)
    accuracies = [
        _compare(certificate.rotation, np.degrees(1.0), rotation, covariance[:, ROTATION, ROTATION]),
        _compare(certificate.position, 1e3, position, covariance[:, POSITION, POSITION]),
    ]
    return Run(kind, seed, len(complete.camera_names), len(complete), certificate.n_measured, *accuracies)


def _compare(estimate: Estimate | None, scale: float, errors: FloatArray, covariance: FloatArray) -> Accuracy:
    true, normalized = np.sqrt(np.mean(np.sum(errors**2, axis=1))), normalize_differences(errors, covariance)
    factor = float(np.sqrt(np.mean(normalized**2)))
    if estimate is None or estimate.is_lower_bound:
        return Accuracy(scale * float(true), None, None, factor, None, None)
    stated = scale * estimate.error, scale * estimate.bound
    return Accuracy(scale * float(true), *stated, factor, estimate.factor, estimate.factor_interval[1])


HEADER = (
    "| kind | runs: certified, all | rotation: true error | certified / true | bound | factor / true | position: true error "
    "| certified / true | bound | factor / true |\n" + "|---" * 10 + "|"
)


def format_row(name: str, runs: Sequence[Run]) -> str:
    """Format the table row of some runs."""
    n_certified = sum(run.rotation is not None and run.rotation.certified is not None for run in runs)
    cells = [name, f"{n_certified}, {len(runs)}"]
    for quantity, unit in (("rotation", "°"), ("position", " mm")):
        found: list[Accuracy] = [a for run in runs if (a := getattr(run, quantity)) is not None]
        cells.append(f"{np.median([a.true for a in found]):.2g}{unit}" if found else "-")
        certified = [(a.certified / a.true, a.bound / a.true) for a in found if a.certified is not None and a.bound]
        factors = [a.factor / a.true_factor for a in found if a.factor is not None]
        if not certified:
            cells += ["-"] * 3
            continue
        ratios, bounds = map(np.array, zip(*certified, strict=True))
        covered = int((bounds >= 1).sum())
        cells.append(f"{np.median(ratios):.2g} ({ratios.min():.2g} to {ratios.max():.2g})")
        cells.append(f"{covered} of {len(bounds)}, least {bounds.min():.2g}")
        cells.append(f"{np.median(factors):.2g} ({min(factors):.2g} to {max(factors):.2g})")
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND")
    parser.add_argument("--seeds", default="0:2", help="first:end")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--each", action="store_true", help="print a row for each run")
    parser.add_argument("--list", action="store_true", help="print the kinds and stop")
    parser.add_argument("--recording", type=Path, action="append", default=[], metavar="DIR")
    parser.add_argument("--bar", action="store_true", help="certify a rendered bar and stop")
    parser.add_argument("--json", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    names = arguments.kinds or ([] if arguments.recording else list(KINDS))
    if unknown := [name for name in names if name not in KINDS]:
        parser.error(f"unknown kind: {', '.join(unknown)}; known are {', '.join(KINDS)}")
    if arguments.bar:
        report_bar()
        return
    if arguments.list:
        print(", ".join(KINDS))
        return
    first, _, end = arguments.seeds.partition(":")
    seeds = range(int(first), int(end or int(first) + 1))
    if names:
        warn_without_photographs()
    print(HEADER, flush=True)
    runs = list[Run]()
    for folder in arguments.recording:
        runs.append(run_recording(folder))
        print(format_row(folder.name, runs[-1:]), flush=True)
    with ProcessPoolExecutor(arguments.jobs) as pool:
        pending = {name: [pool.submit(run_take, name, seed) for seed in seeds] for name in names}
        for name, futures in pending.items():
            done = list[Run]()
            for future in futures:
                done.append(future.result())
                if arguments.each:
                    print(format_row(f"{name} {done[-1].seed}", done[-1:]), flush=True)
            runs += done
            print(format_row(name, done), flush=True)
            if arguments.json is not None:
                arguments.json.write_text(json.dumps([asdict(run) for run in runs], indent=1) + "\n")
    independent = [run for run in runs if not run.kind.startswith("shared")]
    if len(independent) > 1:
        print(format_row("all but shared", independent))


if __name__ == "__main__":
    main()
