"""Calibrations of Qualisys, Vicon and OptiTrack, by their documented formulas."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sylpose.geometry.arrays import FloatArray
from sylpose.io import calibration
from tests.io.calibration.reference_projections import (
    OTHER_TURN,
    TURN,
    apply_brown,
    assert_projects,
    points_in_front,
    write_file,
)

CENTER = np.array([1250.5, -2340.25, 1820.125])
# Rows of a camera that looks along -z with y up, and of one that looks along z with y down: rotated about x.
BACK = np.diag([1.0, -1.0, -1.0])


def points_in_view(rotation: FloatArray) -> FloatArray:
    """Return points, in mm, in front of an OpenCV camera at CENTER."""
    return CENTER + 1000.0 * points_in_front(rotation, np.zeros(3))


# Qualisys


def make_qualisys(**changes: str) -> str:
    turn = BACK @ TURN
    rows = (
        " ".join(f'r{i + 1}{j + 1}="{turn[i, j]!r}"' for i in range(3) for j in range(3))
        .replace("np.float64(", "")
        .replace(")", "")
    )
    video = f"""<camera active="1" calibrated="true" message="" point-count="2241" avg-residual="0.5" serial="26580"
      model="Miqus Video" viewrotation="0">
   <fov_marker left="0" top="0" right="1919" bottom="1087"/>
   <fov_video left="0" top="4" right="1919" bottom="1083"/>
   <transform x="{CENTER[0]}" y="{CENTER[1]}" z="{CENTER[2]}" {rows}/>
   <intrinsic focallength="9.27" sensorMinU="0.000000" sensorMaxU="122879.000000" sensorMinV="0.000000"
      sensorMaxV="69631.000000" focalLengthU="107872.5" focalLengthV="107880.25" centerPointU="60827.25"
      centerPointV="32684.125" skew="0.000000" radialDistortion1="-0.04545" radialDistortion2="0.139604"
      radialDistortion3="0.001" tangentalDistortion1="0.000615" tangentalDistortion2="-0.000391"/>
  </camera>"""
    others = video.replace("26580", "12039").replace("Miqus Video", "Oqus 300+")
    others += video.replace("26580", "26581").replace('calibrated="true"', 'calibrated="false"')
    text = f"""<calibration calibrated="true" source="20200213_145915.qca" qtm-version="2020.3 (build 6000)" type="regular">
 <results std-dev="0.438491" min-max-diff="2.663068"/>
 <cameras>
  {video}
  {others}
 </cameras>
</calibration>
"""
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    return text


def test_qualisys(tmp_path: Path) -> None:
    rig = calibration.load(write_file(tmp_path / "take.qca.txt", make_qualisys()))
    assert rig.names == ("26580",)  # the only calibrated video camera
    assert rig.unit == "mm"
    assert rig.cameras[0].size == (1920, 1080)

    def pixel(point: FloatArray) -> tuple[float, float]:
        turn = BACK @ TURN
        x, y, z = (sum(turn[i, j] * (point - CENTER)[j] for j in range(3)) for i in range(3))
        u, v = apply_brown(x / -z, -y / -z, [-0.04545, 0.139604, 0.001], [0.000615, -0.000391])
        return (107872.5 * u + 60827.25) / 64, (107880.25 * v + 32684.125) / 64 - 4

    assert_projects(rig.cameras[0], points_in_view(TURN), pixel)


def test_masks_of_many_cameras_are_read(tmp_path: Path) -> None:
    """XML of motion capture systems may have 16 MB, and blank lines before its first element."""
    masks = "<masks>" + "<mask left='1' top='2'/>" * 100_000 + "</masks>"
    text = "\n \n" + make_qualisys(**{"<cameras>": f"{masks}<cameras>"})
    assert calibration.load(write_file(tmp_path / "take.qca.txt", text)).names == ("26580",)


def test_qualisys_without_video_cameras(tmp_path: Path) -> None:
    text = make_qualisys(**{"Miqus Video": "Oqus 300+"})
    assert calibration.load(write_file(tmp_path / "take.qca.txt", text)).names == ("26580", "12039")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('viewrotation="0"', 'viewrotation="180"', "camera 26580: viewrotation is 180: its video is exported rotated"),
        ('skew="0.000000"', 'skew="64"', "camera 26580: the matrix has skew"),
        ("radialDistortion2", "radialDistortion9", "camera 26580: missing 'radialDistortion2'"),
        ("<transform", "<place", "camera 26580: missing 'r11'"),
        ('r11="', 'r11="x', "camera 26580: r11 must be numbers"),
        ('calibrated="true" message', 'calibrated="false" message', "at least one camera"),
    ],
)
def test_invalid_qualisys_is_rejected(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"take\.qca\.txt: .*{message}"):
        calibration.load(write_file(tmp_path / "take.qca.txt", make_qualisys(**{old: new})))


# Vicon


def to_quaternion(rotation: FloatArray) -> list[float]:
    """Return x y z w of a rotation matrix with positive trace."""
    w = np.sqrt(1 + np.trace(rotation)) / 2
    x, y, z = (rotation[2, 1] - rotation[1, 2]), (rotation[0, 2] - rotation[2, 0]), (rotation[1, 0] - rotation[0, 1])
    return [float(v) for v in (x / (4 * w), y / (4 * w), z / (4 * w), w)]


def make_vicon(lens: str, **changes: str) -> str:
    turn, center = (" ".join(map(str, values)) for values in (to_quaternion(TURN), CENTER.tolist()))
    frame = f"""<KeyFrame FOCAL_LENGTH="1620.5" FRAME="0" IMAGE_ERROR="0.18" ORIENTATION="{turn}" POSITION="{center}"
        PRINCIPAL_POINT="965.25 538.5" {lens} WORLD_ERROR="0.4"/>"""
    camera = f"""<Camera ACTIVE_THRESHOLD="1" DEVICEID="2107213" DISPLAY_TYPE="Vue" ISDV="2" NAME="" PIXEL_ASPECT_RATIO="1"
      SENSOR="IMX" SENSOR_SIZE="1920 1080" SKEW="0" SYSTEM="" TYPE="Vue_VIDEO" USERID="1">
    <ThresholdGrid BIT_DEPTH="1" DATA="r 31752 0" GRID_SIZE="294 108" TILE_SIZE="16 32"/>
    <ControlFrames/>
    <KeyFrames>{frame}</KeyFrames>
  </Camera>"""
    marker = camera.replace("2107213", "715").replace('ISDV="2"', 'ISDV="0"').replace("Vue_VIDEO", "VeroV22")
    idle = camera.replace("2107213", "2107214").replace(frame, "")
    head = '<?xml version="1.0" encoding="UTF-8" standalone="no" ?>'
    text = f'{head}\n<Cameras VERSION="1.0">\n{marker}\n{camera}\n{idle}\n</Cameras>'
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    return text


def undistort(pixel: FloatArray, center: tuple[float, float], k: list[float]) -> FloatArray:
    """Apply Vicon's undistortion to a pixel."""
    x, y = pixel[0] - center[0], pixel[1] - center[1]
    r2 = x * x + y * y
    scale = 1 + sum(term * r2 ** (i + 1) for i, term in enumerate(k))
    return np.array([center[0] + scale * x, center[1] + scale * y])


