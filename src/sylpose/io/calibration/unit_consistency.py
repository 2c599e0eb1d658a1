"""Detection of a camera whose translation is in another unit than those of the other cameras."""

from __future__ import annotations

import numpy as np

from sylpose.report.rigview import find_axes_intersection
from sylpose.rig import Rig

# Cameras of a rig differ less in their distance from the world's origin, and units that are confused (m, cm, mm) differ
# more (choice: a third of the ratio of m and cm).
MIN_DISTANCE_RATIO = 30.0
# Largest ratio of such units, m and mm, with the cameras' own ratio (choice: three times).
MAX_DISTANCE_RATIO = 3000.0
# Smaller distances, relative to the largest, are zero apart from rounding (derived: six digits).
ROUNDING_RATIO = 1e-6
# A camera close to the origin of its own accord is aimed as the others; one that was moved there by its unit is not, by
# more than this angle, degrees (choice: half of a usual field of view).
MIN_MISS_ANGLE = 20.0


def describe_unit_outlier(rig: Rig) -> str:
    """Name the camera whose translation is in another unit than the others'; "" if there is none.

    Three cameras or more besides one at the origin are required. A camera counts if it is the only one whose distance
    from the world's origin differs from the others' median by a ratio of 30 to 3000. One that is too close must also
    look away from where the others look, but toward it after a change of its unit: it may be at the origin.
    """
    distances = np.array([float(np.linalg.norm(camera.camera_from_world.translation)) for camera in rig])
    # A camera that is the origin has no unit.
    away = np.flatnonzero(distances > distances.max() * ROUNDING_RATIO)
    found = []
    for k in away.tolist() if len(away) > 2 else []:
        camera = rig.cameras[k]
        ratio = distances[k] / float(np.median(distances[away[away != k]]))
        if not MIN_DISTANCE_RATIO <= max(ratio, 1.0 / ratio) <= MAX_DISTANCE_RATIO:
            continue
        factor = max(10.0 ** round(np.log10(max(ratio, 1.0 / ratio))), 100.0)
        if ratio > 1.0:
            found.append((camera.name, f"about {factor:g} times"))
        elif _is_aimed_after_scaling(rig, k, factor):
            found.append((camera.name, f"about 1/{factor:g}"))
    if len(found) != 1:
        return ""
    name, times = found[0]
    return (
        f"{name}: its distance from the world's origin is {times} that of the other cameras: its translation is probably "
        "in another unit (m, cm, mm)."
    )


def _is_aimed_after_scaling(rig: Rig, k: int, factor: float) -> bool:
    """Return whether camera k looks where the others look only if its distance from the origin is `factor` times."""
    point = find_axes_intersection(Rig([camera for i, camera in enumerate(rig) if i != k]))
    if point is None:
        return False
    camera, cosine = rig.cameras[k], np.cos(np.radians(MIN_MISS_ANGLE))
    before, after = (point - scale * camera.center for scale in (1.0, factor))
    aims = [float(ray @ camera.direction) >= cosine * float(np.linalg.norm(ray)) for ray in (before, after)]
    return aims == [False, True]
