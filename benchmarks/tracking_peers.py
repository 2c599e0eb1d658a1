"""Peers of the tracking benchmark, on the same images as the tracker and with perfect masks of the object.

    python benchmarks/tracking_peers.py poselib|pycolmap SESSION OUT.tum [--every N] [--frames N]

poselib: SIFT, and PoseLib's generalized relative pose between adjacent frames, chained.
pycolmap: SIFT, and COLMAP's offline incremental mapping with the known rig. The object is the scene and the rig moves.

Writes world_from_object as TUM text and prints one line of JSON: the number of solved frames and the time in seconds.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.peers import (
    from_colmap_pose,
    from_poselib_result,
    pinhole_parameters,
    to_poselib_matches,
    to_poselib_rig,
)
from sylpose.features.sift import Features, detect_features, match_features
from sylpose.geometry.arrays import FloatArray
from sylpose.io.capture import Session, open_session
from sylpose.report.files import read_tum, write_tum
from sylpose.rig import Camera

__all__ = ["PEERS", "detect_masked_features", "run_poselib_chain", "run_pycolmap_mapping"]

# Frame number -> world_from_object.
Poses = dict[int, RigidTransform]

# The best of 0.5, 1 and 2 pixels on these images, with the best of PoseLib's losses.
EPIPOLAR_PX = 0.5
# COLMAP rejects image pairs with fewer matches.
MIN_MATCHES = 15


def detect_masked_features(session: Session, every: int, stop: int | None) -> Iterator[tuple[int, list[Features]]]:
    """Yield the frame number and each camera's features inside the object's true outline."""
    times, poses = read_tum(session.path / "groundtruth.tum")
    vertices = np.loadtxt(session.path / "vertices.txt")
    for frames in session.frames(0, stop, every):
        corners = poses[int(np.argmin(np.abs(times - frames.time)))].apply(vertices)
        found = []
        for camera, image in zip(session.rig, frames.images, strict=True):
            pixels = camera.project(corners)
            if image is None or not np.isfinite(pixels).all():
                found.append(Features.empty())
                continue
            mask = np.zeros(image.shape[:2], np.uint8)
            cv2.fillConvexPoly(mask, cv2.convexHull(np.rint(pixels).astype(np.int32)), (1,))
            found.append(detect_features(image, camera, mask.astype(bool)))
        yield frames.index, found


def undistort_pixels(camera: Camera, features: Features) -> FloatArray:
    """Return undistorted pixels (n, 2)."""
    return np.asarray(features.normalized * camera.matrix[[0, 1], [0, 1]] + camera.matrix[:2, 2])


def run_poselib_chain(session: Session, every: int, stop: int | None) -> tuple[Poses, dict[str, float]]:
    """Chain PoseLib's motions of adjacent frames; a failed step ends the chain."""
    import poselib

    cameras, in_rig = to_poselib_rig(session.rig)
    first = read_tum(session.path / "groundtruth.tum")[1][0]
    poses: Poses = {}
    seconds = {"features": 0.0, "solving": 0.0}
    start_time = time.perf_counter()
    previous_features: list[Features] = []
    pose = first
    for index, features in detect_masked_features(session, every, stop):
        seconds["features"] -= start_time - (start_time := time.perf_counter())
        if previous_features:
            views = []
            for camera, a, b in zip(session.rig, previous_features, features, strict=True):
                i, j = match_features(a, b).T
                views.append((undistort_pixels(camera, a)[i], undistort_pixels(camera, b)[j]))
            matches = to_poselib_matches(views)
            motion = from_poselib_result(
                poselib.estimate_generalized_relative_pose(
                    matches, in_rig, cameras, in_rig, cameras, {"max_epipolar_error": EPIPOLAR_PX}, {}
                )
            )
            if motion is None:
                break
            pose = motion * pose
        poses[index] = pose
        previous_features = features
        seconds["solving"] -= start_time - (start_time := time.perf_counter())
    return poses, seconds


