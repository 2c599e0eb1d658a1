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
from sylpose.silhouettes.contour_tracker import ContourTracker, estimate_backgrounds
from sylpose.silhouettes.contours import MIN_POINTS
from sylpose.silhouettes.rendering import reduce_image

# Images of a background (choice: as of `sylpose scan`).
N_IMAGES = 31


def check_mesh_session(session: Session | LiveSession, mesh: Mesh) -> Session:
    """Return the session without masks for all frames, which are no outlines.

    Raises:
        ValueError: a live session, several objects, or a mesh of another size than the cameras can see.
    """
    if not isinstance(session, Session):
        raise ValueError("mesh: only recordings, from which the background is estimated")
    if len(session.objects) > 1:
        raise ValueError(f"mesh: one object is expected, not several ({', '.join(session.objects)})")
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
    images, has_masks = list[list[Image | None]](), False
    chosen = (
        sorted({frames[k] for k in np.linspace(0, len(frames) - 1, N_IMAGES).round().astype(int)}) if frames else []
    )
    with closing(session.frames_at(chosen, on_problem=lambda _: None)) as frame_sets:
        for frame_set in frame_sets:
            has_masks |= any(mask is not None for mask in frame_set.masks)
            images.append([None if image is None else reduce_image(image) for image in frame_set.images])
    mesh = options.mesh.vertices
    radius = float(np.linalg.norm(mesh - (mesh.min(axis=0) + mesh.max(axis=0)) / 2, axis=1).max())
    backgrounds = estimate_backgrounds(session.rig, radius, images)
    if not has_masks and all(background is None for background in backgrounds):
        raise ValueError(
            f"mesh: {len(images)} images per camera in {session.path}, of at least {MIN_IMAGES} from which a "
            "background can be estimated; use more frames, or give masks of the object"
        )
    return ContourTracker(session.rig, options.mesh, backgrounds, options.tracking)
