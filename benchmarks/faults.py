"""Faults: does `sylpose check` name the right one, and no healthy camera, by number of cameras?

    python benchmarks/faults.py [KIND ...] [--cameras 2 3 4] [--seeds 0:4] [--jobs N] [--each]

The takes are those of `benchmarks/trust.py` with one faulty camera, with a rig that is wrong as a whole, and without a
fault, of a given number of cameras. A take is examined as `sylpose check` does it. Counted are takes in which

- *fault*: the fault itself is named, alone or with up to two others that the motion does not distinguish from it,
- *camera*: not the fault, but the faulty camera is named, as one to be left out or looked at,
- *contradiction*: only that the cameras contradict each other,
- *wrong*: only other faults or healthy cameras are named,
- *nothing*. That is right without a fault, and where the fault does not change what is measured.

Of two cameras either may be at fault. Prints a row for each kind and number of cameras, with --each also for each take.

`--seeds 4:8` draws four takes with this number of cameras from the seeds 4000, 4001, ... The takes 0 to 3 were looked at
while developing.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Generator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import islice

import cv2
import numpy as np

from benchmarks.trust import draw
from benchmarks.trust_camera_faults import ONE_CAMERA, REGULAR, WHOLE_RIG
from benchmarks.trust_takes import Take, warn_without_photographs
from sylpose.frames import FrameSet
from sylpose.io.capture.repetitions import RepetitionFilter
from sylpose.relative_pose.rig_hypotheses import Mistake
from sylpose.runs.candidates import read_windows
from sylpose.runs.rig_evidence import RigFindings, examine_rig
from sylpose.tracking.bodies import WINDOW_FRAMES, compare_cameras, find_candidates, reduce_frame_set

GROUPS = {"one camera": ONE_CAMERA, "whole rig": WHOLE_RIG, "no fault": REGULAR}
# What names the fault of a kind. Flipped images and left-handed worlds are the same, and so are mirrored images of two
# cameras, or of cameras in one plane, and turned ones.
NAMES: dict[str, tuple[Mistake, ...]] = {
    "one-mirrored": (Mistake.MIRRORED,),
    "one-upside-down": (Mistake.TURNED,),
    "late-1": (Mistake.LATE,),
    "late-2": (Mistake.LATE,),
    "late-3": (Mistake.LATE,),
    "pair-exchanged": (Mistake.EXCHANGED,),
    "all-mirrored": (Mistake.MIRRORED,),
    "staggered-mirrored": (Mistake.MIRRORED,),
    "all-upside-down": (Mistake.TURNED,),
    "all-exchanged": (Mistake.EXCHANGED,),
    "poses-inverted": (Mistake.INVERTED,),
    "opengl-axes": (Mistake.OPENGL,),
    "left-handed": (Mistake.FLIPPED,),
    "wrong-unit": (Mistake.UNIT,),
}
OUTCOMES = "fault", "camera", "contradiction", "wrong", "nothing"


@dataclass(frozen=True)
class Outcome:
    """What was reported of a take.

    Attributes:
        seed: of the take.
        faulty: indices of the faulty cameras.
        outcome: one of `OUTCOMES`.
        details: what was named.
    """

    seed: int
    faulty: tuple[int, ...]
    outcome: str
    details: str


def find_faulty(take: Take) -> tuple[int, ...]:
    """Return the cameras whose images, time or calibration differ from what the tracker is given."""
    rng, rig = np.random.default_rng(0), take.scene.rig
    film = [
        [rng.integers(0, 256, (c.size[1], c.size[0], 3)).astype(np.uint8) for _ in range(take.scene.frames)]
        for c in rig
    ]
    changed = [list(images) for images in film]
    for effect in take.effects:
        changed = effect(take, changed)
    has_effect = [
        any(not np.array_equal(a, b) for a, b in zip(*pair, strict=True)) for pair in zip(film, changed, strict=True)
    ]
    given = [
        not np.array_equal(a.matrix, b.matrix)
        or not np.allclose(a.camera_from_world.as_matrix(), b.camera_from_world.as_matrix())
        for a, b in zip(rig, take.calibration, strict=True)
    ]
    is_late = [c in take.clocks and not take.stamped for c in range(len(rig))]
    return tuple(c for c in range(len(rig)) if has_effect[c] or given[c] or is_late[c] or c in take.stand_ins)


def examine_take(kind: str, seed: int) -> Outcome:
    """Examine a take as `sylpose check` does it."""
    cv2.setNumThreads(1)
    take = draw(kind, seed)
    pictures, sets = RepetitionFilter(take.scene.rig.names), list[FrameSet]()
    for frame in take.frames():
        sets.append(replace(frame, images=tuple(pictures.remove(frame.index, frame.images)[0])))

    def read(numbers: Sequence[int]) -> Generator[FrameSet, None, None]:
        yield from (sets[k] for k in numbers)

    rig, numbers = take.calibration, range(len(sets))
    if take.boxes is None:
        candidates = find_candidates(rig, read_windows(numbers, read), workers=1)
        f_ratio = candidates[0].f_ratio if candidates else np.nan
    else:
        f_ratio = compare_cameras(rig, [*map(reduce_frame_set, sets[:WINDOW_FRAMES])], take.boxes, workers=1)
    findings = examine_rig(rig, numbers, read, f_ratio)
    faulty = find_faulty(take)
    return Outcome(seed, faulty, *judge(kind, findings, faulty, len(rig)))


def judge(kind: str, findings: RigFindings, faulty: tuple[int, ...], cameras: int) -> tuple[str, str]:
    """Return the outcome, and what was named."""
    named = [fit.hypothesis for fit in findings.explanations]
    blamed = {c for h in named if h.mistake is not Mistake.EXCHANGED for c in h.cameras}
    moved = {nudge.camera for nudge in findings.nudges}
    blamed |= {*findings.frozen, *findings.still} | moved
    if findings.suspect is not None:
        blamed.add(findings.suspect)
    details = ", ".join(
        [
            *(f"{h.mistake} {h.cameras or ''} {h.lag or ''}".strip() for h in named),
            *(f"frozen {c}" for c in findings.frozen),
            *(f"still {c}" for c in findings.still),
            *(f"moved {c}" for c in moved),
            *([] if findings.suspect is None else [f"suspect {findings.suspect}"]),
        ]
    )
    if kind in REGULAR:
        is_reported = bool(named or blamed or findings.is_contradicted)
        return ("wrong" if is_reported else "nothing"), details
    is_one = kind in ONE_CAMERA and cameras > 2
    for h in named:
        affected = {c for c, source in enumerate(h.cameras) if c != source or h.mistake is not Mistake.EXCHANGED}
        affects = not is_one or affected <= set(faulty)
        if h.mistake in NAMES.get(kind, ()) and affects:
            return "fault", details
    seen = {
        "frozen": {*findings.frozen},
        "frozen-later": {*findings.frozen},
        "motionless-picture": {*findings.still},
        "bumped": moved,
    }
    if seen.get(kind, set()) & set(faulty):
        return "fault", details
    if is_one and blamed - set(faulty):
        return "wrong", details
    if kind in ONE_CAMERA and blamed & set(faulty):
        return "camera", details
    if named or blamed:
        return "wrong", details
    return ("contradiction" if findings.is_contradicted else "nothing"), details


def list_seeds(kind: str, cameras: int, first: int, end: int) -> list[int]:
    """List the first takes of a kind with a number of cameras, from a seed on."""
    seeds = range(1000 * first, 1000 * first + 100)
    return [*islice((seed for seed in seeds if len(draw(kind, seed).scene.rig) == cameras), end - first)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", metavar="KIND")
    parser.add_argument("--cameras", type=int, nargs="+", default=[2, 3, 4])
    parser.add_argument("--seeds", default="0:4", help="first:end")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes")
    parser.add_argument("--each", action="store_true", help="print a row for each take")
    arguments = parser.parse_args()
    first, end = map(int, arguments.seeds.split(":"))
    warn_without_photographs()
    cv2.setNumThreads(1)  # processes that are forked lack the threads that drawing takes would start
    print(f"{'kind':24}{'cameras':>8}" + "".join(f"{name:>15}" for name in OUTCOMES), flush=True)
    with ProcessPoolExecutor(arguments.jobs) as pool:
        for kind in arguments.kinds or [name for group in GROUPS.values() for name in group]:
            for cameras in arguments.cameras:
                seeds = list_seeds(kind, cameras, first, end)
                done = [*pool.map(examine_take, [kind] * len(seeds), seeds)]
                counts = Counter(own.outcome for own in done)
                print(f"{kind:24}{cameras:8}" + "".join(f"{counts[name]:15}" for name in OUTCOMES), flush=True)
                for own in done if arguments.each else ():
                    print(f"    {own.seed} faulty {own.faulty}: {own.outcome}; {own.details}", flush=True)


if __name__ == "__main__":
    main()
