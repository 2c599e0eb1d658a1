"""Synthetic scenes with ground truth: rigs, matches of moving bodies, and rendered sequences."""

from sylpose.rig import make_look_at_camera
from sylpose.simulate.bodies import Body, box, cloud, ellipsoid, plane
from sylpose.simulate.recordings import (
    DemoTruth,
    Recording,
    compute_demo_truth,
    compute_visible_shares,
    make_demo_scene,
    render_sequence,
    write_recording,
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
    "Recording",
    "Scene",
    "SimulatedPair",
    "TexturedBody",
    "arc",
    "box",
    "chamfered_box",
    "cloud",
    "compute_demo_truth",
    "compute_visible_shares",
    "dome",
    "ellipsoid",
    "make_demo_scene",
    "make_look_at_camera",
    "plane",
    "random_motion",
    "render_frames",
    "render_sequence",
    "ring",
    "simulate_matches",
    "write_recording",
    "write_sequence",
]
