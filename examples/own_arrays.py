"""Use sylpose with your own arrays, and its stages one by one.

    python examples/own_arrays.py [RECORDING]

Estimates a motion from external matches, here simulated ones, and the pose of an object with known points. With a
RECORDING (`sylpose demo` makes one), it also processes the first and the sixth frame step by step: detect, match,
summarize, solve.
"""

import sys

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import Camera, Matches, PairMoments, Rig, estimate_motion, estimate_pose, open_session
from sylpose.features.sift import detect_features, match_features
from sylpose.simulate import ellipsoid, random_motion, simulate_matches


def two_cameras() -> Rig:
    """Make a rig from plain numbers: two cameras, 60 degrees apart, 1 m from the world's origin."""
    matrix = np.array([[900.0, 0, 319.5], [0, 900.0, 239.5], [0, 0, 1]])
    distortion = np.array([-0.1, 0.02, 0, 0, 0])  # OpenCV's k1, k2, p1, p2, k3
    cameras = []
    for name, degrees in (("left", -30), ("right", 30)):
        turn = Rotation.from_euler("y", degrees, degrees=True)
        camera_from_world = RigidTransform.from_components([0.0, 0.0, 1.0], turn)
        cameras.append(Camera(name, (640, 480), matrix, distortion, camera_from_world))
    return Rig(cameras, unit="m")


def your_matches(rig: Rig, true_motion: RigidTransform) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return pixels (n, 2) of n features in frames i and j per camera: insert your own detector."""
    body = ellipsoid((0.10, 0.07, 0.08), 2000)
    pair = simulate_matches(rig, body, true_motion, rng=np.random.default_rng(1), noise_px=0.3, outliers=0.2)
    return [(c.denormalize(m.x), c.denormalize(m.y)) for c, m in zip(rig, pair.matches, strict=True)]


rig = two_cameras()
true_motion = random_motion(8.0, 0.02, np.random.default_rng(2))
pixels = your_matches(rig, true_motion)
matches = [Matches.from_pixels(c, i, j) for c, (i, j) in zip(rig, pixels, strict=True)]
print("True rotation (degrees)", np.degrees(true_motion.rotation.as_rotvec()).round(2))
print(estimate_motion(rig, matches))

# solvePnP for many cameras: each sees five different known points.
corners = np.random.default_rng(3).uniform(-0.1, 0.1, (10, 3))
points = [corners[:5], corners[5:]]
world_from_object = true_motion
seen = [camera.project(world_from_object.apply(p)) for camera, p in zip(rig, points, strict=True)]
found = estimate_pose(rig, points, seen)
print(found)
if found.motion is not None:
    print("  off by", np.degrees((found.motion.rotation * world_from_object.rotation.inv()).magnitude()), "degrees")

if len(sys.argv) > 1:
    session = open_session(sys.argv[1])
    first, second = session.frames(start=0, stop=6, every=5)
    matches = []
    for camera, image_i, image_j in zip(session.rig, first.images, second.images, strict=True):
        if image_i is None or image_j is None:
            matches.append(Matches.empty())
            continue
        a, b = detect_features(image_i, camera), detect_features(image_j, camera)  # .pixels, .normalized, .descriptors
        pairs = match_features(a, b)
        moved = np.linalg.norm(a.pixels[pairs[:, 0]] - b.pixels[pairs[:, 1]], axis=1) > 1.5
        i, j = pairs[moved].T  # static features are background
        matches.append(Matches(a.normalized[i], b.normalized[j]))
        moments = PairMoments.from_matches(a.normalized[i], b.normalized[j])
        print(f"{camera.name}: {len(i)} matches, summarized in {len(moments.to_bytes())} bytes")
    print(estimate_motion(session.rig, matches))