@pytest.mark.parametrize(
    ("lens", "middle", "k"),
    [
        ('VICON_RADIAL="0 0"', (965.25, 538.5), [0.0, 0.0]),
        ('VICON_RADIAL="3e-08 4e-15"', (965.25, 538.5), [3e-8, 4e-15]),
        ('VICON_RADIAL2="ViconRadial2 965.25 538.5 5e-08 -2e-15 1e-21"', (965.25, 538.5), [5e-8, -2e-15, 1e-21]),
        ('VICON_RADIAL2="ViconRadial2 971.0 530.25 3e-08 4e-15 0"', (971.0, 530.25), [3e-8, 4e-15]),
    ],
)
def test_vicon(lens: str, middle: tuple[float, float], k: list[float], tmp_path: Path) -> None:
    rig = calibration.load(write_file(tmp_path / "take.xcp", make_vicon(lens)))
    assert rig.names == ("2107213",)  # neither the marker camera nor the uncalibrated one
    camera = rig.cameras[0]
    assert (camera.size, rig.unit, camera.error_px) == ((1920, 1080), "mm", 0.18)
    points = points_in_view(TURN)
    pixels = camera.project(points)
    inside = ((pixels >= 0) & (pixels < (1920, 1080))).all(axis=1)
    assert inside.sum() > 10
    for point, pixel in zip(points[inside], pixels[inside], strict=True):
        # The undistorted pixel's ray passes through the point: K [R | -R C].
        x, y, w, q = (*to_quaternion(TURN)[:2], to_quaternion(TURN)[3], to_quaternion(TURN)[2])
        v, from_center = np.array([x, y, q]), point - CENTER
        seen = from_center + 2 * w * np.cross(v, from_center) + 2 * np.cross(v, np.cross(v, from_center))
        ideal = np.array([1620.5 * seen[0] / seen[2] + 965.25, 1620.5 * seen[1] / seen[2] + 538.5])
        np.testing.assert_allclose(undistort(pixel, middle, k), ideal, atol=0.025 if any(k) else 1e-9)


