"""What a calibration may have got wrong: what is believed of it, and the rig that is left when it is corrected.

A camera may be turned and shifted, its focal length, its principal point and its lens's first radial coefficient may be
off. A turn or a shift that all cameras share is no error: it is where the world is. What is believed is free of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.bundle_adjustment.camera_parameters import Shared
from sylpose.bundle_adjustment.kernels import LENS, SHIFT, TURN
from sylpose.bundle_adjustment.problem import Problem, State
from sylpose.geometry.arrays import FloatArray, IntArray
from sylpose.rig import Camera, Rig

__all__ = [
    "EXACT",
    "MOVED_SHARE",
    "N_LENS",
    "Correction",
    "Doubt",
    "Moved",
    "apart",
    "corrected",
    "correction_of",
    "doubting",
    "freed",
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
# A calibration that is off by this share of what is believed is taken for exact (choice: from 0 there is no way back).
EXACT = np.array([1.0, 1e-9, 1e-9, 1e-9])
# Steps of differences by the lens, in the units of its unknowns, and by the normalised point (choice).
STEPS, NEAR = np.array([1e-4, 1e-1, 1e-1, 1e-4]), 1e-4


@dataclass(frozen=True, eq=False)
class Doubt:
    """Standard deviations of what may be wrong with each of C cameras.

    Attributes:
        turn: (C,) radians about each axis; shift: (C,) length units, of the centre, along each axis.
        lens: (C, 4) of the focal length, relative; of the principal point, pixels, both coordinates; of the first radial
            coefficient.
        before: (C,) a camera that was bumped into is two, one after the other: the number of what it was before, -1 where
            that is nothing. What was wrong then still is, turn and shift are what came to it, and the lens is that one's.
    """

    turn: FloatArray
    shift: FloatArray
    lens: FloatArray
    before: IntArray


@dataclass(frozen=True, eq=False)
class Moved:
    """A camera that stood elsewhere from some frame on.

    Attributes:
        camera: index in the rig; frame: the recording's number of the first frame after it.
        turn_sd: radians, how far it may be turned about each axis beside what is known of it.
        turn: (3,) rotation vector, camera's axes, that its images are turned back by since then.
    """

    camera: int
    frame: int
    turn_sd: float = np.deg2rad(MOVED_DEG)
    turn: FloatArray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, eq=False)
class Correction:
    """What a refinement says of a calibration.

    Attributes:
        rig: corrected.
        values, sd: (C, 10) what is off, and its standard deviation: turn (radians, camera's axes) and shift of the centre
            (length units, world's axes), then the lens as in `Doubt`. Of a camera that was bumped into, what came to what it
            was before.
        believed: (C, 10) the standard deviation before, without what turns or shifts all cameras as one.
    """

    rig: Rig
    values: FloatArray
    sd: FloatArray
    believed: FloatArray


def apart(rig: Iterable[Camera]) -> float:
    """How far the cameras are from their middle, in the mean; 1 of a single one."""
    centers = np.array([camera.center for camera in rig])
    return float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).mean()) or 1.0


def usual_doubt(rig: Rig) -> Doubt:
    """What calibrations typically leave; of a lens less where its own calibration says that it fits better than most."""
    size = apart(rig)
    share = np.array([1.0 if c.error_px is None else np.clip(c.error_px / TYPICAL_PX, BEST_SHARE, 1.0) for c in rig])
    lens = np.array([FOCAL_SHARE, MIDDLE_PX, MIDDLE_PX, BEND])
    n = len(rig)
    return Doubt(
        np.full(n, np.deg2rad(TURN_DEG)), np.full(n, SHIFT_SHARE * size), share[:, None] * lens, np.full(n, -1)
    )


def with_moved(rig: Rig, doubt: Doubt, moved: Sequence[Moved]) -> tuple[Rig, Doubt]:
    """With a camera more for each that was moved, in order of time: the same one, that stands nobody knows quite where."""
    shift, stood, before = MOVED_SHARE * apart(rig), np.arange(len(rig)), []
    for i, m in enumerate(moved):
        before.append(stood[m.camera])
        stood[m.camera] = len(rig) + i
    again = [replace(rig.cameras[m.camera], name=f"{rig.cameras[m.camera].name} from frame {m.frame}") for m in moved]
    return Rig([*rig, *again], rig.unit), Doubt(
        np.append(doubt.turn, [m.turn_sd for m in moved]),
        np.append(doubt.shift, np.full(len(moved), shift)),
        np.vstack([doubt.lens, doubt.lens[[m.camera for m in moved]]]),
        np.append(doubt.before, np.array(before, np.int64)),
    )


def with_doubt(shared: Shared, rig: Rig, doubt: Doubt) -> Shared:
    """With the calibration's unknowns as well: (C, K) columns become those of `kernels` up to the lens.

    They are held, but for where cameras stand that were bumped into.
    """
    n, width, first = len(rig), LENS + N_LENS, np.flatnonzero(doubt.before < 0)
    k = 6 * n + N_LENS * len(first)
    own = np.zeros((n, width, k))
    for c in range(n):
        own[c, TURN:SHIFT, 6 * c : 6 * c + 3] = doubt.turn[c] * np.eye(3)
        own[c, SHIFT:LENS, 6 * c + 3 : 6 * c + 6] = doubt.shift[c] * np.eye(3)
    standing = (6 * first[:, None] + np.arange(6)).ravel()
    own[:, :, standing] = own[:, :, standing] @ _not_common([rig.cameras[c] for c in first], doubt, first)
    for i, c in enumerate(first.tolist()):
        lens = 6 * n + N_LENS * i
        own[c, LENS:, lens : lens + N_LENS] = np.diag(doubt.lens[c])
    for c, before in enumerate(doubt.before.tolist()):
        if before >= 0:
            own[c] += own[before]
    mean, spread = np.zeros((n, width)), np.zeros((n, width, shared.spread.shape[2] + k))
    mean[:, :TURN] = shared.mean[:, :TURN]
    spread[:, :TURN, : shared.spread.shape[2]] = shared.spread[:, :TURN]
    spread[:, :, shared.spread.shape[2] :] = own
    stands = np.repeat(doubt.before < 0, 6)
    kind = np.concatenate([shared.kind, stands * np.tile(np.repeat([1, 2], 3), n), np.full(k - 6 * n, 3)])
    stays = np.concatenate([shared.held, kind[len(shared.kind) :] > 0])
    return Shared(mean, spread, shared.n_offsets, kind, np.ones(4), stays)


def _not_common(rig: Sequence[Camera], doubt: Doubt, which: IntArray) -> FloatArray:
    """(6 C, 6 C) takes out of turns and shifts of cameras, in standard deviations, what turns and shifts all of them as one.

    Args:
        which: (C,) they are in the doubt.
    """
    centers, common = np.array([c.center for c in rig]), np.zeros((6 * len(rig), 6))
    middle = centers.mean(axis=0)
    size = apart(rig)
    for c, camera in enumerate(rig):
        turn, shift = doubt.turn[which[c]], doubt.shift[which[c]]
        # The world turned by w: X' = X + w x (X - middle), so Q' = Q exp(-w) = exp(-Q w) Q.
        common[6 * c : 6 * c + 3, :3] = -camera.rotation / turn
        x, y, z = centers[c] - middle
        common[6 * c + 3 : 6 * c + 6, :3] = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]) / shift
        common[6 * c + 3 : 6 * c + 6, 3:] = size * np.eye(3) / shift
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


def doubting(problem: Problem, state: State, rig: Rig, doubt: Doubt) -> tuple[Problem, State]:
    """A problem in which the calibration is doubted as well, and a state of it: its calibration is the given one, which is
    held."""
    shared = with_doubt(problem.shared, rig, doubt)
    z = np.concatenate([state.z, np.zeros(shared.spread.shape[2] - len(state.z))])
    return relinearised(replace(problem, shared=shared), problem.sightings.image, rig, z), replace(state, z=z)


def freed(problem: Problem) -> Problem:
    """One in which what the calibration got wrong is estimated."""
    return replace(problem, shared=replace(problem.shared, held=problem.shared.held & (problem.shared.kind == 0)))


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


def correction_of(shared: Shared, rig: Rig, before: IntArray, z: FloatArray, covariance: FloatArray) -> Correction:
    """Of a refinement's shared unknowns z (k,) and their covariance (k, k); before (C,) as in `Doubt`."""
    spread = shared.spread[:, TURN:] - (before >= 0)[:, None, None] * shared.spread[before, TURN:]
    sd = np.sqrt(np.maximum(np.einsum("cik,kl,cil->ci", spread, covariance, spread), 0.0))
    return Correction(corrected(rig, shared.of(z)), spread @ z, sd, np.linalg.norm(spread, axis=2))
