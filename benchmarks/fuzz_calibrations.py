"""Valid calibrations in other programs' formats for benchmarks/fuzz.py: two cameras of 64 x 48 pixels."""

from __future__ import annotations

import io
import json
import pickle
import struct
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from scipy.io import savemat
from scipy.spatial.transform import Rotation

__all__ = ["SAMPLES", "Sample"]


class Sample(NamedTuple):
    """Sample files of a format.

    Attributes:
        name: name of the file that is mutated.
        samples: valid contents of it.
        other_files: contents of the other files in its folder, by name.
        is_text: the file is text.
    """

    name: str
    samples: tuple[bytes, ...]
    other_files: Mapping[str, bytes] = MappingProxyType({})
    is_text: bool = True


ROTATION = Rotation.from_euler("XYZ", [0.3, -0.2, 0.5])
MATRIX = ROTATION.as_matrix()
K, D, TRANSLATION = (
    [[80.5, 0.0, 31.5], [0.0, 81.0, 23.5], [0.0, 0.0, 1.0]],
    [-0.1, 0.02, 0.001, -0.002, 0.0],
    [0.1, -0.2, 1.5],
)
X, Y, Z, W = ROTATION.as_quat().tolist()
POSE = np.vstack([np.column_stack([MATRIX, TRANSLATION]), [0.0, 0.0, 0.0, 1.0]])


def _join_numbers(values: Any) -> str:
    return " ".join(map(str, np.ravel(values).tolist()))


def _format_matrix(name: str, values: Any) -> str:
    rows = np.atleast_2d(np.array(values, dtype=float))
    numbers = ", ".join(map(str, rows.ravel().tolist()))
    return f"{name}: !!opencv-matrix\n   rows: {rows.shape[0]}\n   cols: {rows.shape[1]}\n   dt: d\n   data: [ {numbers} ]\n"


def _format_storage(**values: Any) -> bytes:
    return ("%YAML:1.0\n---\n" + "".join(_format_matrix(name, value) for name, value in values.items())).encode()


