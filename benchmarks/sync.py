"""Accuracy and speed of `sylpose sync` on rendered, seeded recordings with known time offsets.

    python benchmarks/sync.py [--kinds KIND ...] [--seeds N] [--folder FOLDER]

With --folder the recordings are kept there and reused, so that two versions of sylpose (PYTHONPATH) can be compared on the
same recordings.

Prints for each recording, and as means for each kind: the RMS and the largest error of the offsets, their mean standard
deviation, the mean squared error in standard deviations (should be about 1; C cameras have C - 1 free offsets), the number
of tracking rounds, and processor and wall seconds. The errors cover only cameras with the status "found".
"""

from __future__ import annotations

import argparse
import tempfile
import time
import tomllib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.rendered_recordings import Recording, write_recording
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.io.capture import open_session
from sylpose.runs.precompile import compile_all
from sylpose.simulate import make_demo_scene
from sylpose.sync.estimation import OffsetPrecision, sync_session

RATE = 30.0


class Kind(NamedTuple):
    """Kind of recording.

    The offsets are drawn within `max_offset_frames` frames. The speed varies by `speed_variation`; at 1 the object
    stops and goes. Noise and exposure are as in `Scene`.
    """

    cameras: int = 4
    frames: int = 60
    turn_deg: float = 120.0
    size: tuple[int, int] = (640, 480)
    max_offset_frames: float = 0.5
    speed_variation: float = 1.0
    noise: float = 1.5
    exposure: float = 0.0


KINDS = {
    "usual": Kind(),
    "frames-apart": Kind(max_offset_frames=8.0),
    "two": Kind(cameras=2),
    "six": Kind(cameras=6),
    "longer": Kind(frames=180, turn_deg=360.0, size=(400, 300)),
    "small": Kind(size=(400, 300), noise=3.0),
    "fast": Kind(turn_deg=360.0),
    "blurred": Kind(turn_deg=200.0, exposure=0.5),
    "slow": Kind(turn_deg=25.0),
    "even": Kind(speed_variation=0.0),
}


class SyncResult(NamedTuple):
    """Result of one recording.

    Attributes:
        errors, sd: (n,) errors and standard deviations of the offsets found, seconds.
        cameras: number of cameras.
        rounds: number of tracking rounds.
        processor, clock: processor and wall seconds.
        remarks: remarks.
    """

    errors: FloatArray
    sd: FloatArray
    cameras: int
    rounds: int
    processor: float
    clock: float
    remarks: str

    @property
    def mean_squared_error(self) -> float:
        """Mean squared error in standard deviations, per free offset."""
        return float((np.square(self.errors / self.sd)).sum() / max(len(self.errors) - 1, 1))


def write_kind(kind: Kind, seed: int, folder: Path) -> None:
    """Render a recording with its true offsets."""
    rng = np.random.default_rng([seed, 7])
    scene = make_demo_scene(
        frames=kind.frames,
        angle_deg=kind.turn_deg,
        seed=seed,
        size=kind.size,
        n_cameras=kind.cameras,
        noise=kind.noise,
        exposure=kind.exposure,
    )
    uniform_path, phases = scene.actors[0].path, rng.uniform(0, 2 * np.pi, 2)

    def uneven_path(frame: float) -> RigidTransform:
        waves = 2.1 * np.sin(frame / 3.1 + phases[0]) + 2.5 * np.sin(frame / 5.3 + phases[1])
        return uniform_path(frame + kind.speed_variation * float(waves))

    offsets = rng.uniform(-kind.max_offset_frames, kind.max_offset_frames, kind.cameras) / RATE
    moving = replace(scene, actors=(replace(scene.actors[0], path=uneven_path),))
    write_recording(Recording(moving, boxes=False, time_offsets=tuple(offsets.tolist())), folder)


def sync_recording(folder: Path) -> SyncResult:
    """Estimate the offsets of a recording and compare them with the true ones."""
    session, rounds = open_session(folder), set[str]()

    def watch(what: str, _total: int, frames: Iterable[FrameSet]) -> Iterable[FrameSet]:
        rounds.add(what)
        return frames

    processor, clock = time.process_time(), time.perf_counter()
    found = sync_session(session, show_progress=watch)
    processor, clock = time.process_time() - processor, time.perf_counter() - clock
    true = np.array([*tomllib.loads((folder / "true_offsets.toml").read_text()).values()])
    is_found = np.array([known is OffsetPrecision.FINE for known in found.precision])
    errors = (found.offsets - true)[is_found]
    remarks = "; ".join(
        [", ".join(known.value for known in found.precision)] * (not is_found.all()) + [*found.problems]
    )
    return SyncResult(
        errors - (errors.mean() if len(errors) else 0.0),
        found.sd[is_found],
        len(is_found),
        len([what for what in rounds if what.startswith("Tracking")]),
        processor,
        clock,
        remarks,
    )


def format_line(name: str, sync_results: list[SyncResult]) -> str:
    """Format the line of one recording, or the means of several."""
    errors, sd = (np.concatenate([getattr(one, what) for one in sync_results]) for what in ("errors", "sd"))
    squared_errors = [one.mean_squared_error for one in sync_results if len(one.errors) > 1]
    numbers = "     -       -       -       -"
    if squared_errors:
        rms, worst = float(np.sqrt(np.mean(errors**2))), float(np.abs(errors).max())
        numbers = f"{1e3 * rms:6.3f}  {1e3 * worst:6.3f}  {1e3 * sd.mean():6.3f}  {np.mean(squared_errors):6.2f}"
    rounds, processor, clock = (
        np.mean([getattr(one, what) for one in sync_results]) for what in ("rounds", "processor", "clock")
    )
    remarks = sync_results[0].remarks if len(sync_results) == 1 else ""
    return f"{name:16}  {numbers}  {rounds:6.1f}  {processor:9.1f}  {clock:7.1f}  {remarks}".rstrip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=[*KINDS], default=[*KINDS])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--folder", type=Path)
    args = parser.parse_args()
    compile_all()
    print("recording          rms ms     max      sd   sq.err  rounds  processor     wall")
    with tempfile.TemporaryDirectory() as temporary:
        for name in args.kinds:
            sync_results = []
            for seed in range(args.seeds):
                folder = (args.folder or Path(temporary)) / f"{name}-{seed}"
                if not (folder / "true_offsets.toml").exists():
                    folder.mkdir(parents=True, exist_ok=True)
                    write_kind(KINDS[name], seed, folder)
                sync_results.append(sync_recording(folder))
                print(format_line(f"{name}:{seed}", sync_results[-1:]), flush=True)
            print(format_line(f"{name} means", sync_results), flush=True)


if __name__ == "__main__":
    main()
