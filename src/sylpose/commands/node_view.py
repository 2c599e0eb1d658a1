"""`sylpose node --view`: a camera without images that receives the network's poses and converts them to its frame."""

from __future__ import annotations

import json
import time
from pathlib import Path
from queue import Empty, SimpleQueue

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose.commands.node import catch_interrupts
from sylpose.network.zenoh_transport import LinkSettings, watch_network
from sylpose.report.files import write_tum
from sylpose.rig import MAX_LENGTH, Camera
from sylpose.runs import console_output

__all__ = ["run_node_view_command"]

# Seconds without a pose after which tracking is considered ended, and largest wait for the first pose (choice).
END_TIMEOUT, START_TIMEOUT = 5.0, 60.0


def run_node_view_command(camera: Camera, network: str, links: LinkSettings, out: Path) -> bool:
    """Receive a network's poses and write them in a camera's frame (camera_from_object).

    Args:
        camera: the camera; its pose defines the frame.
        network: name of the network.
        links: how to connect.
        out: output folder; the poses are written to view_NAME.tum in it.

    Returns:
        whether any pose was received.
    """
    lines: SimpleQueue[str] = SimpleQueue()
    session = watch_network(links, network, lambda *_: None, lambda _, line: lines.put(line))
    seen: dict[int, tuple[float, RigidTransform]] = {}
    console, last_print, last_pose = console_output.make_console(), 0.0, time.monotonic()
    with catch_interrupts() as stopped:
        while not stopped() and time.monotonic() - last_pose < (END_TIMEOUT if seen else START_TIMEOUT):
            try:
                found = _parse_pose(lines.get(timeout=0.2))
            except Empty:
                continue
            if found is None or found[0] in seen:  # every node sends the same pose of a frame
                continue
            last_pose = time.monotonic()
            frame, timestamp, pose = found
            seen[frame] = timestamp, camera.camera_from_world * pose
            if last_pose - last_print > 1.0:
                last_print = last_pose
                x, y, z = seen[frame][1].translation
                console.print(f"{camera.name}: frame {frame} at {x:.4g} {y:.4g} {z:.4g} in camera axes", soft_wrap=True)
    session.close()
    if seen:
        frames = [seen[k] for k in sorted(seen)]
        file = out / f"view_{camera.name}.tum"
        out.mkdir(parents=True, exist_ok=True)
        write_tum(file, [t for t, _ in frames], RigidTransform.concatenate([pose for _, pose in frames]))
        console_output.print_files(console, "Files", [file])
    return bool(seen)


def _parse_pose(line: str) -> tuple[int, float, RigidTransform] | None:
    """Parse frame number, time and pose from a line of JSON; return None if it has no valid pose."""
    try:
        content = json.loads(line)
        quaternion, position = np.array(content["quaternion"], float), np.array(content["position"], float)
        if quaternion.shape != (4,) or position.shape != (3,):
            return None
        if not np.abs([*position, float(content["time"])]).max() <= MAX_LENGTH or not np.isfinite(quaternion).all():
            return None
        pose = RigidTransform.from_components(position, Rotation.from_quat(quaternion))
        return int(content["frame"]), float(content["time"]), pose
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return None
