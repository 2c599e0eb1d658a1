"""Smoothing by key frames against smoothing by all frames: time, errors and covariances.

    python benchmarks/smoothing.py [--first N]

Rendered recordings of the demo's block, tracked once and refined both ways (`bundle_adjustment/keyframes.py`). Prints a row
for each: processor time per frame, rms errors of rotation and position, median NEES of the six unknowns (5.3 if covariances
are right and errors independent), and the geometric means of the ratios.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.loops import render_demo
from sylpose import track
from sylpose.bundle_adjustment import keyframes
from sylpose.bundle_adjustment.calibration_refinement import default_calibration_prior
from sylpose.geometry.arrays import FloatArray
from sylpose.rig import Rig
from sylpose.smoothing import Track, smooth_tracks


class Recording(NamedTuple):
    """Rendered recording: frames, total rotation, cameras, seed, image size."""

    frames: int
    degrees: float
    cameras: int
    seed: int
    size: tuple[int, int] = (320, 240)


RECORDINGS = (
    Recording(130, 130.0, 3, 10, (480, 360)),
    Recording(150, 60.0, 4, 8, (640, 480)),
    Recording(160, 80.0, 4, 3),
    Recording(180, 270.0, 4, 9),
    Recording(200, 500.0, 3, 5),
    Recording(240, 150.0, 2, 7),
    Recording(400, 200.0, 3, 5),
    Recording(400, 200.0, 4, 3),
)


@contextmanager
def refine_all_frames() -> Iterator[None]:
    """Make every frame a key frame."""
    limit = keyframes.MIN_FRAMES
    keyframes.MIN_FRAMES = 1 << 30
    try:
        yield
    finally:
        keyframes.MIN_FRAMES = limit


def measure(tracks: list[Track], rig: Rig, truth: RigidTransform) -> FloatArray:
    """Smooth; return (4,) milliseconds a frame, rms degrees, rms mm and the median NEES."""
    begin = time.process_time()
    result = smooth_tracks(tracks, rig, calibration_prior=default_calibration_prior(rig))
    seconds = time.process_time() - begin
    poses = [(k, p) for k, p in enumerate(result.poses) if p.world_from_object is not None and p.is_measured]
    found = RigidTransform.concatenate([p.world_from_object for _, p in poses if p.world_from_object is not None])
    true = truth[[k for k, _ in poses]]
    true = true * true[0].inv() * found[0]
    errors = np.hstack([(found.rotation * true.rotation.inv()).as_rotvec(), found.translation - true.translation])
    covariance = np.array([p.covariance for _, p in poses])[1:]
    nees = np.einsum("ni,nij,nj->n", errors[1:], np.linalg.pinv(covariance), errors[1:])
    rms = np.sqrt((errors.reshape(-1, 2, 3) ** 2).sum(axis=2).mean(axis=0))
    return np.array([1e3 * seconds / len(tracks), np.rad2deg(rms[0]), 1e3 * rms[1], np.median(nees)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=len(RECORDINGS), help="number of recordings")
    ratios = list[FloatArray]()
    print("| frames, degrees, cameras, seed | all: ms, deg, mm, NEES | key frames |\n|---|---|---|")
    for recording in RECORDINGS[: parser.parse_args().first]:
        n, degrees, cameras, seed, size = recording
        sequence = render_demo(frames=n, angle_deg=degrees, size=size, n_cameras=cameras, seed=seed)
        frames = track(sequence.frames, sequence.rig, sequence.boxes, workers=1)
        tracks = [Track.from_tracked(frame) for frame in frames]
        with refine_all_frames():
            by_all = measure(tracks, sequence.rig, sequence.world_from_object)
        by_keys = measure(tracks, sequence.rig, sequence.world_from_object)
        ratios.append(by_keys / by_all)
        cells = ("{:.1f}, {:.3f}, {:.3f}, {:.1f}".format(*row) for row in (by_all, by_keys))
        print(f"| {n}, {degrees:.0f}, {cameras}, {seed} | {' | '.join(cells)} |", flush=True)
    print("ratios, geometric means: {:.2f}, {:.2f}, {:.2f}, {:.2f}".format(*np.exp(np.log(ratios).mean(axis=0))))


if __name__ == "__main__":
    main()
