"""`sylpose check`: what is understood of a session and what looks wrong with it, in sentences for people."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sylpose.app import console_output
from sylpose.app.console_output import length
from sylpose.app.preview import Follows, box_outlines, what_moves
from sylpose.app.run_metadata import WORLD
from sylpose.app.session_options import check_out
from sylpose.app.session_warnings import boxes_by, notes
from sylpose.atomic_io import output_folder
from sylpose.calibration import format_of
from sylpose.calibration.world import save_world
from sylpose.capture import Session
from sylpose.capture.live import LiveSession
from sylpose.geometry.arrays import FloatArray
from sylpose.report.preview import draw_followed, draw_world
from sylpose.report.rigview import describe_rig, meeting_point, plot_rig
from sylpose.rig import Rig
from sylpose.tracking.region import volume_from_boxes

__all__ = [
    "Place",
    "axes_miss",
    "check_aloud",
    "concerns",
    "facts",
    "look_at",
    "object_place",
    "obstacles",
    "warnings",
]


# Cameras nearer to each other than this share of their distance to the object count as one place (choice: parallax
# of a pixel at f = 1000 px).
ONE_PLACE = 1e-3
# Axes that pass each other by no more than this share of the cameras' distance meet (choice: aimed by hand, a degree).
AXES_MEET = 0.02
# Distances beyond this are hardly metres (choice).
LARGE = 200.0


@dataclass(frozen=True, eq=False)
class Place:
    """Where the object is expected.

    Attributes:
        center: (3,) in the world; None when nothing tells.
        radius: of the object, or None.
        source: "the boxes" or "the optical axes".
        obstacle: a sentence, when boxes are given that cannot be of one object.
    """

    center: FloatArray | None
    radius: float | None
    source: str
    obstacle: str = ""


def check_aloud(session: Session, out: Path | None) -> None:
    """Says what is understood of a session, what will be followed in it and what looks wrong; draws its rig into `rig.png`,
    and what will be followed into `follows.png`.

    Args:
        out: folder for the pictures; None: `sylpose` in the session's folder.

    Raises:
        ValueError: boxes that cannot be of one object.
        OSError: naming the file or folder that cannot be written.
    """
    folder = session.path / "sylpose" if out is None else out
    check_out(session, folder)
    picture = output_folder(folder) / "rig.png"
    places = {name: object_place(session.of(name)) for name in session.objects}
    place = next(iter(places.values()))
    console = console_output.make_console()
    console.print(console_output.headline(session))
    console.print()
    console_output.print_table(
        console, console_output.RIG_HEADER, console_output.rig_rows(session, describe_rig(session.rig, place.center))
    )
    console.print()
    console_output.print_facts(console, facts(session, places))
    plot_rig(session.rig, picture, place.center if place.radius else None, place.radius)
    wrong = obstacles(places)
    followed = None if wrong else follows(session)
    pictures = [picture]
    if followed is not None and followed.frames is not None:
        pictures.append(picture.with_name("follows.png"))
        draw_followed(pictures[-1], followed.frames.images, session.rig.names, followed.outlines)
    if session.world is not None:
        pictures.append(picture.with_name("world.png"))
        first = followed.frames if followed is not None else None
        images = first.images if first is not None else [None] * len(session.rig)
        draw_world(pictures[-1], images, session.rig)
        save_world(session.world, picture.with_name(WORLD))
    console_output.print_files(console, "Pictures" if len(pictures) > 1 else "Picture", pictures)
    console.print()
    if followed is not None:
        console.print(f"Follows: {followed.said}.", highlight=False)
    found = [*warnings(session, places), *(followed.wrong if followed is not None else ())]
    console_output.print_warnings(console, found)
    if wrong:
        raise ValueError(f"{'; '.join(wrong)} ({boxes_by(session)} anew)")
    missed = axes_miss(session.rig)
    if found:
        console.print("Can be tracked; see the warnings above.")
    else:
        console.print(f"Can be tracked. {missed}" if missed else "Ready to track.")


def follows(session: Session) -> Follows:
    """What will be followed: what is in the boxes of the first object, or what moves without any."""
    name = next(iter(session.objects), None)
    boxes = session.boxes if name is None else session.of(name).boxes
    if not boxes:
        return what_moves(session)
    first = next(iter(session.frames()), None)
    return Follows(first, box_outlines(session, boxes), f"what is in the boxes of {', '.join(boxes)}")


def object_place(session: Session | LiveSession) -> Place:
    """Where boxes in two or more cameras meet; without them where the optical axes do."""
    if len(session.boxes) < 2:
        return Place(meeting_point(session.rig), None, "the optical axes")
    try:
        center, points = volume_from_boxes(session.rig, session.boxes)
    except ValueError as error:
        return Place(meeting_point(session.rig), None, "the optical axes", str(error))
    return Place(center, float(np.quantile(np.linalg.norm(points - center, axis=1), 0.95)), "the boxes")


def facts(session: Session, places: Mapping[str, Place]) -> list[tuple[str, str]]:
    """What was understood besides the cameras: label and words; `places` by object."""
    rig, unit = session.rig, session.rig.unit or "not said"
    calibration = session.calibration
    inside = calibration.parent.resolve() == session.path.resolve()
    name = calibration.name if inside else str(calibration)
    words = [("Calibration", f"{name}, {format_of(calibration)}, length unit {unit}")]
    kinds = {"video": "videos", "images": "folders of images"}
    if session.world is not None:
        words.append(("World", session.world.said or "of a file"))
    words.append(("Recorded", " and ".join(sorted({kinds[source.kind] for source in session.sources}))))
    stamps = np.isfinite(session.timeline.stamps).any()
    if stamps:
        times = f"timestamps.csv, {session.timeline.times[-1] - session.timeline.times[0]:.2f} s"
    elif session.rate:
        times = f"from the frame rate, {session.n_frames / session.rate:.2f} s"
    else:
        times = "none: the frame number is the time"
    words.append(("Time", times))
    for name in session.objects:
        boxes = session.of(name).boxes.items()
        said = ", ".join(f"{camera} {box.width:.0f}x{box.height:.0f}" for camera, box in boxes)
        words.append((_label("Boxes", name, session), said or "none: the object is what moves"))
    words.append(("Masks", "none" if session.masks is None else str(session.masks)))
    words += [(_label("Object", name, session), _where(rig, place)) for name, place in places.items()]
    return words


def _label(what: str, name: str, session: Session) -> str:
    return what if len(session.objects) == 1 else f"{what}, {name}"


def _where(rig: Rig, place: Place) -> str:
    if place.center is None:
        return "not known"
    # A thousandth of the distance is all that anybody wants to know here.
    grain = 1e-3 * float(np.mean([np.linalg.norm(place.center - c.center) for c in rig]))
    at = ", ".join(f"{value:.3g}" for value in np.where(np.abs(place.center) < grain, 0.0, place.center))
    where = f"where {place.source} meet, ({at})"
    if place.source == "the optical axes":
        where += f", to within {length(max(_off_axes(rig, place.center), grain), rig.unit)}"
    elif place.radius:
        where += f", radius up to {length(place.radius, rig.unit)}"
    return where


def concerns(session: Session | LiveSession, start: int = 0) -> list[str]:
    """What looks wrong with a session that is to be tracked from frame `start` on, without a look at its images."""
    return warnings(session, {name: object_place(session.of(name)) for name in session.objects}, start)


def warnings(session: Session | LiveSession, places: Mapping[str, Place], start: int = 0) -> list[str]:
    """All that looks wrong but can be worked with, or at least tried, from frame `start` on; `places` by object."""
    of_objects = {
        name: [*look_at(session.rig, place), *_boxes(session.of(name), place, start)] for name, place in places.items()
    }
    # What is wrong with the rig is so for all of them.
    common = [said for said in next(iter(of_objects.values())) if all(said in own for own in of_objects.values())]
    own = [f"{name}: {said}" for name, found in of_objects.items() for said in found if said not in common]
    return [*notes(session, start), *common, *own]


def obstacles(places: Mapping[str, Place]) -> list[str]:
    """Why objects cannot be tracked."""
    return [
        place.obstacle if len(places) == 1 else f"{name}: {place.obstacle}"
        for name, place in places.items()
        if place.obstacle
    ]


def look_at(rig: Rig, place: Place) -> list[str]:
    """What looks wrong with how the cameras stand and look."""
    if len(rig) == 1:
        return ["One camera only: how far the object moves cannot be told, only in units of its first distance."]
    found = []
    rows = describe_rig(rig, place.center)
    spread = max(max(row.angles) for row in rows)
    if place.center is None:
        if spread > 5.0:
            said = "The cameras look away from each other: their axes come near no common point in front of them."
            inverse = Rig([replace(camera, camera_from_world=camera.camera_from_world.inv()) for camera in rig])
            if meeting_point(inverse) is not None:
                said += " With the inverses of its poses they would: the calibration seems to hold world_from_camera."
            found.append(said)
    else:
        blind = [row.name for row, camera in zip(rows, rig, strict=True) if not _sees(rig, camera.name, place.center)]
        if blind:
            at = "the place where the boxes meet" if place.source == "the boxes" else "the place where the axes meet"
            rest = "it" if len(blind) == 1 else "they"
            look = "looks" if len(blind) == 1 else "look"
            found.append(f"{', '.join(blind)}: {at} is not in the image; {rest} {look} elsewhere.")
    reach = max(max(row.baselines) for row in rows)
    if place.center is not None:
        reach = float(np.median([row.distance for row in rows]))
    pairs = [
        f"{row.name} and {other.name}"
        for i, row in enumerate(rows)
        for j, other in enumerate(rows[:i])
        if row.baselines[j] <= ONE_PLACE * reach
    ]
    if pairs:
        found.append(
            f"At one place: {', '.join(pairs[:5])}{', ...' if len(pairs) > 5 else ''}. From one place alone how far the "
            "object moves cannot be told."
        )
    if reach > LARGE and rig.unit in ("", "m"):
        found.append(
            f"Distances of {reach:.0f} {'m' if rig.unit else 'units'}: the calibration is probably in millimetres; "
            "all lengths come out in its unit."
        )
    return found


def _off_axes(rig: Rig, point: FloatArray) -> float:
    """How far a point is at most from a camera's optical axis."""
    return max(float(np.linalg.norm(np.cross(point - camera.center, camera.direction))) for camera in rig)


