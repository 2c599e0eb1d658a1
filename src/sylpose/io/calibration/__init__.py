"""Calibration file readers and writers for `Rig`.

    rig = calibration.load("session/calibration.toml")
    calibration.save(rig, "session/calibration.yml")

| format | module | content |
|---|---|---|
| sylpose TOML | `native` | `format = "sylpose-calibration-1"`, `[cameras.NAME]` |
| Anipose TOML | `anipose` | `[cam_0]`, `[cam_1]`, ..., `[metadata]` |
| Caliscope TOML | `anipose` | `[cameras.0]`, `[cameras.1]`, ... |
| OpenCV FileStorage YAML, JSON, XML | `filestorage` | one node per camera, or a sequence `cameras` |
| OpenCV stereo | `stereo` | M1 D1 M2 D2 in intrinsics.yml, R T in extrinsics.yml, or all in one |
| stereo arrays | `stereo_arrays` | .npz or .mat of OpenCV's names; Bouguet's Calib_Results_stereo.mat |
| Kalibr | `kalibr` | camchain.yaml: cam0, cam1, ... with T_cn_cnm1 |
| COLMAP | `colmap` | a folder with cameras.txt and images.txt, or .bin; rig_config.json |
| ROS | `ros` | camera_info of each camera, and transforms |
| JARVIS | `folders` | one file per camera: intrinsicMatrix, distortionCoefficients, R, T |
| Qualisys, Vicon, OptiTrack | `motion_capture` | .qca.txt, .xcp, .mcal |
| EasyMocap | `folders` | intri.yml and extri.yml |
| MultiCamSelfCal | `folders` | camera1.Pmat.cal, ..., with basename1.rad, ... |
| Matlab | `stereo` | stereoParameters as JSON |
| Metashape | `photogrammetry` | cameras exported as XML |
| NeRF | `photogrammetry` | transforms.json |
| MC-Calib, CMU Panoptic | `opencv_programs` | a node per camera; a list with distCoef |
| DANNCE, Label3D | `dannce` | hires_cam1_params.mat, ...; .mat with params |
| OpenCap | `opencap` | cameraIntrinsicsExtrinsics.pickle of each camera |
| mrcal | `mrcal` | .cameramodel of each camera |
| KWIVER, VIAME | `kwiver` | .krtd of each camera; calibration.json |
| BOP, 3D Gaussian splatting | `posed_images` | scene_camera.json; cameras.json |
| XMALab, DLTdv, Argus | `biomechanics` | MayaCam .txt and .csv; DLT coefficients as .csv |
| OpenPTV | `openptv` | .ori and .addpar of each camera |
| DeepLabCut | `folders` | stereo_params.pickle |

`formats` lists the formats that are read and those that are written. In any case a `Rig` has poses
`camera_from_world` and OpenCV's pixel convention (docs/conventions.md).
"""

from sylpose.io.calibration.files import find, format_name, load, save, search

__all__ = ["find", "format_name", "load", "save", "search"]
