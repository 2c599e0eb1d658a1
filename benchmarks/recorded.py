"""Are the covariances of real recordings right, whose calibrations are not exact? NEES of the smoothed poses.

    python benchmarks/recorded.py [RECORDING ...] [--recordings FOLDER]

For each recording, smoothed with the calibration as it is, with its uncertainty counted (what `sylpose track` does) and
refined: the squared error of all six unknowns in units of their covariance, median and worst frame (6 in the mean for one
that is right), and the errors since the first frame.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.live import difference, scene_of
from sylpose import track
from sylpose.bundle_adjustment.calibration_refinement import usual_doubt
from sylpose.smoothing.trajectory import Track, smooth


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=["temple", "board4"])
    parser.add_argument("--recordings", type=Path, default=Path("../shared/data"))
    options = parser.parse_args()
    print("| recording | calibration | NEES: median, worst | degrees: median, worst | mm: median, worst |")
    print("|---|---|---|---|---|")
    for name in options.names:
        scene = scene_of(name, options.recordings)
        tracks = [Track.of(frame) for frame in track(scene.frames, scene.rig, scene.boxes)]
        doubt = usual_doubt(scene.rig)
        ways: dict[str, dict[str, Any]] = {
            "as it is": {},
            "doubted": {"doubt": doubt},
            "refined": {"doubt": doubt, "recalibrate": True},
        }
        for way, given in ways.items():
            poses = smooth(tracks, scene.rig, **given).poses
            first, *found = [k for k, pose in enumerate(poses) if pose.measured]
            rows = []
            for k in found:
                e = difference(scene, first, poses[first], k, poses[k])
                nees = e @ np.linalg.solve(poses[k].covariance, e)
                rows.append([nees, np.degrees(np.linalg.norm(e[:3])), 1e3 * np.linalg.norm(e[3:])])
            cells = [f"{a:.2g}, {b:.2g}" for a, b in zip(np.median(rows, axis=0), np.max(rows, axis=0), strict=True)]
            print(f"| {name} | {way} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
