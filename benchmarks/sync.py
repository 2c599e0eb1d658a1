"""How well and how fast does `sylpose sync` find how far apart cameras are? Rendered recordings with known offsets, seeded.

    python benchmarks/sync.py [--kinds KIND ...] [--seeds N] [--folder FOLDER]

With --folder the recordings are kept there and used again: run by another version of sylpose, too (PYTHONPATH), it compares
the two on the same recordings.

Prints for each recording the errors of the offsets (root of the mean square, of the worst camera), their standard
deviations (mean), the mean of their squared errors in standard deviations (should be about 1; of C cameras' offsets C - 1
are free), how often the object was tracked, and the processor's and the clock's seconds; and the means of each kind. In the
offset errors only cameras count whose offset is "found".
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

from sylpose.app.precompile import compile_all
from sylpose.app.sync import Known, sync_session
from sylpose.capture import open_session
from sylpose.frames import FrameSet
from sylpose.geometry.arrays import FloatArray
from sylpose.simulate import Recording, demo_scene, write_recording

RATE = 30.0


class Kind(NamedTuple):
    """A kind of recording: the offsets are drawn within `apart` frames; the speed goes up and down by `uneven`, which at 1
    is as much as the object stops and goes; noise and exposure as in `Scene`."""

    cameras: int = 4
    frames: int = 60
    turn_deg: float = 120.0
    size: tuple[int, int] = (640, 480)
    apart: float = 0.5
    uneven: float = 1.0
    noise: float = 1.5
    exposure: float = 0.0


KINDS = {
    "usual": Kind(),
    "frames-apart": Kind(apart=8.0),
    "two": Kind(cameras=2),
    "six": Kind(cameras=6),
    "longer": Kind(frames=180, turn_deg=360.0, size=(400, 300)),
    "small": Kind(size=(400, 300), noise=3.0),
    "fast": Kind(turn_deg=360.0),
    "blurred": Kind(turn_deg=200.0, exposure=0.5),
    "slow": Kind(turn_deg=25.0),
    "even": Kind(uneven=0.0),
}


class Synced(NamedTuple):
    """Of one recording: errors and standard deviations (n,) seconds of the offsets found, of C cameras; rounds of tracking;
    processor's and clock's seconds; what was said."""

    errors: FloatArray
    sd: FloatArray
    cameras: int
    rounds: int
    processor: float
    clock: float
    said: str

    @property
    def squares(self) -> float:
        """Mean square of the errors in standard deviations, per free offset."""
        return float((np.square(self.errors / self.sd)).sum() / max(len(self.errors) - 1, 1))


def write(kind: Kind, seed: int, folder: Path) -> None:
    """The recording, with the true offsets."""
    rng = np.random.default_rng([seed, 7])
    scene = demo_scene(
        frames=kind.frames,
        turn_deg=kind.turn_deg,
        seed=seed,
        size=kind.size,
        n_cameras=kind.cameras,
        noise=kind.noise,
        exposure=kind.exposure,
    )
    steady, phases = scene.actors[0].path, rng.uniform(0, 2 * np.pi, 2)

    def uneven(frame: float) -> RigidTransform:
        waves = 2.1 * np.sin(frame / 3.1 + phases[0]) + 2.5 * np.sin(frame / 5.3 + phases[1])
        return steady(frame + kind.uneven * float(waves))

    late = rng.uniform(-kind.apart, kind.apart, kind.cameras) / RATE
    moving = replace(scene, actors=(replace(scene.actors[0], path=uneven),))
    write_recording(Recording(moving, boxes=False, skew=tuple(late.tolist())), folder)


def synced(folder: Path) -> Synced:
    """The offsets of a recording, beside the true ones."""
    session, rounds = open_session(folder), set[str]()

    def watch(what: str, _total: int, frames: Iterable[FrameSet]) -> Iterable[FrameSet]:
        rounds.add(what)
        return frames

    processor, clock = time.process_time(), time.perf_counter()
    found = sync_session(session, watch=watch)
    processor, clock = time.process_time() - processor, time.perf_counter() - clock
    true = np.array([*tomllib.loads((folder / "true_offsets.toml").read_text()).values()])
    fine = np.array([known is Known.FINE for known in found.known])
    errors = (found.offsets - true)[fine]
    said = "; ".join([", ".join(known.value for known in found.known)] * (not fine.all()) + [*found.problems])
    return Synced(
        errors - (errors.mean() if len(errors) else 0.0),
        found.sd[fine],
        len(fine),
        len([what for what in rounds if what.startswith("Tracking")]),
        processor,
        clock,
        said,
    )


def line(name: str, ones: list[Synced]) -> str:
    """Of one recording, or the means of several."""
    errors, sd = (np.concatenate([getattr(one, what) for one in ones]) for what in ("errors", "sd"))
    counted = [one.squares for one in ones if len(one.errors) > 1]
    numbers = "     -       -       -       -"
    if counted:
        rms, worst = float(np.sqrt(np.mean(errors**2))), float(np.abs(errors).max())
        numbers = f"{1e3 * rms:6.3f}  {1e3 * worst:6.3f}  {1e3 * sd.mean():6.3f}  {np.mean(counted):6.2f}"
    rounds, processor, clock = (
        np.mean([getattr(one, what) for one in ones]) for what in ("rounds", "processor", "clock")
    )
    said = ones[0].said if len(ones) == 1 else ""
    return f"{name:16}  {numbers}  {rounds:6.1f}  {processor:9.1f}  {clock:7.1f}  {said}".rstrip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=[*KINDS], default=[*KINDS])
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--folder", type=Path)
    args = parser.parse_args()
    compile_all()
    print("recording          rms ms   worst      sd  squares  rounds  processor    clock")
    with tempfile.TemporaryDirectory() as temporary:
        for name in args.kinds:
            ones = []
            for seed in range(args.seeds):
                folder = (args.folder or Path(temporary)) / f"{name}-{seed}"
                if not (folder / "true_offsets.toml").exists():
                    folder.mkdir(parents=True, exist_ok=True)
                    write(KINDS[name], seed, folder)
                ones.append(synced(folder))
                print(line(f"{name}:{seed}", ones[-1:]), flush=True)
            print(line(f"{name} means", ones), flush=True)


if __name__ == "__main__":
    main()
