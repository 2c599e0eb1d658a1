"""Synthetic scenes with known truth: rigs, matches of moving bodies, and rendered sequences."""

from sylpose.rig import camera_at
from sylpose.simulate.bodies import Body, box, cloud, ellipsoid, plane
from sylpose.simulate.demo import DemoTruth, demo_scene, demo_truth, render_sequence, write_sequence
from sylpose.simulate.render import Actor, Scene, TexturedBody, chamfered_box, render_frames
from sylpose.simulate.rigs import arc, dome, ring
from sylpose.simulate.scenes import OutlierKind, SimulatedPair, random_motion, simulate_matches
from sylpose.simulate.sequences import Recording, visible_shares, write_recording

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
    "camera_at",
    "chamfered_box",
    "cloud",
    "demo_scene",
    "demo_truth",
    "dome",
    "ellipsoid",
    "plane",
    "random_motion",
    "render_frames",
    "render_sequence",
    "ring",
    "simulate_matches",
    "visible_shares",
    "write_recording",
    "write_sequence",
]
