"""Shape of a tracked object from the silhouettes of its recording."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from sylpose.frames import FrameSet
from sylpose.io.mesh_files import SURFACE_FILE, write_mesh
from sylpose.report.drawing import draw_surface, to_bgr
from sylpose.rig import Rig
from sylpose.runs.page import read_run
from sylpose.runs.run_metadata import find_run_folder, open_source_recording
from sylpose.silhouettes.carving import CarvedObject, carve_object
from sylpose.silhouettes.rendering import render_mesh, shade_mesh
from sylpose.units import INITIAL_DISTANCES

PICTURE_FILE = "shape.png"
# A median agreement of surface and silhouettes below this causes a warning (measured: rendered bodies and a temple with
# exact poses have 0.97 to 0.98).
MIN_AGREEMENT = 0.9
# So does a median unknown share of the outline above this (measured: 0.00 to 0.27 of bodies whose surface is right to 0.6 %
# of the size; 0.34 and 0.49 of bodies that turn in place, which are 8 and 15 % off).
MAX_UNKNOWN_OUTLINE = 0.25


@dataclass(frozen=True, eq=False)
class Scan:
    """Shape of a tracked object, with what it was carved from.

    Attributes:
        carved: the shape.
        rig: the cameras.
        frames: (F) frame sets.
        world_from_object: (F,) poses.
        static_masks: names of the cameras with one mask for all frames, which is not used.
    """

    carved: CarvedObject
    rig: Rig
    frames: list[FrameSet]
    world_from_object: RigidTransform
    static_masks: tuple[str, ...] = ()

    @property
    def warnings(self) -> list[str]:
        """Sentences on what makes the shape unreliable."""
        found, carved = [], self.carved
        if (agreement := float(np.nanmedian(carved.agreement))) < MIN_AGREEMENT:
            found.append(
                f"The surface agrees with only {100 * agreement:.0f} % of the silhouettes' area: something else moves, or "
                "the poses or the calibration are inexact. Masks of the object help."
            )
        if (unknown := float(np.nanmedian(carved.unknown_outline))) > MAX_UNKNOWN_OUTLINE:
            found.append(
                f"Next to {100 * unknown:.0f} % of the outline the background is not known: the object covers the same "
                "pixels in most frames, and the surface may be too large. Let it move by its size, or give masks of the "
                "object."
            )
        for c, name in enumerate(self.rig.names):
            n, n_all = int(carved.contradicting[:, c].sum()), int((carved.used | carved.contradicting)[:, c].sum())
            if n:
                found.append(f"Camera {name}: {n} of {n_all} silhouettes contradict those of the others; not used.")
            if not n_all:
                found.append(f"Camera {name}: no image of these frames shows the object.")
            found += self._list_ignored_masks(c)
        return found

    def _list_ignored_masks(self, c: int) -> list[str]:
        """Return sentences on a camera's masks that are no silhouettes, and on images that lack one."""
        name, carved = self.rig.names[c], self.carved
        found = []
        if name in self.static_masks:
            found.append(
                f"Camera {name}: one mask for all frames is no outline of what moves: ignored. Give one per frame, or none."
            )
        has_mask = np.array([frame.masks[c] is not None for frame in self.frames])
        has_image = np.array([frame.images[c] is not None for frame in self.frames])
        n = int((has_image & ~has_mask & ~carved.used[:, c] & ~carved.contradicting[:, c]).sum())
        if has_mask.any() and n:
            found.append(f"Camera {name}: {n} images without a mask are not used.")
        return found


def scan_result(result: Path, recording: Path | None, n_frames: int) -> Scan:
    """Carve the object of a result from frames that are spread over its recording.

    Args:
        result: folder of the run, or of one of its objects.
        recording: present folder of the recording; None if it was not moved.
        n_frames: number of frames at most.

    Raises:
        FileNotFoundError: no recording, or no result.
        ValueError: a result of one camera in its own unit; no measured poses; as `carve_object`.
    """
    trajectory, rig, _ = read_run(result)
    if trajectory.unit == INITIAL_DISTANCES:
        raise ValueError(
            f"{result}: the result of a single camera; its lengths are not those of the calibration. Track an object of "
            "known size (--object), or use several cameras"
        )
    session = open_source_recording(result, recording, with_masks=True)
    folder = result if result.is_dir() else result.parent
    if folder != find_run_folder(folder) and folder.name in session.objects:
        session = session.select_object(folder.name)
    session, static_masks = session.without_static_masks()
    measured = {p.index: p.world_from_object for p in trajectory if p.is_measured and p.index < session.n_frames}
    if not measured:
        raise ValueError(f"{result}: no measured pose of a frame of {session.path} in it")
    indices = np.array(sorted(measured))
    chosen = indices[np.unique(np.linspace(0, len(indices) - 1, n_frames).round().astype(int))]
    with closing(session.frames_at(chosen.tolist(), on_problem=lambda _: None)) as frame_sets:
        frames = list(frame_sets)
    poses = [pose for frame in frames if (pose := measured[frame.index]) is not None]
    if not poses:
        raise ValueError(f"{session.path}: none of the frames with a pose can be read")
    world_from_object = RigidTransform.concatenate(poses)
    carved = carve_object(rig, frames, world_from_object)
    return Scan(carved, rig, frames, world_from_object, static_masks)


def write_scan(scan: Scan, folder: Path) -> list[Path]:
    """Write shape.glb and shape.png, and return both files.

    Raises:
        OSError: a file cannot be written; the message names it.
    """
    files, mesh = [folder / SURFACE_FILE, folder / PICTURE_FILE], scan.carved.mesh
    write_mesh(mesh, files[0], scan.rig.unit)
    names, images, surfaces = list[str](), [], []
    for c, camera in enumerate(scan.rig):
        if not scan.carved.used[:, c].any():
            continue
        used = np.flatnonzero(scan.carved.used[:, c])
        k = int(used[len(used) // 2])
        image, pose = scan.frames[k].images[c], scan.world_from_object[k]
        assert image is not None
        names.append(f"{camera.name}, frame {scan.frames[k].index}")
        images.append(to_bgr(image))
        surfaces.append(shade_mesh(mesh, render_mesh(mesh, camera, pose), camera, pose))
    draw_surface(files[1], names, images, surfaces)
    return files