LENSES = _format_storage(M1=K, D1=D, M2=K, D2=D)
EXTRINSICS = _format_storage(R=MATRIX, T=np.array([TRANSLATION]).T, R1=np.eye(3), R2=np.eye(3))
PAIR = {"K1": K, "D1": D, "K2": K, "D2": D, "R": MATRIX.tolist(), "T": TRANSLATION, "imageSize": [64, 48]}
CHAIN = f"""cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [80.5, 81.0, 31.5, 23.5]
  resolution: [64, 48]
cam1:
  T_cn_cnm1:
{"".join(f"  - {row}{chr(10)}" for row in POSE.tolist())}  camera_model: pinhole
  distortion_coeffs: [-0.1, 0.02, 0.001, -0.002]
  distortion_model: equidistant
  intrinsics: [80.5, 81.0, 31.5, 23.5]
  resolution: [64, 48]
""".encode()
CAMERAS = b"# cameras\n1 OPENCV 64 48 80.5 81 32 24 -0.1 0.02 0.001 -0.002\n2 PINHOLE 64 48 80 80 32 24\n"
IMAGES = f"""# images
1 1 0 0 0 0 0 0 1 left/0.png
1.5 2.5 -1 3 4 8
2 {W} {X} {Y} {Z} {_join_numbers(TRANSLATION)} 2 right/0.png

""".encode()
CAMERAS_BIN = struct.pack("<Q", 2) + b"".join(
    struct.pack("<IiQQ4d", i, 1, 64, 48, 80.5, 81.0, 32.0, 24.0) for i in (1, 2)
)
COLMAP_MODEL = {"cameras.txt": CAMERAS, "images.txt": IMAGES}
IMAGES_BIN = struct.pack("<Q", 2) + b"".join(
    struct.pack("<I7dI", i, W, X, Y, Z, *TRANSLATION, i) + name + struct.pack("<Qddq", 1, 1.5, 2.5, -1)
    for i, name in ((1, b"left/0.png\0"), (2, b"right/0.png\0"))
)
COLMAP_BINARY_MODEL = {"cameras.bin": CAMERAS_BIN, "images.bin": IMAGES_BIN}
RIG_CONFIG = json.dumps(
    [
        {
            "cameras": [
                {
                    "image_prefix": "a/",
                    "ref_sensor": True,
                    "camera_model_name": "PINHOLE",
                    "camera_params": [80, 80, 32, 24],
                },
                {
                    "image_prefix": "b/",
                    "cam_from_rig_rotation": [W, X, Y, Z],
                    "cam_from_rig_translation": TRANSLATION,
                    "camera_model_name": "RADIAL",
                    "camera_params": [80, 32, 24, 0.1, 0.0],
                },
            ]
        }
    ]
).encode()
INFO = f"""image_width: 64
image_height: 48
camera_name: left
camera_matrix:
  rows: 3
  cols: 3
  data: {np.ravel(K).tolist()}
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: {D}
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [80, 0, 32, 0, 0, 80, 24, 0, 0, 0, 1, 0]
""".encode()
TF = f"""transforms:
- header:
    frame_id: base
  child_frame_id: left_optical_frame
  transform:
    translation: {{x: 0.5, y: -0.25, z: 1.0}}
    rotation: {{x: {X}, y: {Y}, z: {Z}, w: {W}}}
---
header:
  frame_id: base
child_frame_id: right
transform:
  translation: {{x: 0.5, y: -0.25, z: 2.0}}
  rotation: {{x: {X}, y: {Y}, z: {Z}, w: {W}}}
""".encode()
JARVIS = _format_storage(
    intrinsicMatrix=np.array(K).T, distortionCoefficients=D, R=MATRIX.T, T=np.array([TRANSLATION]).T
)
INTRI = b'%YAML:1.0\n---\nnames:\n  - "01"\n  - "02"\n' + _format_storage(K_01=K, dist_01=D, K_02=K, dist_02=D)[14:]
EXTRI = (
    _format_storage(R_01=[0.1, 0.2, 0.3], T_01=TRANSLATION, Rot_02=MATRIX, T_02=TRANSLATION)
    + b'names: [ "01", "02" ]\n'
)
QUALISYS_CAMERA = f"""<camera active="1" calibrated="true" serial="%d" model="Miqus Video" viewrotation="0">
<fov_video left="0" top="0" right="63" bottom="47"/>
<transform x="100" y="-200" z="1500" {" ".join(f'r{i + 1}{j + 1}="{MATRIX[i, j]}"' for i in range(3) for j in range(3))}/>
<intrinsic focalLengthU="5152" focalLengthV="5184" centerPointU="2016" centerPointV="1504" skew="0" radialDistortion1="-0.1"
 radialDistortion2="0.02" radialDistortion3="0" tangentalDistortion1="0.001" tangentalDistortion2="-0.002"/></camera>"""