@pytest.mark.parametrize(
    ("lens", "old", "new", "message"),
    [
        (
            'VICON_RADIAL="3e-06 0"',
            "",
            "",
            "camera 2107213: (none of OpenCV's lens models|its lens model is not valid)",
        ),
        (
            'VICON_RADIAL="3e-08 0"',
            'RATIO="1"',
            'RATIO="1.05"',
            "camera 2107213: lens distortion with non-square pixels is not",
        ),
        ('VICON_RADIAL="0 0"', "FOCAL_LENGTH", "LENGTH", "camera 2107213: missing 'FOCAL_LENGTH'"),
        (
            'VICON_RADIAL="0 0"',
            'ORIENTATION="',
            'ORIENTATION="9 ',
            "camera 2107213: ORIENTATION must be 4 numbers, got 5",
        ),
        ('VICON_RADIAL="0 0"', 'POSITION="', 'POSITION="nan', "camera 2107213: POSITION (must be|has values)"),
        ('VICON_RADIAL="0 0"', "<KeyFrame ", "<Frame ", "no camera in this Vicon file is calibrated"),
        (
            'VICON_RADIAL="0 0"',
            "</KeyFrames>",
            '<KeyFrame FRAME="7"/></KeyFrames>',
            "camera .*: it moves: it has [12] KeyFrames",
        ),
    ],
)
def test_invalid_vicon_is_rejected(lens: str, old: str, new: str, message: str, tmp_path: Path) -> None:
    text = make_vicon(lens, **({old: new} if old else {}))
    with pytest.raises(ValueError, match=rf"take\.xcp: .*{message}"):
        calibration.load(write_file(tmp_path / "take.xcp", text))


# OptiTrack


def make_optitrack(**changes: str) -> str:
    """Format a .mcal; OrientMatrix has the rows of the rotation to the world from a camera that looks along -z."""
    turn = (BACK @ OTHER_TURN).T
    orient = " ".join(f'OrientMatrix{i}="{v}"' for i, v in enumerate(turn.ravel().tolist()))
    color = f"""<Camera Serial="C11764">
    <Properties CameraID="13" ImagerIndex="30" Exposure="250" FrameRate="120"/>
    <Attributes Revision="50" ImagerPixelWidth="1920" ImagerPixelHeight="1080"/>
    <Intrinsic LensCenterX="950.0" LensCenterY="540.0" HorizontalFocalLength="1100.0" VerticalFocalLength="1101.0"
      k1="0.1" k2="-0.2" k3="0.0" TangentialX="0.0" TangentialY="0.0"/>
    <IntrinsicStandardCameraModel LensCenterX="955.5" LensCenterY="541.25" HorizontalFocalLength="1120.5"
      VerticalFocalLength="1121.25" k1="-0.12" k2="0.05" k3="-0.01" TangentialX="0.0005" TangentialY="-0.001"/>
    <Extrinsic X="{CENTER[0] / 1000}" Y="{CENTER[1] / 1000}" Z="{CENTER[2] / 1000}" {orient}/>
   </Camera>"""
    marker = color.replace("C11764", "M21614").replace('ImagerIndex="30"', 'ImagerIndex="00"')
    text = f"""<?xml version="1.0" encoding="UTF-16LE"?>
<calibrationProfile version="1">
 <MotiveBuildInfo AppVersion="3.2.0.1"/>
 <Calibration><Cameras Count="2">{marker}{color}</Cameras></Calibration>
 <MaskData/>
</calibrationProfile>
"""
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8"])
def test_optitrack(encoding: str, tmp_path: Path) -> None:
    (tmp_path / "system.mcal").write_bytes(make_optitrack().encode(encoding))
    rig = calibration.load(tmp_path / "system.mcal")
    assert rig.names == ("C11764",)
    assert (rig.cameras[0].size, rig.unit) == ((1920, 1080), "m")

    def pixel(point: FloatArray) -> tuple[float, float]:
        turn = (BACK @ OTHER_TURN).T
        off = point - CENTER / 1000
        x, y, z = (sum(turn[i, j] * off[i] for i in range(3)) for j in range(3))
        u, v = apply_brown(x / -z, -y / -z, [-0.12, 0.05, -0.01], [0.0005, -0.001])
        return 1120.5 * u + 955.5, 1121.25 * v + 541.25

    assert_projects(rig.cameras[0], points_in_view(OTHER_TURN) / 1000, pixel)


def test_optitrack_without_color_cameras(tmp_path: Path) -> None:
    text = make_optitrack(**{'ImagerIndex="30"': 'ImagerIndex="00"'})
    assert calibration.load(write_file(tmp_path / "a.mcal", text)).names == ("M21614", "C11764")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "IntrinsicStandardCameraModel",
            "IntrinsicOther",
            "camera C11764: no IntrinsicStandardCameraModel: its lens has only Opti",
        ),
        ("OrientMatrix4", "OrientMatrix9", "camera C11764: missing 'OrientMatrix4'"),
        ("ImagerPixelWidth", "Width", "camera C11764: missing 'ImagerPixelWidth'"),
        ("<Extrinsic ", "<Extrinsics ", "OptiTrack, without a Camera with its Extrinsic"),
    ],
)
def test_invalid_optitrack_is_rejected(old: str, new: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"a\.mcal: .*{message}"):
        calibration.load(write_file(tmp_path / "a.mcal", make_optitrack(**{old: new})))
