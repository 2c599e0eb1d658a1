"""Two objects in folders that a recorder keeps filling, for thousands of frames: does memory grow, is any frame lost?

    python benchmarks/soak.py [--frames 10000] [--rate 8] [--samples FILE]

Two bodies turn to and fro before four cameras of 320x240; their images are put into one folder per camera at a steady rate,
old ones are removed, and `sylpose track --follow --no-drop` follows. Its memory and its processor time are sampled, from
outside. The first fifth counts as warm-up. Needs Linux (/proc).
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from benchmarks.network_soak import growth, processor_seconds
from benchmarks.node_processes import rss_mb
from benchmarks.tracking_scenes import rig_of, two
from sylpose.geometry.arrays import Image
from sylpose.report.files import read_trajectory
from sylpose.rig import Camera, Rig
from sylpose.simulate import Scene, render_frames
from sylpose.simulate.demo import demo_truth
from sylpose.simulate.recording_files import session_folder, write_boxes

__all__ = ["main"]

# Of the images, against the sequences' own 640x480; frames until the bodies turn back; seconds between two samples; images
# per camera that stay (choice).
SHARE, PERIOD, EVERY, KEPT = 0.5, 90, 5.0, 200
WARM_UP = 0.2


def small(camera: Camera) -> Camera:
    """The same camera with smaller images."""
    size = round(camera.size[0] * SHARE), round(camera.size[1] * SHARE)
    return replace(camera, matrix=np.diag([SHARE, SHARE, 1.0]) @ camera.matrix, size=size)


def begun(folder: Path) -> tuple[Scene, list[Sequence[Image]]]:
    """The recording's folder, without images yet, and these: there and back again."""
    recording = two(PERIOD, 9)
    rig = Rig([small(camera) for camera in rig_of().cameras], "m")
    scene = replace(recording.scene, rig=rig)
    session_folder(folder, rig)
    truths = [demo_truth(replace(scene, actors=(actor,))) for actor in scene.actors]
    write_boxes(folder, {name: truth.boxes for name, truth in zip(recording.objects, truths, strict=True)})
    for camera in rig.cameras:
        (folder / camera.name).mkdir()
    there = list(render_frames(scene))
    return scene, [*there, *there[-2:0:-1]]


def put(folder: Path, names: Sequence[str], number: int, files: Sequence[bytes]) -> None:
    """An instant's images, whole at once; the oldest go."""
    for name, data in zip(names, files, strict=True):
        part = folder / f"{name}.part"
        part.write_bytes(data)
        os.replace(part, folder / name / f"{number:08d}.png")
        (folder / name / f"{number - KEPT:08d}.png").unlink(missing_ok=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--rate", type=float, default=8.0, help="frames per second")
    parser.add_argument("--samples", type=Path, help="file for what was sampled: seconds, MB, processor seconds")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder, out = Path(temporary) / "recording", Path(temporary) / "out"
        scene, images = begun(folder)
        names = [camera.name for camera in scene.rig.cameras]
        pngs = [[cv2.imencode(".png", image)[1].tobytes() for image in frame] for frame in images]
        command = [sys.executable, "-m", "sylpose", "track", str(folder), "--follow", "--no-drop", "--no-overlay"]
        put(folder, names, 0, pngs[0])
        process = subprocess.Popen(
            [*command, "--out", str(out), "--rate", str(options.rate)], stdout=subprocess.DEVNULL
        )
        begin, rows = time.monotonic(), list[list[float]]()
        for number in range(1, options.frames):
            time.sleep(max(begin + number / options.rate - time.monotonic(), 0.0))
            put(folder, names, number, pngs[number % len(pngs)])
            now = time.monotonic() - begin
            if now > EVERY * len(rows):
                rows.append([now, rss_mb(process.pid), processor_seconds(process.pid)])
            if process.poll() is not None:
                raise SystemExit(f"the run ended with {process.returncode} at frame {number}")
        (folder / "DONE").touch()
        code, late = process.wait(600), time.monotonic() - begin - options.frames / options.rate
        if options.samples is not None:
            options.samples.write_text("\n".join(",".join(f"{x:.3f}" for x in row) for row in rows) + "\n")
        table = np.array(rows)
        warm = table[:, 0] > WARM_UP * table[-1, 0]
        slope, sigma = growth(table[warm, 0], table[warm, 1])
        used = (table[-1, 2] - table[warm, 2][0]) / (table[-1, 0] - table[warm, 0][0])
        print(f"exit {code}, {late:.1f} s after the last image")
        print(f"MB after warm-up {table[warm, 1][0]:.1f}, at the end {table[-1, 1]:.1f}, most {table[:, 1].max():.1f}, "
              f"per hour {slope:+.2f} ± {sigma:.2f}; share of a core {used:.2f}")  # fmt: skip
        for file in sorted(out.rglob("trajectory.csv")):
            found = read_trajectory(file)
            solved = sum(pose.world_from_object is not None for pose in found)
            print(f"{file.relative_to(out)}: {len(found):,} frames, {solved:,} with a pose")


if __name__ == "__main__":
    main()
