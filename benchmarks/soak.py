"""Memory growth and lost frames of `sylpose track --follow` on two objects over thousands of frames.

    python benchmarks/soak.py [--frames 10000] [--rate 8] [--samples FILE]

Two bodies rotate back and forth in front of four cameras of 320x240. Their images are written to one folder per camera at a
constant rate, and old images are removed. `sylpose track --follow --no-drop` processes them. Its memory and processor time
are sampled from outside; the first fifth counts as warm-up. Needs Linux (/proc).
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

from benchmarks.network_soak import fit_growth, processor_seconds
from benchmarks.node_processes import read_rss_mb
from benchmarks.tracking_scenes import build_two_objects, make_rig
from sylpose.geometry.arrays import Image
from sylpose.report.files import read_trajectory
from sylpose.rig import Camera, Rig
from sylpose.simulate import Scene, render_frames
from sylpose.simulate.recordings import compute_demo_truth, create_session_folder, write_boxes

__all__ = ["main"]

# Image scale relative to the sequences' 640x480; frames until the motion reverses; seconds between two samples; images per
# camera that are kept (choice).
IMAGE_SCALE, PERIOD, SAMPLE_INTERVAL_S, N_KEPT_IMAGES = 0.5, 90, 5.0, 200
WARM_UP_SHARE = 0.2


def scale_camera(camera: Camera) -> Camera:
    """Scale a camera to smaller images."""
    size = round(camera.size[0] * IMAGE_SCALE), round(camera.size[1] * IMAGE_SCALE)
    return replace(camera, matrix=np.diag([IMAGE_SCALE, IMAGE_SCALE, 1.0]) @ camera.matrix, size=size)


def create_recording(folder: Path) -> tuple[Scene, list[Sequence[Image]]]:
    """Create the recording's folder without images; return the scene and the images of one period."""
    recording = build_two_objects(PERIOD, 9)
    rig = Rig([scale_camera(camera) for camera in make_rig().cameras], "m")
    scene = replace(recording.scene, rig=rig)
    create_session_folder(folder, rig)
    truths = [compute_demo_truth(replace(scene, actors=(actor,))) for actor in scene.actors]
    write_boxes(folder, {name: truth.boxes for name, truth in zip(recording.objects, truths, strict=True)})
    for camera in rig.cameras:
        (folder / camera.name).mkdir()
    forward_images = list(render_frames(scene))
    return scene, [*forward_images, *forward_images[-2:0:-1]]


def write_images(folder: Path, names: Sequence[str], number: int, files: Sequence[bytes]) -> None:
    """Write the images of one timestamp atomically and remove the oldest ones."""
    for name, data in zip(names, files, strict=True):
        part = folder / f"{name}.part"
        part.write_bytes(data)
        os.replace(part, folder / name / f"{number:08d}.png")
        (folder / name / f"{number - N_KEPT_IMAGES:08d}.png").unlink(missing_ok=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=10_000)
    parser.add_argument("--rate", type=float, default=8.0, help="frames per second")
    parser.add_argument("--samples", type=Path, help="write samples to this file: seconds, MB, processor seconds")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder, out = Path(temporary) / "recording", Path(temporary) / "out"
        scene, images = create_recording(folder)
        names = [camera.name for camera in scene.rig.cameras]
        pngs = [[cv2.imencode(".png", image)[1].tobytes() for image in frame] for frame in images]
        command = [sys.executable, "-m", "sylpose", "track", str(folder), "--follow", "--no-drop", "--no-overlay"]
        write_images(folder, names, 0, pngs[0])
        process = subprocess.Popen(
            [*command, "--out", str(out), "--rate", str(options.rate)], stdout=subprocess.DEVNULL
        )
        begin, rows = time.monotonic(), list[list[float]]()
        for number in range(1, options.frames):
            time.sleep(max(begin + number / options.rate - time.monotonic(), 0.0))
            write_images(folder, names, number, pngs[number % len(pngs)])
            now = time.monotonic() - begin
            if now > SAMPLE_INTERVAL_S * len(rows):
                rows.append([now, read_rss_mb(process.pid), processor_seconds(process.pid)])
            if process.poll() is not None:
                raise SystemExit(f"the run ended with {process.returncode} at frame {number}")
        (folder / "DONE").touch()
        code, delay = process.wait(600), time.monotonic() - begin - options.frames / options.rate
        if options.samples is not None:
            options.samples.write_text("\n".join(",".join(f"{x:.3f}" for x in row) for row in rows) + "\n")
        table = np.array(rows)
        warm = table[:, 0] > WARM_UP_SHARE * table[-1, 0]
        slope, sigma = fit_growth(table[warm, 0], table[warm, 1])
        core_share = (table[-1, 2] - table[warm, 2][0]) / (table[-1, 0] - table[warm, 0][0])
        print(f"exit {code}, {delay:.1f} s after the last image")
        print(f"MB after warm-up {table[warm, 1][0]:.1f}, at the end {table[-1, 1]:.1f}, peak {table[:, 1].max():.1f}, "
              f"per hour {slope:+.2f} ± {sigma:.2f}; share of a core {core_share:.2f}")  # fmt: skip
        for file in sorted(out.rglob("trajectory.csv")):
            found = read_trajectory(file)
            solved = sum(pose.world_from_object is not None for pose in found)
            print(f"{file.relative_to(out)}: {len(found):,} frames, {solved:,} with a pose")


if __name__ == "__main__":
    main()