def run_pycolmap_mapping(session: Session, every: int, stop: int | None) -> tuple[Poses, dict[str, float]]:
    """Map with COLMAP and return the poses of its largest model, in the gauge of its first frame."""
    import pycolmap

    pycolmap.set_random_seed(0)
    pycolmap.logging.minloglevel = 2
    rig = session.rig
    start_time = time.perf_counter()
    frame_features = list(detect_masked_features(session, every, stop))
    seconds = {"features": time.perf_counter() - start_time}
    start_time = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        with pycolmap.Database.open(database) as db:
            configs, images = [], []
            for c, camera in enumerate(rig):
                model = pycolmap.Camera(model="PINHOLE", width=camera.size[0], height=camera.size[1])
                model.params, model.has_prior_focal_length = pinhole_parameters(camera), True
                model.camera_id = db.write_camera(model)
                config = pycolmap.RigConfigCamera(image_prefix=f"{camera.name}/", ref_sensor=c == 0, camera=model)
                if c:
                    config.cam_from_rig = _to_rigid3d(camera.camera_from_world * rig.cameras[0].camera_from_world.inv())
                configs.append(config)
                ids = []
                for index, features in frame_features:
                    image = pycolmap.Image(name=f"{camera.name}/{index:05d}.png", camera_id=model.camera_id)
                    ids.append(db.write_image(image))
                    keypoints = undistort_pixels(camera, features[c]).astype(np.float32)
                    db.write_keypoints(ids[-1], keypoints)
                images.append(ids)
            pycolmap.apply_rig_config([pycolmap.RigConfig(cameras=configs)], db)
            pairs = _write_matches(db, images, [features for _, features in frame_features])
        seconds["matching"] = -(start_time - (start_time := time.perf_counter()))
        (Path(folder) / "pairs.txt").write_text("\n".join(pairs) + "\n")
        pycolmap.verify_matches(database, Path(folder) / "pairs.txt")
        seconds["verification"] = -(start_time - (start_time := time.perf_counter()))
        options = pycolmap.IncrementalPipelineOptions(extract_colors=False, random_seed=0)
        options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
        options.ba_refine_sensor_from_rig = False
        models = pycolmap.incremental_mapping(database, folder, folder, options)
        seconds["mapping"] = -(start_time - time.perf_counter())
    if not models:
        return {}, seconds
    largest = max(models.values(), key=lambda m: m.num_reg_frames())
    # The model's world is the object; the rig's frame is its first camera's.
    world_from_rig = rig.cameras[0].camera_from_world.inv()
    poses: Poses = {}
    for image in largest.images.values():
        frame = largest.frames[image.frame_id]
        if frame.has_pose():
            poses[int(Path(image.name).stem)] = world_from_rig * from_colmap_pose(frame.rig_from_world)
    return dict(sorted(poses.items())), seconds


def _write_matches(db: Any, images: list[list[int]], found: list[list[Features]]) -> list[str]:
    """Write the matches between all frames within each camera; return the image pairs in COLMAP's format."""
    pairs = []
    for c, ids in enumerate(images):
        names = [db.read_image(image).name for image in ids]
        for i, j in combinations(range(len(found)), 2):
            matches = match_features(found[i][c], found[j][c])
            if len(matches) >= MIN_MATCHES:
                db.write_matches(ids[i], ids[j], matches.astype(np.uint32))
                pairs.append(f"{names[i]} {names[j]}")
    return pairs


def _to_rigid3d(pose: RigidTransform) -> Any:
    import pycolmap

    return pycolmap.Rigid3d(pose.as_matrix()[:3])


PEERS: dict[str, Callable[[Session, int, int | None], tuple[Poses, dict[str, float]]]] = {
    "poselib": run_poselib_chain,
    "pycolmap": run_pycolmap_mapping,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("peer", choices=PEERS)
    parser.add_argument("session", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--frames", type=int, help="stop after this number")
    options = parser.parse_args()
    session = open_session(options.session)
    start = time.perf_counter()
    poses, seconds = PEERS[options.peer](session, options.every, options.frames)
    if poses:
        chain = RigidTransform.concatenate(list(poses.values()))
        write_tum(options.out, session.timeline.times[list(poses)], chain)
    counts = {"solved": len(poses), "frames": len(range(0, options.frames or session.n_frames, options.every))}
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({**counts, "seconds": time.perf_counter() - start, "parts": seconds, "peak": peak}))


if __name__ == "__main__":
    main()
