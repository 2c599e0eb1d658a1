"""Frames read in any order equal those read sequentially."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from sylpose.geometry.arrays import Image
from sylpose.io import calibration
from sylpose.io.capture import open_session
from sylpose.io.capture.frame_readers import MAX_SEQUENTIAL_FRAMES
from sylpose.io.capture.random_access import RandomAccessReader
from sylpose.rig import Camera, Rig

SIZE, FRAMES = (64, 48), 3 * MAX_SEQUENTIAL_FRAMES
# Containers and codecs with different seek behavior: with and without frames that reference later ones, with keyframes
# that earlier frames reference, too, and without timestamps.
KINDS = {
    "mp4": ("libx264", {"bf": "3", "g": "30"}),
    "mkv": ("libx264", {"bf": "2", "g": "25", "x264-params": "open-gop=1"}),
    "avi": ("mpeg4", {"g": "20"}),
    "ts": ("libx264", {"bf": "2", "g": "25"}),
}


def picture(k: int) -> Image:
    image = np.full((SIZE[1], SIZE[0], 3), 40, np.uint8)
    cv2.putText(image, str(k), (2, 34), cv2.FONT_HERSHEY_SIMPLEX, 0.9, (255, 255, 255), 2)
    return image


def folder_of(path: Path, names: tuple[str, ...] = ("cam_0",)) -> Path:
    path.mkdir()
    matrix = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]])
    cameras = [Camera(name, SIZE, matrix, np.zeros(5), RigidTransform.identity()) for name in names]
    calibration.save(Rig(cameras), path / "calibration.toml")
    return path


@pytest.mark.parametrize("kind", KINDS)
def test_random_access_to_videos(kind: str, tmp_path: Path) -> None:
    codec, options = KINDS[kind]
    if codec not in av.codecs_available:
        pytest.skip(f"FFmpeg here has no {codec}")
    folder = folder_of(tmp_path / "recording")
    with av.open(str(folder / f"cam_0.{kind}"), "w") as file:
        stream: Any = file.add_stream(codec, rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = *SIZE, "yuv420p"
        for k in range(FRAMES):
            file.mux(stream.encode(av.VideoFrame.from_ndarray(picture(k), format="bgr24")))
        file.mux(stream.encode())
    session = open_session(folder)
    every = [frames.images[0] for frames in session.frames()]
    assert len(every) == FRAMES
    order = [*np.random.default_rng(5).integers(0, FRAMES, 25).tolist(), 7, 8, 9, 9, FRAMES - 1, 0]
    with RandomAccessReader(session) as stills:
        for k in order:
            (image,) = stills.read_frame_set(k)
            np.testing.assert_array_equal(image, every[k], err_msg=f"frame {k}")
        with pytest.raises(ValueError, match=f"index must be in 0 ... {FRAMES - 1}"):
            stills.read_frame_set(FRAMES)
    chosen = [3, 4, 50, 51, 100, FRAMES - 1]
    frames_at = {frames.index: frames.images[0] for frames in session.frames_at(chosen)}
    assert [*frames_at] == chosen
    for k, image in frames_at.items():
        np.testing.assert_array_equal(image, every[k], err_msg=f"frame {k}")
    for wrong in ([], [4, 3], [-1], [FRAMES]):
        with pytest.raises(ValueError, match=f"indices must increase in 0 ... {FRAMES - 1}"):
            session.frames_at(wrong)


def test_random_access_with_missing_images(tmp_path: Path) -> None:
    folder = folder_of(tmp_path / "recording", ("cam_0", "cam_1"))
    for name in ("cam_0", "cam_1"):
        (folder / name).mkdir()
        for k in range(4):
            cv2.imwrite(str(folder / name / f"{k}.png"), picture(k))
    (folder / "cam_1" / "2.png").write_bytes(b"no image")
    session = open_session(folder, offsets={"cam_1": 1})
    with RandomAccessReader(session) as stills:
        first, second = stills.read_frame_set(3)
        np.testing.assert_array_equal(first, picture(3))
        assert second is None  # its third image, which is damaged
        first, second = stills.read_frame_set(0)
        np.testing.assert_array_equal(first, picture(0))
        assert second is None
        first, second = stills.read_frame_set(4)
        assert first is None
        np.testing.assert_array_equal(second, picture(3))
