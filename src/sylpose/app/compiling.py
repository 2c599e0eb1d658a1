"""What tracking compiles after an installation or an update, by processes beside each other.

    python -m sylpose.app.compiling [PART ...]

compiles all of it, or some parts one after another. Numba keeps what is compiled beside the sources, or where
`NUMBA_CACHE_DIR` says: every later process loads it.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.adjustment.bundle import Observations, bundle
from sylpose.features import klt
from sylpose.landmarks.alignment import Sights, align
from sylpose.simulate import ring
from sylpose.two_frames import robust_fit
from sylpose.two_frames.warming import warm_up, warm_up_reweighting, warm_up_search, warm_up_verdicts

__all__ = ["PARTS", "compile_all", "is_compiled"]


def following() -> None:
    """Features from image to image."""
    image = np.random.default_rng(0).integers(0, 255, (120, 160), np.uint8)
    klt.advance(klt.begin(image, [[60.0, 60.0], [80.0, 50.0]]), image, image)


def landmarks() -> None:
    """A frame's pose by landmarks."""
    rig, points = ring(3, height=(0.4, -0.1, 0.2)), np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3))
    sights = [
        Sights(
            points=points,
            depth_error=0.01 * (points - camera.center),
            image=camera.normalize(camera.project(points)),
            feature=np.arange(len(points)),
            trust=np.ones(len(points)),
            rotation=camera.rotation,
            center=camera.center,
            focal=camera.focal,
        )
        for camera in rig
    ]
    align(sights, np.eye(3), np.zeros(3))


def refining() -> None:
    """All poses together."""
    rig, points = ring(3, height=(0.4, -0.1, 0.2)), np.random.default_rng(0).uniform(-0.1, 0.1, (40, 3))
    turns = [Rotation.from_rotvec(0.02 * k * np.array([0.05, -0.03, 0.08])) for k in range(4)]
    images = np.array([[c.normalize(c.project(turn.apply(points))) for c in rig] for turn in turns])
    frame, camera, landmark = (index.ravel() for index in np.indices(images.shape[:3]))
    poses = RigidTransform.from_components(np.zeros((len(turns), 3)), Rotation.concatenate(turns))
    seen = Observations(frame, camera, landmark + len(points) * camera, images.reshape(-1, 2))
    bundle(rig, seen, poses, 0.1, offsets_sd=0.1)


# The longest first: together they take as long as that one, where there are cores enough.
PARTS: dict[str, Callable[[], None]] = {
    "search": warm_up_search,
    "reweighting": warm_up_reweighting,
    "refining": refining,
    "landmarks": landmarks,
    "verdicts": warm_up_verdicts,
    "following": following,
}


def is_compiled() -> bool:
    """Whether that seems to have been done: what is compiled last is there, of its present source. What is missing all the
    same is compiled when it is called."""
    kept = _cache().rglob("robust_fit.robust_fit-*.nbi")
    written = Path(robust_fit.__file__).stat().st_mtime_ns
    return any(path.stat().st_mtime_ns >= written for path in kept)


def compile_all() -> None:
    """Compiles what tracking needs, by as many processes as there are cores, or loads it where that has been done.

    Where nothing can be kept, processes would not help each other: then what is called is compiled here.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if cores > 1 and os.access(_cache(), os.W_OK) and not is_compiled():
        with ThreadPoolExecutor(min(cores, len(PARTS))) as pool:
            list(pool.map(_compiled_elsewhere, PARTS))
    warm_up()


def _cache() -> Path:
    """Where Numba keeps what is compiled of two frames."""
    return Path(os.environ.get("NUMBA_CACHE_DIR") or Path(robust_fit.__file__).parent)


def _compiled_elsewhere(part: str) -> None:
    """A process that fails has not helped."""
    command = [sys.executable, "-W", "ignore", "-m", "sylpose.app.compiling", part]
    subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, check=False)


def main(parts: Sequence[str]) -> None:
    """Compiles some parts, or all."""
    for part in parts:
        PARTS[part]()
    if not parts:
        compile_all()


if __name__ == "__main__":
    main(sys.argv[1:])
