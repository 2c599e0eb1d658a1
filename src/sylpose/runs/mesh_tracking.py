"""Tracking of a body of known shape in a recording: what it needs, backgrounds of the cameras, its tracker."""

from __future__ import annotations

from contextlib import closing

import numpy as np

from sylpose.geometry.arrays import Image
from sylpose.io.capture import Session
from sylpose.io.capture.live import LiveSession
from sylpose.mesh import Mesh
from sylpose.report.rigview import find_axes_intersection
from sylpose.rig import Rig
from sylpose.runs.options import RunOptions
from sylpose.silhouettes.carving import MIN_IMAGES
from sylpose.silhouettes.contour_tracker import ContourTracker, SampledBackground
from sylpose.silhouettes.contours import MIN_POINTS
from sylpose.silhouettes.rendering import reduce_image

# Faces of a mesh (choice: a search draws it some 40,000 times, in a minute or two).
MAX_FACES = 20_000
# Images of a background (choice: as of `sylpose scan`).
N_IMAGES = 31


def check_mesh_session(session: Session | LiveSession, mesh: Mesh) -> Session:
    """Return the session without masks for all frames, which are no outlines.

    Raises:
        ValueError: a live session, several objects, or a mesh of another size than the cameras can see or of too many faces.
    """
    if not isinstance(session, Session):
        raise ValueError("mesh: only recordings, from which the background is estimated")
    if len(session.objects) > 1:
        raise ValueError(f"mesh: one object is expected, not several ({', '.join(session.objects)})")
    if len(mesh.faces) > MAX_FACES:
        raise ValueError(
            f"mesh: {len(mesh.faces)} faces, of at most {MAX_FACES}; simplify it, which hardly moves outlines"
        )
    check_mesh_size(mesh, session.rig)
    return session.without_static_masks()[0]


def check_mesh_size(mesh: Mesh, rig: Rig) -> None:
    """Check that the mesh may be what the cameras see, where their optical axes meet, if they do.

    Raises:
        ValueError: it would be larger than its distance, or have less pixels than its pose has unknowns.
    """
    place = find_axes_intersection(rig)
    if place is None:
        return
    distance = float(np.median([np.linalg.norm(place - camera.center) for camera in rig]))
    pixels = np.pi * mesh.size / distance * max(camera.focal for camera in rig)
    if mesh.size > distance or pixels < MIN_POINTS:
        unit = f" {rig.unit}" if rig.unit else ""
        raise ValueError(
            f"mesh: it is {mesh.size:.3g}{unit} large, at {distance:.3g}{unit} from the cameras: is its unit right?"
        )


def open_contour_tracker(session: Session, options: RunOptions) -> ContourTracker:
    """Estimate the backgrounds of a recording's cameras, and return the tracker of a mesh.

    Raises:
        ValueError: no camera has enough images for a background, or masks.
    """
    assert options.mesh is not None
    frames = range(options.start, min(session.n_frames, options.stop or session.n_frames), options.every)
    count = min(N_IMAGES, len(frames))
    chosen = [frames[k] for k in np.linspace(0, len(frames) - 1, count).round().astype(int)]
    images, has_masks = [dict[int, Image]() for _ in session.rig], False
    with closing(session.frames_at(chosen, on_problem=lambda _: None)) as frame_sets:
        for frame_set in frame_sets:
            has_masks |= any(mask is not None for mask in frame_set.masks)
            for of_camera, image in zip(images, frame_set.images, strict=True):
                if image is not None:
                    of_camera[frame_set.index] = reduce_image(image)
    backgrounds = [SampledBackground([*own], [*own.values()]) if len(own) >= MIN_IMAGES else None for own in images]
    if not has_masks and all(background is None for background in backgrounds):
        raise ValueError(
            f"mesh: {max(map(len, images))} images per camera in {session.path}, of at least {MIN_IMAGES} from which a "
            "background can be estimated; use more frames, or give masks of the object"
        )
    return ContourTracker(session.rig, options.mesh, backgrounds, options.tracking)
