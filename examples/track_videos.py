"""Track a recording from Python and print the object's pose in every frame.

    python examples/track_videos.py RECORDING

RECORDING is a folder with one video per camera and a calibration; `sylpose demo` makes one.
"""

import sys

import numpy as np

from sylpose import open_session, track

if len(sys.argv) != 2:
    sys.exit("usage: python examples/track_videos.py RECORDING")
session = open_session(sys.argv[1])
for frame in track(session.frames(), session.rig, session.boxes):
    pose = frame.pose
    if pose.world_from_object is None:
        print(f"{pose.time:7.3f} s  {pose.status.text}")
        continue
    x, y, z = pose.world_from_object.translation
    pan, tilt, roll = np.degrees(pose.pan_tilt_roll)
    print(f"{pose.time:7.3f} s  at ({x:.4f}, {y:.4f}, {z:.4f})  pan {pan:.2f}°  tilt {tilt:.2f}°  roll {roll:.2f}°")