QUALISYS = f"<calibration><cameras>{QUALISYS_CAMERA % 1}{QUALISYS_CAMERA % 2}</cameras></calibration>".encode()
VICON_CAMERA = f"""<Camera DEVICEID="%d" ISDV="2" PIXEL_ASPECT_RATIO="1" SENSOR_SIZE="64 48" SKEW="0"><KeyFrames>
<KeyFrame FOCAL_LENGTH="80.5" FRAME="0" IMAGE_ERROR="0.2" ORIENTATION="{X} {Y} {Z} {W}" POSITION="100 -200 1500"
PRINCIPAL_POINT="31.5 23.5" VICON_RADIAL2="ViconRadial2 31.5 23.5 1e-05 1e-10 0"/></KeyFrames></Camera>"""
VICON = f'<?xml version="1.0"?>\n<Cameras VERSION="1.0">{VICON_CAMERA % 1}{VICON_CAMERA % 2}</Cameras>'.encode()
OPTITRACK_CAMERA = f"""<Camera Serial="C%d"><Properties ImagerIndex="30"/>
<Attributes ImagerPixelWidth="64" ImagerPixelHeight="48"/>
<IntrinsicStandardCameraModel LensCenterX="31.5" LensCenterY="23.5" HorizontalFocalLength="80" VerticalFocalLength="81"
 k1="-0.1" k2="0.02" k3="0" TangentialX="0.001" TangentialY="-0.002"/>
<Extrinsic X="1" Y="2" Z="3" {" ".join(f'OrientMatrix{i}="{v}"' for i, v in enumerate(MATRIX.ravel()))}/></Camera>"""
OPTITRACK = f"""<?xml version="1.0" encoding="UTF-16LE"?>
<calibrationProfile><Calibration><Cameras>{OPTITRACK_CAMERA % 1}{OPTITRACK_CAMERA % 2}</Cameras></Calibration>
</calibrationProfile>"""
METASHAPE = f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="1"><sensors><sensor id="0" type="frame">
<calibration type="frame" class="adjusted"><resolution width="64" height="48"/><f>80.5</f><cx>0.5</cx><cy>-0.5</cy>
<k1>-0.1</k1><k2>0.02</k2><p1>0.001</p1></calibration></sensor></sensors><cameras>
<camera id="0" sensor_id="0" label="left.png"><transform>{_join_numbers(np.eye(4))}</transform></camera>
<camera id="1" sensor_id="0" label="right.png"><transform>{_join_numbers(POSE)}</transform></camera></cameras>
<transform><rotation>{_join_numbers(MATRIX)}</rotation><translation>1 2 3</translation><scale>0.5</scale></transform></chunk>
</document>""".encode()
MATLAB_LENS = {"RadialDistortion": [-0.1, 0.02], "TangentialDistortion": [0.0, 0.001], "ImageSize": [48, 64]}
MATLAB = json.dumps(
    {
        "CameraParameters1": MATLAB_LENS | {"IntrinsicMatrix": np.array(K).T.tolist(), "WorldUnits": "mm"},
        "CameraParameters2": MATLAB_LENS | {"K": K},
        "RotationOfCamera2": MATRIX.T.tolist(),
        "TranslationOfCamera2": TRANSLATION,
    }
).encode()
NERF = json.dumps(
    {"fl_x": 80.5, "cx": 32.0, "cy": 24.0, "w": 64, "h": 48, "k1": -0.1}
    | {"frames": [{"file_path": f"images/{n}.png", "transform_matrix": POSE.tolist()} for n in ("left", "right")]}
).encode()
PMAT = _join_numbers(np.array(K) @ POSE[:3]).encode()
RAD = "".join(f"K{i + 1}{j + 1} = {K[i][j]}\n" for i in range(3) for j in range(3)).encode()
RAD += b"\nkc1 = -0.1\nkc2 = 0.02\nkc3 = 0.001\nkc4 = -0.002\n"
SELF = {"camera1.Pmat.cal": PMAT, "camera2.Pmat.cal": PMAT, "Res.dat": b"64 48\n64 48\n", "camera_order.txt": b"a\nb\n"}
STEREO = {
    "cameraMatrix1": np.array(K),
    "cameraMatrix2": np.array(K),
    "distCoeffs1": np.array([D]),
    "distCoeffs2": np.array([D]),
    "R": MATRIX,
    "T": np.array([TRANSLATION]).T,
    "image_shape": [(64, 48), (64, 48)],
}
PICKLES = tuple(pickle.dumps({"camera-1-camera-2": STEREO}, protocol=protocol) for protocol in (2, 3, 4, 5))

# MC-Calib has a pose of each camera, KWIVER, mrcal, MayaCam and OpenPTV a file of each.
MC_CALIB = (
    "%YAML:1.0\n---\nnb_camera: 1\ncamera_0:\n"
    + "".join(
        "   " + line + "\n"
        for name, values in (("camera_matrix", K), ("distortion_vector", [D]), ("camera_pose_matrix", POSE))
        for line in _format_matrix(name, values).splitlines()
    )
    + "   distortion_type: 0\n   camera_group: 0\n   img_width: 64\n   img_height: 48\n"
).encode()
PANOPTIC_CAMERA = {"name": "00_00", "type": "hd", "resolution": [64, 48], "panel": 0, "node": 0, "K": K, "distCoef": D}
PANOPTIC_CAMERA |= {"R": MATRIX.tolist(), "t": [[x] for x in TRANSLATION]}
BOP_IMAGE = {"cam_K": np.ravel(K).tolist(), "cam_R_w2c": np.ravel(MATRIX).tolist(), "cam_t_w2c": TRANSLATION}
SPLAT_IMAGE = {
    "id": 0,
    "img_name": "a/0",
    "width": 64,
    "height": 48,
    "position": TRANSLATION,
    "rotation": MATRIX.tolist(),
}
VIAME = {"R": np.ravel(MATRIX).tolist(), "T": TRANSLATION, "image_width": 64, "image_height": 48}
for _side in ("left", "right"):
    VIAME |= {
        f"{_key}_{_side}": 80.5 if _key[0] == "f" else 0.1 for _key in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    }
RIGS = f"1 2 CAMERA 1 CAMERA 2 1 {W} {X} {Y} {Z} {_join_numbers(TRANSLATION)}\n".encode()
FRAMES = b"1 1 1 0 0 0 0 0 1 2 CAMERA 1 1 CAMERA 2 2\n"
RIGS_BIN = struct.pack("<QIIiIiIB7d", 1, 1, 2, 0, 1, 0, 2, 1, W, X, Y, Z, *TRANSLATION)
FRAMES_BIN = struct.pack("<QII7dIiIQiIQ", 1, 1, 1, 1, 0, 0, 0, 0, 0, 1, 2, 0, 1, 1, 0, 2, 2)
MRCAL = f"""# mrcal
{{
    'lensmodel': 'LENSMODEL_OPENCV5',
    'intrinsics': {[80.5, 81.0, 31.5, 23.5, *D]},
    'extrinsics': {[*ROTATION.as_rotvec().tolist(), *TRANSLATION]},
    'imagersize': [ 64, 48,],
    'optimization_inputs': b'X7K&W',
}}
""".encode()
KRTD = "\n".join(map(_join_numbers, (K, MATRIX, TRANSLATION, D))).encode()
MAYACAM = ("image size\n64,48\n\ncamera matrix\n" + "\n".join(",".join(map(str, row)) for row in K)).encode()
MAYACAM += ("\n\nrotation\n" + "\n".join(",".join(map(str, row)) for row in MATRIX.tolist())).encode()
MAYACAM += ("\n\ntranslation\n" + "\n".join(map(str, TRANSLATION)) + "\n").encode()
_PROJECTION = np.array(K) @ POSE[:3]
DLT = "".join(f"{x},{x}\n" for x in (_PROJECTION / _PROJECTION[2, 3]).ravel()[:11].tolist()).encode()
ORI = f"{_join_numbers(TRANSLATION)}\n0 0 0\n\n{_join_numbers(MATRIX)}\n\n0.01 0\n5.5\n\n0 0 50\n".encode()
ADDPAR, PTV = b"0.001 0 0 0 0 1 0\n", b"1\nimg\ncal/cam1.tif\n1\n0\n1\n64\n48\n0.07\n0.07\n0\n1\n1\n1\n0\n"
OPENCAP = {"intrinsicMat": np.array(K), "distortion": np.array([D]), "imageSize": np.array([[48.0], [64.0]])}
OPENCAP |= {"rotation": MATRIX, "translation": np.array([TRANSLATION]).T}


def _save_matlab(compress: bool, **values: Any) -> bytes:
    file = io.BytesIO()
    savemat(file, values, do_compression=compress)
    return file.getvalue()


def _save_arrays() -> bytes:
    file = io.BytesIO()
    lenses = {f"cameraMatrix{side}": np.array(K) for side in "LR"} | {f"distCoeffs{side}": np.array(D) for side in "LR"}
    arrays: dict[str, Any] = lenses | {"R": MATRIX, "T": np.array(TRANSLATION)}
    np.savez(file, **arrays)
    return file.getvalue()


BOUGUET: dict[str, Any] = {"R": MATRIX, "T": np.array([TRANSLATION]).T, "nx": 64.0, "ny": 48.0}
for _side in ("left", "right"):
    BOUGUET |= {
        f"fc_{_side}": np.array([80.5, 81.0]),
        f"cc_{_side}": np.array([31.5, 23.5]),
        f"kc_{_side}": np.array(D),
    }
_PARAMETERS = {"K": np.array(K).T, "r": MATRIX.T, "t": np.array([TRANSLATION])}
_PARAMETERS |= {"RDistort": np.array([D[:2]]), "TDistort": np.array([D[2:4]])}
_CELLS = np.empty((2, 1), dtype=object)
_CELLS[:, 0] = [_PARAMETERS, _PARAMETERS]

SAMPLES: dict[str, Sample] = {
    "MC-Calib": Sample("calibrated_cameras_data.yml", (MC_CALIB,)),
    "CMU Panoptic": Sample("calibration.json", (json.dumps({"cameras": [PANOPTIC_CAMERA]}).encode(),)),
    "BOP": Sample("scene_camera.json", (json.dumps({"0": BOP_IMAGE, "1": BOP_IMAGE}).encode(),)),
    "3D Gaussian splatting": Sample("cameras.json", (json.dumps([SPLAT_IMAGE | {"fx": 80.5, "fy": 81.0}]).encode(),)),
    "VIAME": Sample("stereo.json", (json.dumps(VIAME).encode(),)),
    "COLMAP rigs.txt": Sample("rigs.txt", (RIGS,), COLMAP_MODEL | {"frames.txt": FRAMES}),
    "COLMAP frames.txt": Sample("frames.txt", (FRAMES,), COLMAP_MODEL | {"rigs.txt": RIGS}),
    "COLMAP rigs.bin": Sample("rigs.bin", (RIGS_BIN,), COLMAP_BINARY_MODEL | {"frames.bin": FRAMES_BIN}, False),
    "COLMAP frames.bin": Sample("frames.bin", (FRAMES_BIN,), COLMAP_BINARY_MODEL | {"rigs.bin": RIGS_BIN}, False),
    "mrcal": Sample("a.cameramodel", (MRCAL,)),
    "KWIVER": Sample("a.krtd", (KRTD,)),
    "XMALab": Sample("mayacam.txt", (MAYACAM,)),
    "DLT": Sample("dltCoefs.csv", (DLT,)),
    "OpenPTV .ori": Sample("cam1.tif.ori", (ORI,), {"cam1.tif.addpar": ADDPAR, "ptv.par": PTV}),
    "OpenPTV .addpar": Sample("cam1.tif.addpar", (ADDPAR,), {"cam1.tif.ori": ORI, "ptv.par": PTV}),
    "OpenCap": Sample("cam0.pickle", tuple(pickle.dumps(OPENCAP, protocol=k) for k in (2, 3, 4, 5)), {}, False),
    "stereo, npz": Sample("stereo.npz", (_save_arrays(),), {}, False),
    "Bouguet": Sample("Calib_Results_stereo.mat", tuple(_save_matlab(b, **BOUGUET) for b in (True, False)), {}, False),
    "DANNCE": Sample("hires_cam1_params.mat", tuple(_save_matlab(b, **_PARAMETERS) for b in (True, False)), {}, False),
    "Label3D": Sample("a_dannce.mat", tuple(_save_matlab(b, params=_CELLS) for b in (True, False)), {}, False),
    "stereo": Sample("intrinsics.yml", (LENSES,), {"extrinsics.yml": EXTRINSICS}),
    "stereo, poses": Sample("extrinsics.yml", (EXTRINSICS,), {"intrinsics.yml": LENSES}),
    "stereo, json": Sample("stereo.json", (json.dumps(PAIR).encode(),)),
    "Kalibr": Sample("camchain.yaml", (CHAIN,)),
    "COLMAP cameras.txt": Sample("cameras.txt", (CAMERAS,), {"images.txt": IMAGES}),
    "COLMAP images.txt": Sample("images.txt", (IMAGES,), {"cameras.txt": CAMERAS}),
    "COLMAP cameras.bin": Sample("cameras.bin", (CAMERAS_BIN,), {"images.bin": IMAGES_BIN}, False),
    "COLMAP images.bin": Sample("images.bin", (IMAGES_BIN,), {"cameras.bin": CAMERAS_BIN}, False),
    "COLMAP rig_config": Sample("rig_config.json", (RIG_CONFIG,)),
    "ROS camera_info": Sample("left.yaml", (INFO,), {"right.yaml": INFO.replace(b"left", b"right"), "tf.yaml": TF}),
    "ROS transforms": Sample("tf.yaml", (TF,), {"left.yaml": INFO, "right.yaml": INFO.replace(b"left", b"right")}),
    "JARVIS": Sample("Camera_T.yaml", (JARVIS,), {"Camera_B.yaml": JARVIS}),
    "EasyMocap intri": Sample("intri.yml", (INTRI,), {"extri.yml": EXTRI}),
    "EasyMocap extri": Sample("extri.yml", (EXTRI,), {"intri.yml": INTRI}),
    "Qualisys": Sample("take.qca.txt", (QUALISYS,)),
    "Vicon": Sample("take.xcp", (VICON,)),
    "OptiTrack": Sample("system.mcal", (OPTITRACK.encode("utf-16"), OPTITRACK.encode())),
    "Metashape": Sample("cameras.xml", (METASHAPE,)),
    "Matlab": Sample("stereo.json", (MATLAB,)),
    "NeRF": Sample("transforms.json", (NERF,)),
    "MultiCamSelfCal": Sample("camera1.Pmat.cal", (PMAT,), SELF | {"basename1.rad": RAD, "basename2.rad": RAD}),
    "MultiCamSelfCal, lens": Sample("basename1.rad", (RAD,), SELF | {"basename2.rad": RAD}),
    "DeepLabCut": Sample("stereo_params.pickle", PICKLES, {}, False),
}