def axes_miss(rig: Rig) -> str:
    """A sentence where the optical axes pass each other by much, which is no fault by itself; "" where they meet."""
    point = meeting_point(rig)
    if point is None:
        return ""
    most = _off_axes(rig, point)
    share = most / float(np.median([np.linalg.norm(point - camera.center) for camera in rig]))
    if share <= AXES_MEET:
        return ""
    return (
        f"The optical axes miss each other by {length(most, rig.unit)}, {100 * share:.0f} % of the cameras' distance: no "
        "fault of cameras that were not aimed at one point; of those that were, the calibration is off."
    )


def _sees(rig: Rig, name: str, point: FloatArray) -> bool:
    pixel = rig[name].project(point)[0]
    return bool(np.isfinite(pixel).all() and (pixel >= 0).all() and (pixel <= np.array(rig[name].size) - 1).all())


def _boxes(session: Session | LiveSession, place: Place, start: int) -> list[str]:
    boxes, found = session.boxes, []
    if len(boxes) == 1 and len(session.rig) > 1:
        found.append(
            f"A box in one camera only ({next(iter(boxes))}): it does not tell how far away the object is; give one in "
            "each camera that sees it."
        )
    if place.source == "the boxes" and place.center is not None:
        for name, box in boxes.items():
            offset = session.rig[name].project(place.center)[0] - [box.x + box.width / 2, box.y + box.height / 2]
            if not (np.abs(offset) <= [box.width / 2, box.height / 2]).all():
                found.append(
                    f"The box of {name} does not fit the others: the place where they meet is "
                    f"{np.linalg.norm(offset):.0f} px from its middle."
                )
    if isinstance(session, LiveSession):
        return found
    first = session.timeline.frames[min(start, session.n_frames - 1)]
    late = [name for name, frame in zip(session.rig.names, first, strict=True) if name in boxes and frame < 0]
    if late:
        found.append(f"{', '.join(late)}: a box for the first frame, in which this camera has no image.")
    return found
