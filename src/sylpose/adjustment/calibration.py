"""What a calibration may have got wrong: what is believed of it, and the rig that is left when it is corrected.

A camera may be turned and shifted, its focal length, its principal point and its lens's first radial coefficient may be
off. A turn or a shift that all cameras share is no error: it is where the world is. What is believed is free of it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.adjustment.kernels import LENS, SHIFT, TURN
from sylpose.adjustment.problem import Problem, State
from sylpose.adjustment.shared import Shared
from sylpose.numerics.arrays import FloatArray, IntArray
from sylpose.rig import Camera, Rig

__all__ = [
    "N_LENS",
    "Correction",
    "Doubt",
    "corrected",
    "correction_of",
    "doubting",
    "lens_slopes",
    "usual_doubt",
    "with_doubt",
    "with_moved",
]


# A camera's unknowns of the lens: focal length, relative; principal point, pixels; first radial coefficient (derived).
N_LENS = 4
# What calibrations typically leave, one standard deviation: degrees, the share of the cameras' distance from each other,
# the focal length's share, pixels, and of the radial coefficient (choice: after what Anipose's and Caliscope's users see).
TURN_DEG, SHIFT_SHARE, FOCAL_SHARE, MIDDLE_PX, BEND = 0.5, 0.003, 0.01, 5.0, 0.02
# A lens whose calibration says its own reprojection error is believed in proportion to it: these are typical of one of so
# many pixels; but no better than that by so much. Of where cameras stand that error says nothing (choice).
TYPICAL_PX, BEST_SHARE = 1.0, 0.2
# A camera that was bumped into may be turned and shifted by so much, one standard deviation (choice).
MOVED_DEG, MOVED_SHARE = 5.0, 0.03
# Steps of differences by the lens, in the units of its unknowns, and by the normalised point (choice).
STEPS, NEAR = np.array([1e-4, 1e-1, 1e-1, 1e-4]), 1e-4


@dataclass(frozen=True, eq=False)
class Doubt:
    """Standard deviations of what may be wrong with each of C cameras.

    Attributes:
        turn: (C,) radians about each axis; shift: (C,) length units, of the centre, along each axis.
        lens: (C, 4) of the focal length, relative; of the principal point, pixels, both coordinates; of the first radial
            coefficient.
        body: (C,) the same number for what is one camera in two places, before and after it was bumped into: its lens is
            one, where it stands is two things.
    """

    turn: FloatArray
    shift: FloatArray
    lens: FloatArray
    body: IntArray


@dataclass(frozen=True, eq=False)
class Correction:
    """What a refinement says of a calibration.

    Attributes:
        rig: corrected.
        values, sd: (C, 10) what is off, and its standard deviation: turn (radians, camera's axes) and shift of the centre
            (length units, world's axes), then the lens as in `Doubt`.
        believed: (C, 10) the standard deviation before, without what turns or shifts all cameras as one.
    """

    rig: Rig
    values: FloatArray
    sd: FloatArray
    believed: FloatArray


def usual_doubt(rig: Rig) -> Doubt:
    """What calibrations typically leave; of a lens less where its own calibration says that it fits better than most."""
    apart = _apart(rig)
    share = np.array([1.0 if c.error_px is None else np.clip(c.error_px / TYPICAL_PX, BEST_SHARE, 1.0) for c in rig])
    lens = np.array([FOCAL_SHARE, MIDDLE_PX, MIDDLE_PX, BEND])
    n = len(rig)
    return Doubt(np.full(n, np.deg2rad(TURN_DEG)), np.full(n, SHIFT_SHARE * apart), share[:, None] * lens, np.arange(n))


def with_moved(rig: Rig, doubt: Doubt, moved: Mapping[int, int]) -> tuple[Rig, Doubt]:
    """With a camera more for each that was moved, camera -> frame: the same one, that stands nobody knows quite where."""
    apart = _apart(rig)
    which = list(moved)
    again = [replace(rig.cameras[c], name=f"{rig.cameras[c].name} from frame {frame}") for c, frame in moved.items()]
    return Rig([*rig, *again], rig.unit), Doubt(
        np.append(doubt.turn, np.full(len(which), np.deg2rad(MOVED_DEG))),
        np.append(doubt.shift, np.full(len(which), MOVED_SHARE * apart)),
        np.vstack([doubt.lens, doubt.lens[which]]),
        np.append(doubt.body, doubt.body[which]),
    )


def with_doubt(shared: Shared, rig: Rig, doubt: Doubt, *, held: bool) -> Shared:
    """With the calibration's unknowns as well, held or free: (C, K) columns become those of `kernels` up to the lens."""
    n, width = len(rig), LENS + N_LENS
    bodies = np.unique(doubt.body, return_inverse=True)[1]
    k = 6 * n + N_LENS * (int(bodies.max()) + 1)
    own = np.zeros((n, width, k))
    for c in range(n):
        own[c, TURN:SHIFT, 6 * c : 6 * c + 3] = doubt.turn[c] * np.eye(3)
        own[c, SHIFT:LENS, 6 * c + 3 : 6 * c + 6] = doubt.shift[c] * np.eye(3)
        first = 6 * n + N_LENS * bodies[c]
        own[c, LENS:, first : first + N_LENS] = np.diag(doubt.lens[c])
    own[..., : 6 * n] = own[..., : 6 * n] @ _not_common(rig, doubt)
    mean, spread = np.zeros((n, width)), np.zeros((n, width, shared.spread.shape[2] + k))
    mean[:, :TURN] = shared.mean[:, :TURN]
    spread[:, :TURN, : shared.spread.shape[2]] = shared.spread[:, :TURN]
    spread[:, :, shared.spread.shape[2] :] = own
    first = np.zeros(n, bool)
    first[np.unique(doubt.body, return_index=True)[1]] = True
    kind = np.concatenate([shared.kind, (first[:, None] * np.repeat([1, 2], 3)).ravel(), np.full(k - 6 * n, 3)])
    return Shared(mean, spread, shared.n_offsets, kind, np.ones(4), np.concatenate([shared.held, np.full(k, held)]))


def _apart(rig: Rig) -> float:
    """How far the cameras are from their middle, in the mean; 1 of a single one."""
    centers = np.array([camera.center for camera in rig])
    return float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean()) or 1.0


def _not_common(rig: Rig, doubt: Doubt) -> FloatArray:
    """(6 C, 6 C) takes out of turns and shifts, in standard deviations, what turns and shifts all cameras as one."""
    centers, common = np.array([c.center for c in rig]), np.zeros((6 * len(rig), 6))
    middle = centers.mean(axis=0)
    size = _apart(rig)
    for c, camera in enumerate(rig):
        # The world turned by w: X' = X + w x (X - middle), so Q' = Q exp(-w) = exp(-Q w) Q.
        common[6 * c : 6 * c + 3, :3] = -camera.rotation / doubt.turn[c]
        x, y, z = centers[c] - middle
        common[6 * c + 3 : 6 * c + 6, :3] = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]) / doubt.shift[c]
        common[6 * c + 3 : 6 * c + 6, 3:] = size * np.eye(3) / doubt.shift[c]
    q = np.linalg.qr(common)[0]
    return np.asarray(np.eye(len(common)) - q @ q.T)


