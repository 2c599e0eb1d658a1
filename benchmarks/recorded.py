"""Consistency of the covariances of smoothed poses on real recordings, whose calibrations are inexact.

    python benchmarks/recorded.py [RECORDING ...] [--recordings FOLDER]

Each recording is smoothed with the calibration taken as exact, with its uncertainty taken into account (as `sylpose track`
does), and with the calibration refined. The table gives the NEES of all six unknowns (mean 6 for a consistent covariance)
and the errors since the first frame, each of the median and the worst frame.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.live import compute_error_vector, load_scene
from sylpose import track
from sylpose.bundle_adjustment.calibration_refinement import default_calibration_prior
from sylpose.smoothing import Track, smooth_tracks


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=["temple", "board4"])
    parser.add_argument("--recordings", type=Path, default=Path("../shared/data"))
    options = parser.parse_args()
    print(
        "| recording | calibration | NEES: median, worst | rotation error, deg: median, worst "
        "| position error, mm: median, worst |"
    )
    print("|---|---|---|---|---|")
    for name in options.names:
        scene = load_scene(name, options.recordings)
        tracks = [Track.from_tracked(frame) for frame in track(scene.frames, scene.rig, scene.boxes)]
        doubt = default_calibration_prior(scene.rig)
        settings: dict[str, dict[str, Any]] = {
            "exact": {},
            "uncertain": {"calibration_prior": doubt},
            "refined": {"calibration_prior": doubt, "recalibrate": True},
        }
        for label, smooth_options in settings.items():
            poses = smooth_tracks(tracks, scene.rig, **smooth_options).poses
            first, *found = [k for k, pose in enumerate(poses) if pose.is_measured]
            rows = []
            for k in found:
                e = compute_error_vector(scene, first, poses[first], k, poses[k])
                nees = e @ np.linalg.solve(poses[k].covariance, e)
                rows.append([nees, np.degrees(np.linalg.norm(e[:3])), 1e3 * np.linalg.norm(e[3:])])
            cells = [f"{a:.2g}, {b:.2g}" for a, b in zip(np.median(rows, axis=0), np.max(rows, axis=0), strict=True)]
            print(f"| {name} | {label} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
