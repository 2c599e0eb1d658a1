"""Limits of the tracker at half and twice their defaults, one at a time: wrong and sure, localized, errors, bounds.

    python benchmarks/tracking_options.py [FIELD ...] [--seed 0] [--jobs N] [--each]

Each field of `TrackingOptions` is set to half and to twice its default, and the recordings that it may concern are tracked:
all have those of `EACH`, and some fields one of `SPECIAL`. Poses are scored as in `benchmarks/trust.py`, as tracked. Columns
are the frames wrong and sure, the localized ones, the median error as a factor of that with the defaults, and the share of
the frames in their 95 % bounds of rotation, %. Fields without a difference are listed below the table.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields
from functools import partial

import cv2
import numpy as np

from benchmarks.trust import Score, draw, score_poses
from benchmarks.trust_takes import Take
from sylpose import TrackingOptions, track
from sylpose.frames import Box
from sylpose.simulate import compute_demo_truth, make_demo_scene

# A right rig, a late object, compression, a wrong rig, another body, faint and fast objects, and frames without the object.
EACH = (
    "hand-board",
    "late-third",
    "low-h264-person",
    "rotated-3",
    "person-walks-behind",
    "faint",
    "six-per-second",
    "taken-away",
    "occluder",
)


def make_demo_take(seed: int, frames: int, angle_deg: float, n_cameras: int) -> Take:
    """Make a take of the demo's block, in boxes."""
    scene = make_demo_scene(frames=frames, angle_deg=angle_deg, seed=seed, size=(480, 360), n_cameras=n_cameras)
    truth = compute_demo_truth(scene)
    boxes = {camera: Box(*box) for camera, box in truth.boxes.items()}
    corners = scene.actors[0].body.vertices
    return Take(scene, boxes, float(np.linalg.norm(corners - corners.mean(axis=0), axis=1).max()))


# Recordings that reach the limits of some fields: long ones with more keyframes than are kept, one camera.
LONG = partial(make_demo_take, frames=240, angle_deg=1200.0, n_cameras=3)
ONE_CAMERA = partial(make_demo_take, frames=60, angle_deg=60.0, n_cameras=1)
SPECIAL: dict[str, tuple[str, Callable[[int], Take]]] = {
    "max_keyframes": ("long", LONG),
    "max_reference_keyframes": ("long", LONG),
    "max_window_frames": ("long", LONG),
    "min_keyframe_rotation": ("long", LONG),
    "max_rival_ratio_monocular": ("one camera", ONE_CAMERA),
    "max_buffered_frames": ("rests-long", partial(draw, "rests-long")),
}


def make_take(name: str, seed: int) -> Take:
    """Make the take of a name of `EACH` or `SPECIAL`."""
    special = dict(SPECIAL.values())
    return special[name](seed) if name in special else draw(name, seed)


def score_recording(name: str, seed: int, changes: dict[str, float]) -> Score:
    """Track a recording with changed options."""
    cv2.setNumThreads(1)
    take = make_take(name, seed)
    frames = track(list(take.frames()), take.calibration, take.boxes, options=TrackingOptions(**changes), workers=1)  # type: ignore[arg-type]
    return score_poses(take, [frame.pose for frame in frames])


def format_scores(scores: Sequence[Score], defaults: Sequence[Score]) -> str:
    """Format a cell: wrong and sure, localized, error relative to the defaults, share in the bounds."""
    ratios = [
        own.degrees[0] / other.degrees[0] for own, other in zip(scores, defaults, strict=True) if other.degrees[0] > 0.0
    ]
    error = np.exp(np.nanmean(np.log(np.maximum(ratios, 1e-9)))) if ratios else np.nan
    inside = 100 * sum(s.in_bounds[0] for s in scores) / max(sum(s.n_bounded for s in scores), 1)
    return f"{sum(s.sure for s in scores)}, {sum(s.localized for s in scores)}, {error:.2f}, {inside:.0f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fields", nargs="*", metavar="FIELD", help="of TrackingOptions; default: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--each", action="store_true", help="print each recording")
    arguments = parser.parse_args()
    defaults = {f.name: getattr(TrackingOptions(), f.name) for f in fields(TrackingOptions)}
    names = arguments.fields or list(defaults)
    unchanged = []
    with ProcessPoolExecutor(arguments.jobs) as pool:
        recordings = list(dict.fromkeys((*EACH, *(SPECIAL[name][0] for name in names if name in SPECIAL))))
        base = {own: pool.submit(score_recording, own, arguments.seed, {}) for own in recordings}
        print(
            "| field | default | default: wrong and sure, localized, error, bounds | half | twice |\n"
            + "|---" * 5
            + "|"
        )
        for name in names:
            own = (*EACH, SPECIAL[name][0]) if name in SPECIAL else EACH
            value, reference = defaults[name], [base[take].result() for take in own]
            cells = [format_scores(reference, reference)]
            for factor in (0.5, 2.0):
                change = {name: type(value)(factor * value)}
                try:
                    TrackingOptions(**change)
                except ValueError:
                    cells.append("out of range")
                    continue
                jobs = [pool.submit(score_recording, take, arguments.seed, change) for take in own]
                scores = [job.result() for job in jobs]
                cells.append(format_scores(scores, reference))
                if arguments.each:
                    for take, score, before in zip(own, scores, reference, strict=True):
                        if score.statuses != before.statuses:
                            print(f"  {name} {factor:g} {take}: {format_scores([score], [before])} {score.statuses}")
            if len(set(cells)) == 1:
                unchanged.append(name)
            else:
                print(f"| `{name}` | {value:g} | {' | '.join(cells)} |", flush=True)
    print("No difference:", ", ".join(f"`{name}`" for name in unchanged))


if __name__ == "__main__":
    main()
