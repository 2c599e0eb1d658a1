"""`sylpose node --view`: a camera without images, which has the pose from the others and its view of it."""

from __future__ import annotations

import json
import time
from pathlib import Path
from queue import Empty, SimpleQueue

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.app import console_output
from sylpose.app.node import interrupted
from sylpose.network.zenoh_transport import Links, watch_network
from sylpose.report.files import write_tum
from sylpose.rig import MAX_LENGTH, Camera

__all__ = ["view_node_aloud"]

# Seconds without a pose after which nobody tracks any more, and until the first one (choice).
OVER, PATIENCE = 5.0, 60.0


def view_node_aloud(camera: Camera, network: str, links: Links, out: Path) -> bool:
    """Listens to a network's poses, and writes them as a camera sees them (camera_from_object).

    Returns:
        whether there were any.
    """
    lines: SimpleQueue[str] = SimpleQueue()
    session = watch_network(links, network, lambda *_: None, lambda _, line: lines.put(line))
    seen: dict[int, tuple[float, RigidTransform]] = {}
    console, said, last = console_output.make_console(), 0.0, time.monotonic()
    with interrupted() as stopped:
        while not stopped() and time.monotonic() - last < (OVER if seen else PATIENCE):
            try:
                found = _pose_of(lines.get(timeout=0.2))
            except Empty:
                continue
            if found is None or found[0] in seen:  # the others say the same of it
                continue
            last = time.monotonic()
            frame, when, pose = found
            seen[frame] = when, camera.camera_from_world * pose
            if last - said > 1.0:
                said = last
                x, y, z = seen[frame][1].translation
                console.print(f"{camera.name}: frame {frame} at {x:.4g} {y:.4g} {z:.4g} in its axes", soft_wrap=True)
    session.close()
    if seen:
        frames = [seen[k] for k in sorted(seen)]
        file = out / f"view_{camera.name}.tum"
        out.mkdir(parents=True, exist_ok=True)
        write_tum(file, [t for t, _ in frames], RigidTransform.concatenate([pose for _, pose in frames]))
        console_output.print_files(console, "Files", [file])
    return bool(seen)


def _pose_of(line: str) -> tuple[int, float, RigidTransform] | None:
    """Frame, time and pose of a line, if it has one."""
    try:
        said = json.loads(line)
        quaternion, position = np.array(said["quaternion"], float), np.array(said["position"], float)
        if quaternion.shape != (4,) or position.shape != (3,):
            return None
        if not np.abs([*position, float(said["time"])]).max() <= MAX_LENGTH or not np.isfinite(quaternion).all():
            return None
        pose = RigidTransform.from_components(position, Rotation.from_quat(quaternion))
        return int(said["frame"]), float(said["time"]), pose
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return None
