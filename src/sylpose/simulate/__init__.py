"""Synthetic scenes with ground truth: rigs, matches of moving bodies, and rendered sequences."""

from sylpose.rig import make_look_at_camera
from sylpose.simulate.bodies import Body, box, cloud, ellipsoid, plane
from sylpose.simulate.recordings import (
    DemoTruth,
    compute_demo_truth,
    make_demo_scene,
    write_sequence,
)
from sylpose.simulate.render import Actor, Scene, TexturedBody, chamfered_box, render_frames
from sylpose.simulate.rigs import arc, dome, ring
from sylpose.simulate.scenes import OutlierKind, SimulatedPair, random_motion, simulate_matches

__all__ = [
    "Actor",
    "Body",
    "DemoTruth",
    "OutlierKind",
    "Scene",
    "SimulatedPair",
    "TexturedBody",
    "arc",
    "box",
    "chamfered_box",
    "cloud",
    "compute_demo_truth",
    "dome",
    "ellipsoid",
    "make_demo_scene",
    "make_look_at_camera",
    "plane",
    "random_motion",
    "render_frames",
    "ring",
    "simulate_matches",
    "write_sequence",
]
