"""Exports, read back by independent readers or by the format's specification: poses to float32, gaps as gaps."""

from __future__ import annotations

import base64
import csv
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sylpose.commands.main import main
from sylpose.io.exports.formats import EXPORT_FORMATS, export_trajectory
from sylpose.io.exports.poses import UP_UNKNOWN_NOTE, Poses, Surroundings
from sylpose.report.files import read_tum, write_trajectory
from sylpose.results import FramePose, Trajectory
from sylpose.simulate import ring
from sylpose.status import FrameStatus
from tests.io.exports.paths import COASTING, FOUND, MISSING, RATE, N, make_trajectory, markers_at, pose_at

GAPS = [k for k in range(N) if k not in FOUND]


def matrices(positions: Any, quaternions: Any) -> Any:
    """Return poses (n, 4, 4) of positions and quaternions, w last."""
    poses = np.tile(np.eye(4), (len(positions), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = Rotation.from_quat(np.array(quaternions)).as_matrix(), positions
    return poses


EXPECTED = np.array([pose_at(k).as_matrix() for k in FOUND])


# Text


def test_tum(tmp_path: Path) -> None:
    assert export_trajectory(make_trajectory(), tmp_path / "a.tum") == []
    times, poses = read_tum(tmp_path / "a.tum")
    np.testing.assert_allclose(times, [2 + k / RATE for k in FOUND])
    np.testing.assert_allclose(poses.as_matrix(), EXPECTED, atol=1e-12)


def test_trc(tmp_path: Path) -> None:
    """Header of OpenSim's documentation; lengths in mm; empty cells in gaps."""
    assert export_trajectory(make_trajectory(), tmp_path / "a.trc", name="mug") == []
    lines = (tmp_path / "a.trc").read_text().splitlines()
    assert lines[0] == "PathFileType\t4\t(X/Y/Z)\ta.trc"
    head = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    assert head == {
        "DataRate": "25",
        "CameraRate": "25",
        "NumFrames": "10",
        "NumMarkers": "4",
        "Units": "mm",
        "OrigDataRate": "25",
        "OrigDataStartFrame": "1",
        "OrigNumFrames": "10",
    }
    assert lines[3].split("\t")[2::3] == ["mug_O", "mug_X", "mug_Y", "mug_Z", ""]
    assert lines[4].split("\t")[2:] == [f"{axis}{k}" for k in range(1, 5) for axis in "XYZ"]
    assert lines[5] == ""
    for k, line in enumerate(lines[6:]):
        number, time, *cells = line.split("\t")
        assert int(number) == k + 1
        assert float(time) == pytest.approx(k / RATE)
        if k in GAPS:
            assert cells == [""] * 12
        else:
            values = np.reshape([float(v) for v in cells], (4, 3))
            np.testing.assert_allclose(values, 1000 * markers_at(k, 0.1), atol=1e-5)


def test_bvh(tmp_path: Path) -> None:
    with pytest.raises(
        ValueError, match=r"2 frames between the first pose and the last have no pose; .* --start 4 --stop 7$"
    ):
        export_trajectory(make_trajectory(), tmp_path / "a.bvh")
    assert export_trajectory(make_trajectory(), tmp_path / "a.bvh", start=9, stop=13) == [
        "its frames are 9 to 11 of the recording",
        UP_UNKNOWN_NOTE,
    ]
    words = (tmp_path / "a.bvh").read_text().split()
    assert words[:3] == ["HIERARCHY", "ROOT", "object"]
    at = words.index("CHANNELS")
    assert words[at + 1 : at + 8] == [
        *("6", "Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation"),
    ]
    at = words.index("Frames:")
    assert int(words[at + 1]) == 3
    assert float(words[at + 4]) == pytest.approx(1 / RATE)
    rows = np.reshape([float(v) for v in words[at + 5 :]], (3, 6))
    for row, k in zip(rows, (6, 7, 8), strict=True):
        z, x, y = np.radians(row[3:])
        about = (Rotation.from_rotvec(v) for v in ([0, 0, z], [x, 0, 0], [0, y, 0]))
        turn = next(about) * next(about) * next(about)  # in the order of the channels, each about the rotated axes
        np.testing.assert_allclose(turn.as_matrix(), pose_at(k).as_matrix()[:3, :3], atol=1e-12)
        np.testing.assert_allclose(row[:3], pose_at(k).translation, atol=1e-12)


def test_csv(tmp_path: Path) -> None:
    export_trajectory(make_trajectory(), tmp_path / "a.csv", start=4)
    with (tmp_path / "a.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["index"]) for row in rows] == list(range(4, N + 3))
    assert rows[1]["faults"] == "cam_1: moved; and more"
    assert rows[0]["residual_px_cam_1"] == "" == rows[3]["tx"]
    assert rows[3]["reason"] == "nothing to see, at all"
    assert rows[1]["tz_sd"] == "inf"
    assert float(rows[1]["qw"]) == pytest.approx(pose_at(2).rotation.as_quat()[3])


# glTF


def parse_gltf(file: Path) -> tuple[dict[str, Any], bytes]:
    """Parse glTF by its specification: JSON with an embedded buffer, or a header and chunks."""
    data = file.read_bytes()
    if file.suffix == ".gltf":
        content = json.loads(data)
        return content, base64.b64decode(content["buffers"][0]["uri"].partition("base64,")[2])
    magic, version, length, n, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    assert n % 4 == 0
    size, kind = struct.unpack("<I4s", data[20 + n : 28 + n])
    assert (kind, size) == (b"BIN\0", len(data) - 28 - n)
    return json.loads(data[20 : 20 + n]), data[28 + n :]


def accessor(content: dict[str, Any], data: bytes, k: int) -> Any:
    its = content["accessors"][k]
    view = content["bufferViews"][its["bufferView"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[its["type"]]
    assert its["componentType"] == 5126
    assert view["byteLength"] == 4 * width * its["count"]
    values = np.frombuffer(data, "<f4", width * its["count"], view["byteOffset"]).reshape(-1, width)
    if "min" in its:
        np.testing.assert_array_equal(values.min(axis=0), np.float32(its["min"]))
        np.testing.assert_array_equal(values.max(axis=0), np.float32(its["max"]))
    return values


@pytest.mark.parametrize("name", ["a.glb", "a.gltf"])
def test_gltf(name: str, tmp_path: Path) -> None:
    assert export_trajectory(make_trajectory("mm"), tmp_path / name, name="mug") == [UP_UNKNOWN_NOTE]
    content, data = parse_gltf(tmp_path / name)
    assert content["asset"]["version"] == "2.0"
    assert content["buffers"][0]["byteLength"] <= len(data)
    (animation,) = content["animations"]
    tracks = {}
    for channel in animation["channels"]:
        assert content["nodes"][channel["target"]["node"]]["name"] == "mug"
        sampler = animation["samplers"][channel["sampler"]]
        key = channel["target"]["path"]
        tracks[key] = tuple(accessor(content, data, sampler[end]) for end in ("input", "output"))
        assert sampler["interpolation"] == ("STEP" if key == "scale" else "LINEAR")
    times, positions = tracks["translation"]
    np.testing.assert_allclose(times[:, 0], [k / RATE for k in FOUND], atol=1e-6)
    found = matrices(positions * 1000, tracks["rotation"][1])  # the unit was mm, and glTF's is m
    np.testing.assert_allclose(found, EXPECTED, atol=1e-5)
    quaternions = tracks["rotation"][1]
    assert (np.sum(quaternions[1:] * quaternions[:-1], axis=1) > 0).all()  # all take the shorter way
    # Hidden in gaps: the last step of the scale up to each frame.
    changes, scale = tracks["scale"]
    for k in range(N):
        last = np.flatnonzero(changes[:, 0] <= k / RATE + 1e-6)[-1]
        np.testing.assert_array_equal(scale[last], np.full(3, float(k in FOUND)))


# C3D


@pytest.mark.filterwarnings("ignore:No analog data found")
def test_c3d(tmp_path: Path) -> None:
    pytest.importorskip("ezc3d")
    c3d = pytest.importorskip("c3d")
    assert export_trajectory(make_trajectory(), tmp_path / "a.c3d", name="mug") == []
    with (tmp_path / "a.c3d").open("rb") as file:
        reader = c3d.Reader(file)
        assert [label.strip() for label in reader.point_labels] == ["mug_O", "mug_X", "mug_Y", "mug_Z"]
        assert reader.point_rate == RATE
        assert reader.get("POINT:UNITS").string_array[0].strip() == "mm"
        frames = list(reader.read_frames())
    assert len(frames) == N
    for k, (_, points, _) in enumerate(frames):
        if k in GAPS:
            assert (points[:, 3] == -1).all()  # the residual of missing points
        else:
            np.testing.assert_allclose(points[:, :3], 1000 * markers_at(k, 0.1), atol=1e-3)
            assert (points[:, 3] >= 0).all()


# Tables


def test_parquet(tmp_path: Path) -> None:
    pq = pytest.importorskip("pyarrow.parquet")
    export_trajectory(make_trajectory(), tmp_path / "a.parquet")
    table = pq.read_table(tmp_path / "a.parquet")
    assert table.num_rows == N
    assert table["tx"].null_count == len(MISSING)
    assert table["tx"].to_pylist()[1] == pytest.approx(0.1)
    assert table["matches_cam_0"].null_count == 1
    assert table["status"].to_pylist()[COASTING] == "coasting"
    assert table["variance_inflation_cam_1"].to_pylist()[0] == np.inf
    assert table.schema.field("inliers_cam_0").type == "int64"


# ROS


def test_rosbag(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    assert export_trajectory(make_trajectory("mm"), tmp_path / "bag", "rosbag", name="my mug") == []
    assert sorted(file.suffix for file in (tmp_path / "bag").iterdir()) == [".db3", ".yaml"]
    assert not list(tmp_path.glob(".*"))
    store = get_typestore(Stores.ROS2_HUMBLE)
    poses, moved = [], []
    with Reader(tmp_path / "bag") as bag:
        for connection, at, raw in bag.messages():
            message = store.deserialize_cdr(raw, connection.msgtype)
            if connection.topic == "/my_mug/pose":
                header, pose = message.header, message.pose
                poses.append((at, pose.position, pose.orientation))
                assert header.stamp.sec * 10**9 + header.stamp.nanosec == at
                assert header.frame_id == "world"
            else:
                assert connection.topic == "/tf"
                (transform,) = message.transforms
                assert transform.child_frame_id == "my_mug"
                moved.append((at, transform.transform.translation, transform.transform.rotation))
    for found in (poses, moved):
        assert [at for at, _, _ in found] == [round((2 + k / RATE) * 1e9) for k in FOUND]  # none in gaps
        places = [[p.x, p.y, p.z] for _, p, _ in found]
        turns = [[q.x, q.y, q.z, q.w] for _, _, q in found]
        np.testing.assert_allclose(matrices(1000 * np.array(places), turns), EXPECTED, atol=1e-12)
    with pytest.raises(ValueError, match="already exists, and bags are not replaced"):
        export_trajectory(make_trajectory(), tmp_path / "bag", "rosbag")


# USD


@pytest.mark.parametrize("name", ["a.usda", "a.usdc"])
def test_usd(name: str, tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    assert export_trajectory(make_trajectory("cm"), tmp_path / name, name="2 mugs") == [UP_UNKNOWN_NOTE]
    stage = Usd.Stage.Open(str(tmp_path / name))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.01
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == pytest.approx(RATE)
    node = UsdGeom.Xformable(stage.GetPrimAtPath("/world/_2_mugs"))
    shown = UsdGeom.Imageable(node.GetPrim())
    for k in range(N):
        visible = shown.ComputeVisibility(Usd.TimeCode(k + 1e-6))  # a time code per frame
        assert visible == ("inherited" if k in FOUND else "invisible")
        if k in FOUND:
            matrix = np.array(node.GetLocalTransformation(Usd.TimeCode(k))).T  # rows of points, in USD
            np.testing.assert_allclose(matrix, pose_at(k).as_matrix(), atol=1e-12)


# Cameras and points


def make_surroundings() -> Surroundings:
    rng = np.random.default_rng(0)
    cameras = ring(3, size=(640, 480), focal=700.0).cameras
    lens = np.array([[700.0, 0.0, 300.0], [0.0, 650.0, 260.0], [0.0, 0.0, 1.0]])
    return Surroundings((replace(cameras[1], matrix=lens), cameras[2]), rng.normal(size=(9, 3)), rng.random((9, 3)))


def test_gltf_with_cameras_and_points(tmp_path: Path) -> None:
    """An independent reader loads it; cameras look at what they see; lengths in mm become meters."""
    given = make_surroundings()
    export_trajectory(make_trajectory("mm"), tmp_path / "a.glb", name="mug", surroundings=given)
    content, data = parse_gltf(tmp_path / "a.glb")
    lines, points = content["meshes"][0]["primitives"]
    assert (lines["mode"], points["mode"]) == (1, 0)
    found = accessor(content, data, points["attributes"]["POSITION"])
    np.testing.assert_allclose(1000 * found, given.points, atol=1e-5)
    np.testing.assert_allclose(accessor(content, data, points["attributes"]["COLOR_0"]), given.colors, atol=1e-6)
    nodes = content["nodes"]
    assert nodes[0]["children"] == [1, 2, 3]
    for node, camera in zip(nodes[2:], given.cameras, strict=True):
        np.testing.assert_allclose(1000 * np.array(node["translation"]), camera.center, atol=1e-9)
        forward = Rotation.from_quat(node["rotation"]).apply([0.0, 0.0, -1.0])
        np.testing.assert_allclose(forward, camera.camera_from_world.rotation.inv().apply([0.0, 0.0, 1.0]), atol=1e-9)
        down = Rotation.from_quat(node["rotation"]).apply([0.0, -1.0, 0.0])
        np.testing.assert_allclose(down, camera.camera_from_world.rotation.inv().apply([0.0, 1.0, 0.0]), atol=1e-9)
        lens = content["cameras"][node["camera"]]["perspective"]
        assert lens["yfov"] == pytest.approx(2 * np.arctan(240 / camera.matrix[1, 1]))
    trimesh = pytest.importorskip("trimesh")
    loaded = trimesh.load(tmp_path / "a.glb")
    clouds = [g for g in loaded.geometry.values() if isinstance(g, trimesh.PointCloud)]
    np.testing.assert_allclose(1000 * clouds[0].vertices, given.points, atol=1e-5)


def test_usd_with_cameras_and_points(tmp_path: Path) -> None:
    """USD's own projection of points agrees with the cameras' pixels."""
    pytest.importorskip("pxr")
    from pxr import Gf, Usd, UsdGeom

    given = make_surroundings()
    export_trajectory(make_trajectory(), tmp_path / "a.usda", name="mug", surroundings=given)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    points = UsdGeom.Points(stage.GetPrimAtPath("/world/mug/points")).GetPointsAttr().Get()
    np.testing.assert_allclose(np.array(points), given.points, atol=1e-6)
    targets = 0.1 * given.points
    for camera in given.cameras:
        prim = UsdGeom.Camera(stage.GetPrimAtPath(f"/world/cameras/{camera.name}"))
        frustum = prim.GetCamera(Usd.TimeCode(0)).frustum
        matrix = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
        screen = np.array([matrix.Transform(Gf.Vec3d(*row)) for row in targets.tolist()])
        width, height = camera.size
        pixels = np.column_stack([0.5 * width * (1 + screen[:, 0]), 0.5 * height * (1 - screen[:, 1])]) - 0.5
        np.testing.assert_allclose(pixels, camera.project(targets), atol=0.01)


# OpenSim


def read_storage(path: Path) -> tuple[dict[str, str], list[str], Any]:
    """Read a storage file by OpenSim's documentation: header, labels, table."""
    head, _, body = path.read_text().partition("endheader\n")
    name, *lines = head.splitlines()
    labels, *rows = body.splitlines()
    table = np.array([[float(cell) for cell in row.split("\t")] for row in rows])
    return {"name": name} | dict(line.split("=") for line in lines), labels.split("\t"), table


@pytest.mark.parametrize(("name", "kind"), [("a.mot", "Coordinates"), ("a.sto", "Position")])
def test_opensim(name: str, kind: str, tmp_path: Path) -> None:
    """Body-fixed x, y, z in degrees, meters, no rows in gaps."""
    assert export_trajectory(make_trajectory("mm"), tmp_path / name, name="my tibia") == [UP_UNKNOWN_NOTE]
    header, labels, table = read_storage(tmp_path / name)
    assert header == {"name": kind, "version": "1", "nRows": "6", "nColumns": "7", "inDegrees": "yes"}
    assert labels == ["time", *(f"my_tibia_{k}" for k in ("rx", "ry", "rz", "tx", "ty", "tz"))]
    np.testing.assert_allclose(table[:, 0], [2 + k / RATE for k in FOUND])
    angles = np.radians(table[:, 1:4])
    x, y, z = (Rotation.from_rotvec(angles[:, [k]] * np.eye(3)[k]) for k in range(3))
    found = matrices(1000 * table[:, 4:], (x * y * z).as_quat())
    np.testing.assert_allclose(found, EXPECTED, atol=1e-9)


def test_opensim_up_and_joint_angles(tmp_path: Path) -> None:
    (note,) = export_trajectory(make_trajectory(), tmp_path / "z.mot", z_up=True)
    assert "z up becomes y up" in note
    export_trajectory(make_trajectory(), tmp_path / "a.mot")
    up, plain = read_storage(tmp_path / "z.mot")[2], read_storage(tmp_path / "a.mot")[2]
    np.testing.assert_allclose(up[:, 4:], plain[:, [4, 6, 5]] * [1, 1, -1], atol=1e-12)
    assert export_trajectory(make_trajectory(), tmp_path / "b.mot", angles="ZXY") == []
    _, labels, table = read_storage(tmp_path / "b.mot")
    assert labels[1:4] == ["object_angle1_Z", "object_angle2_X", "object_angle3_Y"]
    found = Rotation.from_euler("ZXY", table[:, 1:4], degrees=True).as_matrix()
    np.testing.assert_allclose(found, EXPECTED[:, :3, :3], atol=1e-9)
    with pytest.raises(ValueError, match="--euler: trc has no angles of chosen axes; mot and sto do"):
        export_trajectory(make_trajectory(), tmp_path / "b.trc", angles="ZXY")


# What cannot be exported


def frames_at(times: list[float]) -> Trajectory:
    poses = [
        FramePose(k, t, FrameStatus.TRACKED, pose_at(k), np.zeros((6, 6)), np.array([9]), np.array([0.1]))
        for k, t in enumerate(times)
    ]
    return Trajectory(poses, ["a"])


@pytest.mark.parametrize("name", ["a.trc", "a.bvh"])
def test_variable_rate_is_rejected(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"requires a constant rate, and frames are 0\.04 to 0\.12 s apart"):
        export_trajectory(frames_at([0.0, 0.04, 0.08, 0.2]), tmp_path / name)
    export_trajectory(frames_at([0.0, 0.04, 0.081, 0.12]), tmp_path / name)
    export_trajectory(frames_at([0.0, 0.04, 0.08, 0.2]), tmp_path / "a.glb")
    export_trajectory(frames_at([7.0]), tmp_path / name)  # a single frame has any rate


@pytest.mark.parametrize(
    ("name", "to", "message"),
    [
        ("a.fbx", None, r"a\.fbx: unknown file name extension; give --to csv\|tum\|trc"),
        ("a.fbx", "fbx", "--to must be one of csv, tum"),
        ("a.c3d", "trc", r"a\.c3d: the file name of trc must end in one of \.trc"),
    ],
)
def test_names_that_do_not_fit(name: str, to: str | None, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        export_trajectory(make_trajectory(), tmp_path / name, to)


# Which way is up


def test_z_up_is_rotated_or_noted(tmp_path: Path) -> None:
    """Each format's up axis is set; the poses below are unchanged."""
    assert export_trajectory(make_trajectory(), tmp_path / "z.gltf", z_up=True) == []
    export_trajectory(make_trajectory(), tmp_path / "a.gltf")
    (turned, data), (plain, before) = parse_gltf(tmp_path / "z.gltf"), parse_gltf(tmp_path / "a.gltf")
    assert data == before
    assert "rotation" not in plain["nodes"][0]
    root = Rotation.from_quat(turned["nodes"][0]["rotation"])
    np.testing.assert_allclose(root.apply([[0, 0, 1], [1, 0, 0]]), [[0, 1, 0], [1, 0, 0]], atol=1e-12)
    for name, z_up in (("z.bvh", True), ("a.bvh", False)):
        *_, note = export_trajectory(make_trajectory(), tmp_path / name, start=9, stop=12, z_up=z_up)
        assert ("rotated" in note) == z_up
    poses = [
        np.array((tmp_path / name).read_text().partition("Frame Time: ")[2].split()[1:], float).reshape(-1, 6)
        for name in ("z.bvh", "a.bvh")
    ]
    np.testing.assert_allclose(poses[0][:, :3], root.apply(poses[1][:, :3]), atol=1e-12)
    turns = [Rotation.from_euler("ZXY", rows[:, 3:], degrees=True) for rows in poses]
    np.testing.assert_allclose(
        (turns[0] * turns[1].inv()).as_matrix(), np.tile(root.as_matrix(), (3, 1, 1)), atol=1e-12
    )


@pytest.mark.parametrize("z_up", [True, False])
def test_usd_and_c3d_store_up_axis(z_up: bool, tmp_path: Path) -> None:
    UsdGeom = pytest.importorskip("pxr.UsdGeom")
    Usd, ezc3d = pytest.importorskip("pxr.Usd"), pytest.importorskip("ezc3d")
    assert export_trajectory(make_trajectory(), tmp_path / "a.usda", z_up=z_up) == ([] if z_up else [UP_UNKNOWN_NOTE])
    assert UsdGeom.GetStageUpAxis(Usd.Stage.Open(str(tmp_path / "a.usda"))) == ("Z" if z_up else "Y")
    assert export_trajectory(make_trajectory(), tmp_path / "a.c3d", z_up=z_up) == []
    point = ezc3d.c3d(str(tmp_path / "a.c3d"))["parameters"]["POINT"]
    assert [point[name]["value"] for name in ("X_SCREEN", "Y_SCREEN") if name in point] == [["+X"], ["+Z"]] * z_up


# Which frames


@pytest.mark.parametrize("name", ["a.csv", "a.tum", "a.glb", "a.parquet", "a.c3d", "a.usda"])
def test_empty_frame_ranges_are_rejected(name: str, tmp_path: Path) -> None:
    if EXPORT_FORMATS[export_format(name)].package:
        pytest.importorskip(EXPORT_FORMATS[export_format(name)].package)
    for start, stop, options in ((40, None, "--start 40"), (9, 5, "--start 9 --stop 5")):
        with pytest.raises(ValueError, match=f"the trajectory has frames 3 to 12, requested: {options}"):
            export_trajectory(make_trajectory(), tmp_path / name, start=start, stop=stop)
    assert not list(tmp_path.iterdir())


def export_format(name: str) -> str:
    return next(to for to, its in EXPORT_FORMATS.items() if Path(name).suffix in its.suffixes)


def test_frame_count_matches_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The output folder is created."""
    write_trajectory(tmp_path, make_trajectory())
    out = tmp_path / "new" / "deep" / "a.csv"
    assert main(["export", str(tmp_path), "--out", str(out), "--start", "4", "--stop", "8"]) == 0
    assert "3 of 4 frames have a measured pose" in capsys.readouterr().out
    assert len(out.read_text().splitlines()) == 5
    assert main(["export", str(tmp_path), "--out", str(out), "--start", "40"]) == 2
    assert len(out.read_text().splitlines()) == 5


def test_user_world_is_read_from_settings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_trajectory(tmp_path, make_trajectory())
    (tmp_path / "world.toml").write_text("")  # of `sylpose check`
    for world, rotated in (("", False), ('[options]\nworld = "up=-y"\n', True)):
        (tmp_path / "settings.toml").write_text(world)
        assert main(["export", str(tmp_path), "--out", str(tmp_path / "a.gltf")]) == 0
        assert ("its up direction is unknown" in capsys.readouterr().out.replace("\n", " ")) != rotated
        assert ("rotation" in parse_gltf(tmp_path / "a.gltf")[0]["nodes"][0]) == rotated


@pytest.mark.parametrize("name", ["a.tum", "a.trc", "a.bvh", "a.glb"])
def test_nothing_to_export(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no pose was measured in the 1 selected frames"):
        export_trajectory(make_trajectory(), tmp_path / name, start=3, stop=4)
    assert not list(tmp_path.iterdir())


def test_missing_packages_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sylpose.io.exports.formats.find_spec", lambda _: None)
    for to, its in EXPORT_FORMATS.items():
        if its.package:
            with pytest.raises(ValueError, match=rf"--to {to} needs .* pip install 'sylpose\[{its.extra}\]'"):
                export_trajectory(make_trajectory(), tmp_path / f"a{(*its.suffixes, '')[0]}", to)


def test_names_have_no_blanks_in_text_formats(tmp_path: Path) -> None:
    export_trajectory(make_trajectory(), tmp_path / "a.trc", name="my mug")
    assert "my_mug_O" in (tmp_path / "a.trc").read_text()
    export_trajectory(make_trajectory(), tmp_path / "a.bvh", name="my mug", stop=7)
    assert "ROOT my_mug\n" in (tmp_path / "a.bvh").read_text()
    for name in ("", " ", "a\nb"):
        with pytest.raises(ValueError, match="the object's name must be text"):
            export_trajectory(make_trajectory(), tmp_path / "b.trc", name=name)


def test_unknown_unit_is_noted(tmp_path: Path) -> None:
    for name in ("a.trc", "a.glb"):
        note, *_ = export_trajectory(make_trajectory(""), tmp_path / name)
        assert "unknown unit" in note


def test_only_measured_poses_are_exported() -> None:
    poses = Poses.from_trajectory(make_trajectory())
    np.testing.assert_array_equal(np.flatnonzero(poses.has_pose), FOUND)
    assert np.isnan(poses.quaternions[GAPS]).all()
    assert (np.sum(poses.quaternions[FOUND][1:] * poses.quaternions[FOUND][:-1], axis=1) > 0).all()
    assert poses.trim().indices == list(range(4, 12))


def test_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_trajectory(tmp_path / "run" / "mug", make_trajectory())
    (tmp_path / "run" / "settings.toml").write_text("")
    assert main(["export", str(tmp_path / "run" / "mug"), "--out", str(tmp_path / "a.trc")]) == 0
    assert "6 of 10 frames have a measured pose." in capsys.readouterr().out
    assert "mug_O" in (tmp_path / "a.trc").read_text()
    assert main(["export", str(tmp_path / "run" / "mug"), "--out", str(tmp_path / "a.bvh")]) == 2
    assert "bvh cannot represent gaps" in capsys.readouterr().err
