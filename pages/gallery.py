"""Build the gallery: render scenes, track them, compare with the truth.

    python -m pages.gallery [NAME ...]      about three minutes on two cores

Writes docs/images/gallery_NAME.jpg and docs/gallery.md. Nothing is random: equal scenes give equal pictures.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import av
import numpy as np
from matplotlib.figure import Figure
from PIL import Image
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.rendered_recordings import Recording, write_recording
from benchmarks.self_calibration import KINDS, make_scene
from sylpose.geometry.arrays import FloatArray
from sylpose.io import calibration
from sylpose.io.capture import Session, open_session
from sylpose.report.camera_consistency import describe_camera_problems
from sylpose.report.files import read_tum
from sylpose.report.plots import INK, JUMP_DEG, X_COLOR, Y_COLOR, Z_COLOR, create_figure, style_panel
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Rig
from sylpose.rig_calibration.from_motion import locate
from sylpose.runs.options import RunOptions
from sylpose.runs.run import track_session
from sylpose.runs.self_calibration import KnownLength, self_calibrate
from sylpose.simulate import Actor, Scene, arc, chamfered_box, make_demo_scene
from sylpose.simulate.recordings import object_suffixes
from sylpose.status import FrameStatus

__all__ = ["SCENES", "Shown", "page", "results"]

DOCS = Path(__file__).resolve().parent.parent / "docs"
# Multiples of 64: with other widths the encoder pads the edge with arbitrary data, and videos differ from run to run.
SIZE = (384, 288)
# Width of a picture, pixels, and JPEG's quality (choice: less than 100 kB each).
WIDTH, QUALITY = 880, 82


@dataclass(frozen=True)
class Shown:
    """A scene of the gallery.

    Attributes:
        title, words: heading and description.
        recording: makes the rendered recording.
        frame: the frame whose images are shown.
        command: the user's command.
        calibration: makes a wrong calibration from the true rig; None for the true one.
        options: arguments of `track_session`.
        fov_error: relative error of the field of view from which the cameras are calibrated by the moving object; None: they
            are calibrated.
    """

    title: str
    words: str
    recording: Callable[[], Recording]
    frame: int
    command: str = "sylpose track recording"
    calibration: Callable[[Rig], Rig] | None = None
    options: dict[str, Any] = field(default_factory=dict)
    fov_error: float | None = None


def _block() -> Recording:
    return Recording(make_demo_scene(frames=45, angle_deg=90.0, size=SIZE), boxes=False)


def _around() -> Recording:
    """Render a full rotation, after which the first side is visible again."""
    return Recording(make_demo_scene(frames=90, angle_deg=360.0, size=SIZE, seed=3), boxes=False)


def _passing() -> Recording:
    """Render a tall body that passes between the cameras and the block."""
    scene = make_demo_scene(frames=60, angle_deg=60.0, size=SIZE, seed=1)
    rig = scene.rig
    before = np.mean([c.center for c in rig], axis=0) * 0.42
    across = np.cross(before / np.linalg.norm(before), [0.0, 1.0, 0.0])
    body = chamfered_box([0.26, 0.9, 0.16], 400.0, seed=8)

    def path(frame: float) -> RigidTransform:
        return RigidTransform.from_translation(before + across * (0.035 * (frame - 30.0)))

    return Recording(replace(scene, actors=(*scene.actors, Actor(body, path))), boxes=False)


def _two() -> Recording:
    """Render two blocks that move independently."""
    rig = arc(4, 35.0, 1.5, 1.1 * SIZE[0], SIZE, height=[0.45, -0.15, 0.45, -0.15])
    bodies = [chamfered_box(sides, 450.0, seed=seed) for sides, seed in (((0.26, 0.2, 0.22), 5), ((0.2, 0.26, 0.2), 6))]
    sides = (-0.2, 0.2)
    axes = ([0.2, 0.95, 0.2], [0.7, -0.6, 0.3])

    def path(k: int) -> Callable[[float], RigidTransform]:
        def at(frame: float) -> RigidTransform:
            s = frame / 44
            turn = Rotation.from_rotvec(np.radians(70 * s) * np.array(axes[k]))
            place = [sides[k], (0.15 - 0.3 * k) * np.sin(np.pi * s), 0.12 * np.sin(3 * s + k)]
            return RigidTransform.from_components(place, turn)

        return at

    actors = tuple(Actor(body, path(k)) for k, body in enumerate(bodies))
    return Recording(Scene(rig, actors, 45, 5), objects=("left", "right"))


def _alone() -> Recording:
    return Recording(make_demo_scene(frames=45, angle_deg=60.0, size=SIZE, n_cameras=1, seed=2), boxes=False)


def _blurred() -> Recording:
    """Render a fast rotation with an exposure of nearly a frame interval."""
    return Recording(make_demo_scene(frames=30, angle_deg=120.0, size=SIZE, seed=4, exposure=0.8), boxes=False)


def _webcams() -> Recording:
    """Render a block that tumbles by 300 degrees before four cameras and is carried about."""
    tumbling = make_scene(KINDS["near"], 3)
    target = tumbling.object_poses().translation.mean(axis=0)
    rig = arc(4, 40.0, 1.2, 1.3 * SIZE[0], SIZE, height=[0.1, 0.35, -0.1, 0.3], target=target)
    return Recording(replace(tumbling, rig=rig), boxes=False)


def _kicked(rig: Rig) -> Rig:
    """Rotate one camera by three degrees after its calibration."""
    turned = RigidTransform.from_rotation(Rotation.from_rotvec(np.radians([0.0, 3.0, 0.0])))
    cameras = [replace(c, camera_from_world=turned * c.camera_from_world) if c.name == "cam_2" else c for c in rig]
    return Rig(cameras, rig.unit)


SCENES = {
    "block": Shown(
        "A block",
        "Four cameras on a quarter of a circle; a block rotates by 90° and drifts. No box is given: whatever moves is "
        "tracked.",
        _block,
        30,
    ),
    "around": Shown(
        "All the way round",
        "A full rotation in three seconds. Each side is visible to each camera for a while. When the first side is "
        "visible again, it is recognized, and the accumulated drift is removed.",
        _around,
        60,
    ),
    "passing": Shown(
        "An occlusion",
        "A post passes in front of the cameras and hides the block from one after the other. Cameras with a view of the "
        "block continue. A camera that sees mostly the post has its variance inflated until it sees the block again.",
        _passing,
        33,
    ),
    "two": Shown(
        "Two objects",
        "With a box for each object in the first frame (`boxes.toml`), each has its own trajectory.",
        _two,
        30,
    ),
    "webcams": Shown(
        "From four webcams to poses without a board in five minutes",
        "Nothing is calibrated: no board, no lens. Put four cameras around, film any object that you turn and carry about "
        "for a few seconds, measure the distance of two cameras with a tape, and look up the field of view in the data "
        "sheet (here it is wrong: 15 % too small). `sylpose track recording --self-calibrate --fov 36 --distance "
        "cam_0:cam_1=0.86m` tracks by each camera alone, calibrates the rig from the motion that all cameras share, and "
        "tracks by all of them ([how](calibrating.md#without-a-board)).",
        _webcams,
        30,
        command="sylpose track recording --self-calibrate --fov 36 --distance cam_0:cam_1=0.86m",
        fov_error=-0.15,
    ),
    "blurred": Shown(
        "Motion blur",
        "120° in a second, with an exposure of four fifths of the frame interval.",
        _blurred,
        15,
    ),
    "alone": Shown(
        "One camera",
        "The object's size and distance are not observable: every frame has `scale not observable`, and lengths are in "
        "units of the first distance. The rotation is observable nevertheless.",
        _alone,
        30,
    ),
    "kicked": Shown(
        "A camera that was moved",
        "`cam_2` was rotated by 3° after the calibration. The other cameras outvote it, and the summary names it.",
        _block,
        30,
        calibration=_kicked,
    ),
}


@dataclass(frozen=True)
class Outcome:
    """Result of tracking a scene.

    Attributes:
        trajectories: by object.
        off: by object, (N,) errors of the orientation, degrees; NaN without a pose.
        image: the overlay of the shown frame.
        remark: sentence on a calibration from motion.
    """

    trajectories: dict[str, Trajectory]
    off: dict[str, FloatArray]
    image: Image.Image
    remark: str = ""


def tracked(shown: Shown) -> Outcome:
    """Render a scene, track it and compare it with the truth."""
    with TemporaryDirectory() as temporary:
        folder = Path(temporary) / "recording"
        recording = shown.recording()
        write_recording(recording, folder)
        if shown.calibration is not None:
            calibration.save(shown.calibration(recording.scene.rig), folder / "calibration.toml")
        remark, covariance, session = "", None, open_session(folder)
        if shown.fov_error is not None:
            session, covariance, remark = _calibrated(folder, session.rig, shown.fov_error)
        run = track_session(session, options=RunOptions(**shown.options, calibration_covariance=covariance))
        off = {}
        for name, suffix in zip(recording.objects, object_suffixes(recording.objects), strict=True):
            _, truth = read_tum(folder / f"groundtruth{suffix}.tum")
            off[name] = np.array([_off(pose, truth) for pose in run.trajectories[name]])
        with av.open(str(folder / "sylpose" / "overlay.mp4")) as video:
            frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
        return Outcome(dict(run.trajectories), off, Image.fromarray(frames[shown.frame]), remark)


def _calibrated(folder: Path, truth: Rig, fov_error: float) -> tuple[Session, FloatArray, str]:
    """Calibrate from a wrong field of view and the distance of two cameras; return the errors in a sentence, too."""
    size, focal = truth[0].size, truth[0].matrix[0, 0]
    fov = (1.0 + fov_error) * 2.0 * np.degrees(np.arctan(0.5 * size[0] / focal))
    session = open_session(folder, fov=fov)
    distance = KnownLength(
        float(np.linalg.norm(truth[0].center - truth[1].center)), "m", (truth.names[0], truth.names[1])
    )
    found = self_calibrate(session, ("fov",), scale=distance)
    # The world of the truth, in which the first camera has its true place.
    first = truth[0].camera_from_world
    cameras = [replace(c, camera_from_world=c.camera_from_world * first) for c in found.calibration.rig]
    found = locate(found, Rig(cameras, "m"))
    rig = found.calibration.rig
    pairs = [(c, truth[c.name]) for c in rig]
    rotation = max((a.camera_from_world.rotation * b.camera_from_world.rotation.inv()).magnitude() for a, b in pairs)
    place = max(np.linalg.norm(a.center - b.center) for a, b in pairs)
    lens = max(abs(a.matrix[0, 0] / b.matrix[0, 0] - 1.0) for a, b in pairs)
    remark = (
        f"The calibration: rotations of the cameras are off by {np.degrees(rotation):.2f}° at worst, places by "
        f"{1000 * place:.1f} mm, focal lengths by {100 * lens:.1f} %."
    )
    return session.select_cameras(rig.names).with_rig(rig), found.covariance, remark


def _off(pose: FramePose, truth: RigidTransform) -> float:
    """Return the error of the orientation since the first frame, degrees."""
    if pose.world_from_object is None:
        return np.nan
    return float(np.degrees((pose.world_from_object.rotation * truth[pose.index].rotation.inv()).magnitude()))


def drawn(outcome: Outcome) -> Figure:
    """Plot angles, their errors and two standard deviations over time."""
    figure = create_figure(4.4, 4.9)
    angles, errors = figure.subplots(2, 1, sharex=True)
    top = 0.0
    for trajectory, off, style in zip(outcome.trajectories.values(), outcome.off.values(), ("-", "--"), strict=False):
        turns = np.degrees([f.pan_tilt_roll for f in trajectory])
        # Interrupt the line where an angle wraps around.
        turns[1:][np.abs(np.diff(turns, axis=0)) > JUMP_DEG] = np.nan
        found = trajectory.measured_mask
        for k, (name, color) in enumerate((("pan", Y_COLOR), ("tilt", X_COLOR), ("roll", Z_COLOR))):
            angles.plot(trajectory.times, np.where(found, turns[:, k], np.nan), style, color=color, label=name)
            angles.plot(
                trajectory.times, np.where(found, np.nan, turns[:, k]), ".", color=color, alpha=0.4, markersize=3
            )
        errors.plot(trajectory.times, off, style, color=INK, linewidth=1.2, label="off the truth")
        spread = 2 * np.degrees([np.sqrt(np.trace(f.covariance[:3, :3])) for f in trajectory])
        some = np.isfinite(spread) & np.isfinite(off)
        top = max(top, 1.3 * float(np.nanmax(off)), 1.2 * float(np.median(spread[some])))
        errors.fill_between(
            trajectory.times, 0, np.where(some, spread, np.nan), color=Z_COLOR, alpha=0.2, linewidth=0, label="2 σ"
        )
    for panel, label in ((angles, "angles (degrees)"), (errors, "error (degrees)")):
        style_panel(panel)
        panel.set_ylabel(label)
        handles, labels = panel.get_legend_handles_labels()
        once = dict(zip(labels, handles, strict=True))
        panel.legend(
            once.values(), once.keys(), frameon=False, fontsize=8, ncols=3, loc="lower left", bbox_to_anchor=(0, 1)
        )
    errors.set_ylim(0, top)
    errors.set_xlabel("time (s)")
    return figure


def picture(outcome: Outcome) -> Image.Image:
    """Combine the images of a frame with the plots."""
    file = io.BytesIO()
    drawn(outcome).savefig(file, format="png")
    plots = Image.open(file).convert("RGB")
    seen = outcome.image
    height = round(WIDTH * 0.62 * seen.height / seen.width)
    seen = seen.resize((round(WIDTH * 0.62), height), Image.Resampling.LANCZOS)
    side = WIDTH - seen.width
    plots = plots.resize((side, round(plots.height * side / plots.width)), Image.Resampling.LANCZOS)
    whole = Image.new("RGB", (WIDTH, max(seen.height, plots.height)), "white")
    whole.paste(seen, (0, (whole.height - seen.height) // 2))
    whole.paste(plots, (seen.width, (whole.height - plots.height) // 2))
    return whole


def words_of(outcome: Outcome) -> str:
    """Describe the result in a sentence per object."""
    said = [outcome.remark] if outcome.remark else []
    for (name, trajectory), off in zip(outcome.trajectories.items(), outcome.off.values(), strict=True):
        of = f"`{name}`: " if len(outcome.trajectories) > 1 else ""
        found = trajectory.measured_mask
        line = f"{of}{int(found.sum())} of {len(trajectory)} frames with a pose, off by {np.nanmedian(off[found]):.2f}° in "
        line += f"the median and {np.nanmax(off[found]):.2f}° at worst."
        others = [f.status for f in trajectory if not f.is_measured]
        if others:
            counted = [f"{status.value} {others.count(status)}" for status in FrameStatus if status in others]
            line += f" The others: {', '.join(counted)}."
        said.append(
            " ".join(
                [line, *(f'The summary reports: "{remark}"' for remark in describe_camera_problems(trajectory)[:1])]
            )
        )
    return " ".join(said)


def page(outcomes: dict[str, str]) -> str:
    """Generate the page from the results of all scenes."""
    parts = [
        "# Gallery",
        "Rendered scenes with known truth, tracked like any recording. Left: the images of one frame, as in "
        "`overlay.mp4`. Right: the angles over time, and the error of the orientation with two standard deviations. These "
        "include the usual errors of calibrations, which are exact here. `make gallery` rebuilds this page. "
        "[benchmarks](history/benchmarks.md#the-main-job) has results of real recordings.",
    ]
    for name, shown in SCENES.items():
        parts += [
            f"## {shown.title}",
            shown.words,
            f"![{shown.title}: the images of a frame, angles and errors over time](images/gallery_{name}.jpg)",
            outcomes[name],
        ]
    return "\n\n".join(parts) + "\n"


def results() -> dict[str, str]:
    """Read the results of all scenes from the present page."""
    path = DOCS / "gallery.md"
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    found = {}
    for name, shown in SCENES.items():
        section = text.partition(f"\n## {shown.title}\n")[2].partition("\n## ")[0].strip()
        found[name] = section.rpartition("\n\n")[2]
    return found


def main(names: Sequence[str]) -> None:
    outcomes = results()
    for name, shown in SCENES.items():
        if not names or name in names:
            outcome = tracked(shown)
            picture(outcome).save(DOCS / "images" / f"gallery_{name}.jpg", quality=QUALITY, optimize=True)
            outcomes[name] = words_of(outcome)
            print(f"{name}: {outcomes[name]}", flush=True)
    (DOCS / "gallery.md").write_text(page(outcomes), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
