"""Short trajectory with a gap at each end and one in between, for export tests."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.results import FramePose, Trajectory
from sylpose.status import FrameStatus

RATE = 25.0
# Frames 0, 4 and 9 have no pose; 5 is predicted, not measured.
MISSING, COASTING, N = (0, 4, 9), 5, 10
FOUND = [k for k in range(N) if k not in MISSING and k != COASTING]


def pose_at(k: int) -> RigidTransform:
    """Rotate about an axis that is no coordinate axis, beyond 180 degrees."""
    turn = Rotation.from_rotvec(np.radians(25.0 * k) * np.array([0.48, 0.64, 0.6]))
    return RigidTransform.from_components([0.1 * k, -0.05 * k * k, 1.5 + 0.01 * k], turn)


def make_trajectory(unit: str = "m", start: float = 2.0) -> Trajectory:
    frames = []
    for k in range(N):
        status = FrameStatus.LOST if k in MISSING else FrameStatus.COASTING if k == COASTING else FrameStatus.TRACKED
        frames.append(
            FramePose(
                index=k + 3,
                time=start + k / RATE,
                status=status,
                world_from_object=None if k in MISSING else pose_at(k),
                covariance=np.diag(6 * [np.inf] if k in MISSING else [1e-4, 1e-4, 4e-4, 1e-6, 1e-6, np.inf]),
                inliers=np.array([20 + k, 0], dtype=np.int64),
                residuals=np.array([0.25, np.nan]),
                variance_inflation=np.array([1.0, np.inf]),
                faults=("cam_1: moved", "and more") if k == 2 else (),
                matches=np.array([30, 4], dtype=np.int64) if k != 1 else np.empty(0, np.int64),
                reason="nothing to see, at all" if k in MISSING else "",
            )
        )
    return Trajectory(frames, ["cam_0", "cam_1"], unit)


def markers_at(k: int, length: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Return the object's center and axis ends (4, 3), meters."""
    matrix = pose_at(k).as_matrix()
    ends = [matrix[:3, 3] + length * matrix[:3, j] for j in range(3)]
    return np.array([matrix[:3, 3], *ends])