def corrected(rig: Rig, values: FloatArray) -> Rig:
    """The rig with corrections (C, K), columns as in `kernels`."""
    return Rig([_corrected(camera, v) for camera, v in zip(rig, values, strict=True)], rig.unit)


def _corrected(camera: Camera, values: FloatArray) -> Camera:
    turn = Rotation.from_rotvec(values[TURN:SHIFT]) * camera.camera_from_world.rotation
    center = camera.center + values[SHIFT:LENS]
    pose = RigidTransform.from_components(-turn.apply(center), turn)
    return replace(_with_lens(camera, values[LENS : LENS + N_LENS]), camera_from_world=pose)


def _with_lens(camera: Camera, lens: FloatArray) -> Camera:
    matrix, distortion = camera.matrix.copy(), camera.distortion.copy()
    matrix[[0, 1], [0, 1]] *= 1.0 + lens[0]
    matrix[:2, 2] += lens[1:3]
    distortion[0] += lens[3]
    return replace(camera, matrix=matrix, distortion=distortion)


def lens_slopes(
    rig: Rig, cameras: IntArray, image: FloatArray, lens: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Normalised points (n, 2) of the rig's cameras (n,), and what `Sightings.lens` (n, 3, 4) is.

    They are linearised at lenses that are already corrected, C times (4,): the points, plus by what they move times the
    lens, are then what they are with that lens.
    """
    slopes, moved = np.zeros((len(image), 3, N_LENS)), image.copy()
    for c, camera in enumerate(rig):
        mine = cameras == c
        if not mine.any():
            continue
        now = _with_lens(camera, lens[c])
        x = image[mine]
        if np.any(lens[c]):
            x = now.normalize(camera.denormalize(x))
        by_x = _pixels_by_point(now, x)
        for j, (h, u) in enumerate(zip(STEPS, np.eye(N_LENS), strict=True)):
            more, less = _with_lens(now, h * u), _with_lens(now, -h * u)
            by_lens = (more.denormalize(x) - less.denormalize(x)) / (2 * h)
            # What stays is the pixel.
            slopes[mine, :2, j] = -np.linalg.solve(by_x, by_lens[..., None])[..., 0]
            area = [np.linalg.det(_pixels_by_point(camera, x)) for camera in (more, less)]
            slopes[mine, 2, j] = np.log(area[0] / area[1]) / (4 * h)
        slopes[mine, :, 0] /= 1.0 + lens[c][0]  # a relative change of `now` is larger than one of `camera` by as much
        moved[mine] = x - slopes[mine, :2] @ lens[c]
    return moved, slopes


def _pixels_by_point(camera: Camera, x: FloatArray) -> FloatArray:
    """(n, 2, 2) derivative of pixels by normalised points (n, 2)."""
    return np.stack(
        [(camera.denormalize(x + NEAR * u) - camera.denormalize(x - NEAR * u)) / (2 * NEAR) for u in np.eye(2)], axis=2
    )


def doubting(problem: Problem, state: State, rig: Rig, doubt: Doubt, *, held: bool) -> tuple[Problem, State]:
    """A problem in which the calibration is doubted as well, and a state of it: its calibration is the given one."""
    shared = with_doubt(problem.shared, rig, doubt, held=held)
    z = np.concatenate([state.z, np.zeros(shared.spread.shape[2] - len(state.z))])
    return relinearised(replace(problem, shared=shared), problem.sightings.image, rig, z), replace(state, z=z)


def rescaled(problem: Problem, state: State, shares: FloatArray) -> tuple[Problem, State]:
    """The same state in a problem in which each kind (4,) is believed to be off by a share of what it was at first."""
    more = (shares / problem.shared.shares)[problem.shared.kind]
    shared = replace(problem.shared, spread=problem.shared.spread * more, shares=shares)
    return replace(problem, shared=shared), replace(state, z=state.z / more)


def relinearised(problem: Problem, image: FloatArray, rig: Rig, z: FloatArray) -> Problem:
    """With lenses that are linearised where z (k,) has them; image (n, 2) are the points as the rig normalises them."""
    lens = problem.shared.of(z)[:, LENS:]
    moved, slopes = lens_slopes(rig, problem.sightings.camera, image, list(lens))
    return replace(problem, sightings=problem.sightings._replace(image=moved, lens=slopes))


def correction_of(shared: Shared, rig: Rig, z: FloatArray, covariance: FloatArray) -> Correction:
    """Of a refinement's shared unknowns z (k,) and their covariance (k, k)."""
    values, spread = shared.of(z), shared.spread[:, TURN:]
    sd = np.sqrt(np.maximum(np.einsum("cik,kl,cil->ci", spread, covariance, spread), 0.0))
    return Correction(corrected(rig, values), values[:, TURN:], sd, np.linalg.norm(spread, axis=2))
