"""Object models of one recording used in another: same object frame from the first frame on, and observable scale."""

from __future__ import annotations

import io
import re
import tracemalloc
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.fuzz import make_kinds
from benchmarks.rendered_recordings import Recording, write_recording
from sylpose.commands.main import main
from sylpose.io import calibration
from sylpose.io.capture import open_session
from sylpose.io.object_files import CLOUD_FILE, OBJECT_FILE, load_known_objects, load_object, save_object, write_cloud
from sylpose.rig import Rig
from sylpose.runs.options import RunOptions
from sylpose.runs.run import track_session
from sylpose.simulate import Actor, Scene, arc, chamfered_box
from sylpose.status import Observability
from sylpose.tracking.known_object import KnownObject, transfer_object
from sylpose.tracking.options import TrackingOptions
from sylpose.tracking.tracker import Tracker
from sylpose.units import INITIAL_DISTANCES
from tests.recordings import NEXT, RIG, Path_, compute_pose_error, moved_path, slide, write_box_recording

pytestmark = pytest.mark.usefixtures("undrawn")


def count_sights(known: KnownObject) -> int:
    return sum(len(numbers) for memory in known._cameras.values() for numbers in memory.landmark_ids)


@pytest.mark.parametrize(
    ("path", "smooth"),
    [
        pytest.param(moved_path, False, id="tracked-elsewhere", marks=pytest.mark.slow),
        pytest.param(slide, False, id="tracked-slide"),
        pytest.param(moved_path, True, id="smoothed-elsewhere"),
        pytest.param(slide, True, id="smoothed-slide", marks=pytest.mark.slow),
    ],
)
def test_object_keeps_frame_in_other_recording(
    tmp_path: Path, known: KnownObject, actor_from_object: RigidTransform, path: Path_, smooth: bool
) -> None:
    take = write_box_recording(tmp_path / "take", path, NEXT, seed=5)
    run = track_session(open_session(take), options=RunOptions(overlay=False, smooth=smooth, known=known))
    assert all(pose.is_measured for pose in run.trajectory)
    assert all(pose.observability is Observability.ALL for pose in run.trajectory)
    wrong = np.array([compute_pose_error(pose, path(pose.index) * actor_from_object) for pose in run.trajectory])
    assert np.degrees(np.linalg.norm(wrong[:, :3], axis=1)).max() < 0.8
    assert np.linalg.norm(wrong[:, 3:], axis=1).max() < 0.0025
    # The uncertainty refers to the other recording's frame from the first frame on, and is neither too small nor too
    # large.
    squares = [e @ np.linalg.solve(pose.covariance, e) / 6 for e, pose in zip(wrong, run.trajectory, strict=True)]
    assert 0.05 < np.mean(squares) < 4.0
    assert max(np.degrees(pose.sigma[:3]).max() for pose in run.trajectory) < 1.5
    # Translations have a scale.
    ends = [run.trajectory[k].position for k in (0, -1)]
    true = [path(k).translation + path(k).rotation.apply(actor_from_object.translation) for k in (0, NEXT - 1)]
    assert np.linalg.norm(ends[1] - ends[0]) == pytest.approx(np.linalg.norm(true[1] - true[0]), rel=0.02)
    if path is moved_path:
        # The model gains landmarks.
        more = load_object(take / "sylpose" / OBJECT_FILE)
        assert len(more._keyframes) > len(known._keyframes)
        assert count_sights(more) > count_sights(known)


def test_object_summary(known: KnownObject) -> None:
    first, *cameras = str(known).splitlines()
    assert first.startswith(("KnownObject: radius 1", "KnownObject: radius 2"))
    assert f"mm, {len(known.positions)} landmarks, {len(known._keyframes)} keyframes" in first
    assert [line.split()[0] for line in cameras] == list(known.camera_names)
    assert sum(int(line.split()[1]) for line in cameras) == len(known.positions)


def test_resume_with_known_object(
    first: Path, known: KnownObject, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = open_session(write_box_recording(tmp_path / "take", moved_path, 4, seed=5))
    whole = track_session(session, tmp_path / "whole", RunOptions(overlay=False, known=known))
    done: list[int] = []
    with pytest.raises(KeyboardInterrupt):
        track_session(
            session,
            tmp_path / "out",
            RunOptions(overlay=False, known=known),
            on_frame=lambda _, f: done.append(f.pose.index),
            interrupted=lambda: len(done) == 2,
        )
    with pytest.raises(
        ValueError, match=r"checkpoint\.bin: the interrupted run had known object [0-9a-f]{32}, not none"
    ):
        track_session(session, tmp_path / "out", RunOptions(overlay=False, resume=True))
    file = f"--object={first / 'sylpose' / OBJECT_FILE}"
    assert main(["track", str(session.path), "--out", str(tmp_path / "out"), "--no-overlay", "--resume", file]) == 0
    assert "Resuming after 2 of 4 frames" in capsys.readouterr().out
    for name in ("trajectory.tum", "trajectory.csv", "tracked.csv"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    assert len(whole.trajectory) == 4


def test_object_file_round_trip(known: KnownObject, tmp_path: Path) -> None:
    save_object(known, tmp_path / "again.npz")
    again = load_object(tmp_path / "again.npz")
    assert (again.unit, again.radius, again.camera_names) == (known.unit, known.radius, RIG.names)
    np.testing.assert_array_equal(known.positions, again.positions)
    assert len(known.positions) > 300
    for one, other in zip(known._keyframes, again._keyframes, strict=True):
        np.testing.assert_array_equal(one.world_from_object.as_matrix(), other.world_from_object.as_matrix())
        np.testing.assert_array_equal(one.covariance, other.covariance)
    for name, memory in known._cameras.items():
        np.testing.assert_array_equal(memory.landmarks.information, again._cameras[name].landmarks.information)
        for k, features in enumerate(memory.features):
            np.testing.assert_array_equal(features.descriptors, again._cameras[name].features[k].descriptors)
            np.testing.assert_array_equal(memory.landmark_ids[k], again._cameras[name].landmark_ids[k])
            assert np.linalg.norm(features.descriptors, axis=1) == pytest.approx(np.ones(len(features)), abs=1e-3)


def test_point_cloud_is_on_object(first: Path, known: KnownObject, actor_from_object: RigidTransform) -> None:
    data = (first / "sylpose" / CLOUD_FILE).read_bytes()
    head, _, body = data.partition(b"end_header\n")
    count = int(re.search(rb"element vertex (\d+)", head)[1])  # type: ignore[index]
    points = np.frombuffer(body, [("place", "<f4", 3), ("color", "u1", 3), ("sd", "<f4")])
    assert len(points) == count > 100
    on_box = np.abs(actor_from_object.apply(points["place"].astype(float))) / (np.array([0.3, 0.22, 0.26]) / 2)
    assert np.quantile(on_box.max(axis=1), 0.9) < 1.05  # inside its sides
    assert np.quantile(on_box.max(axis=1), 0.1) > 0.8  # and near them
    assert (points["sd"] < 0.1 * known.radius).all()


def test_static_object_is_not_learned(tmp_path: Path) -> None:
    stands = write_box_recording(tmp_path / "take", lambda _: RigidTransform.identity(), 3)
    track_session(open_session(stands), options=RunOptions(overlay=False))
    assert not (stands / "sylpose" / OBJECT_FILE).exists()
    assert (stands / "sylpose" / "trajectory.csv").exists()


def test_absent_object_is_not_found(tmp_path: Path, known: KnownObject) -> None:
    """Track another object with a different texture."""
    other = Scene(RIG, (Actor(chamfered_box([0.2, 0.3, 0.2], 77), moved_path),), 2, 11)
    write_recording(Recording(other), tmp_path / "take")
    run = track_session(open_session(tmp_path / "take"), options=RunOptions(overlay=False, known=known))
    assert not run.trajectory.measured_mask.any()
    assert all(pose.reason for pose in run.trajectory)


# --- invalid input
# -----------------------------------------------------------------------------------------------------


def moved(name: str, angle: float) -> Rig:
    """Return the rig with one camera rotated about its y axis."""
    turn = RigidTransform.from_rotation(Rotation.from_rotvec([0, angle, 0]))
    return Rig([replace(c, camera_from_world=turn * c.camera_from_world) if c.name == name else c for c in RIG], "m")


def test_matching_cameras_of_known_rig(known: KnownObject) -> None:
    """Match relative camera poses in any world; unmatched ones get none; if most are, it is another rig."""
    with pytest.raises(ValueError, match="its lengths are in m, those of the calibration in mm"):
        transfer_object(known, Rig(RIG.cameras, "mm"), TrackingOptions())
    with pytest.raises(ValueError, match="a single camera learned it"):
        transfer_object(replace(known, rig=Rig(RIG.cameras, INITIAL_DISTANCES)), RIG, TrackingOptions())
    world = RigidTransform.from_components([3.0, -2.0, 1.0], Rotation.from_rotvec([1.0, 2.0, -0.5]))
    for rig in (RIG, RIG.subset(["cam_0", "cam_2"]), RIG.subset(["cam_1"]), moved("cam_1", 0.002), RIG.in_world(world)):
        here = transfer_object(known, rig, TrackingOptions())
        assert not here.is_other_rig
        assert not here.note
        assert tuple(here.landmarks) == rig.names
        seen = [rig.cameras[0].camera_from_world * k.world_from_object for k in here.keyframes]
        for pose, keyframe in zip(seen, known._keyframes, strict=True):
            before = known.rig[rig.names[0]].camera_from_world * keyframe.world_from_object
            np.testing.assert_allclose(pose.as_matrix(), before.as_matrix(), atol=2e-3)
    here = transfer_object(known, moved("cam_1", 0.1), TrackingOptions())
    assert not here.is_other_rig
    assert set(here.landmarks) == {"cam_0", "cam_2", "cam_3"}
    assert "Moved since the object was learned: cam_1," in here.note
    other = transfer_object(
        known, Rig([replace(c, name=n) for c, n in zip(RIG.cameras, "ab", strict=False)], "m"), TrackingOptions()
    )
    assert other.is_other_rig
    assert "Other cameras learned the object" in other.note
    # A camera gets the landmarks that another one saw from that direction.
    for k, keyframe in enumerate(other.keyframes):
        (camera,) = [name for name, memory in other.landmarks.items() if len(memory.features[k])]
        features, places = other.landmarks[camera].features[k], other.landmarks[camera].select_keyframe(k).mean
        pixels = RIG["cam_0" if camera == "a" else "cam_1"].project(keyframe.world_from_object.apply(places))
        assert np.median(np.linalg.norm(pixels - features.pixels, axis=1)) < 0.5


OTHERS = arc(3, 50, 1.8, 650, (640, 480), height=0.15)


@pytest.mark.parametrize(
    ("names", "smooth"),
    [
        pytest.param(("cam_0", "cam_1", "cam_2"), False, id="three-tracked", marks=pytest.mark.slow),
        pytest.param(("cam_0", "cam_1", "cam_2"), True, id="three-smoothed"),
        pytest.param(("cam_1",), False, id="one-tracked"),
        pytest.param(("cam_1",), True, id="one-smoothed", marks=pytest.mark.slow),
    ],
)
def test_known_object_transfers_to_other_rig(
    tmp_path: Path, known: KnownObject, actor_from_object: RigidTransform, names: tuple[str, ...], smooth: bool
) -> None:
    """Track with three other cameras, or one of them, in the same object frame and with consistent uncertainty."""
    rig = OTHERS.subset(names)
    take = write_box_recording(tmp_path / "take", moved_path, NEXT, seed=5, rig=rig)
    run = track_session(open_session(take), options=RunOptions(overlay=False, smooth=smooth, known=known))
    assert run.problems == (transfer_object(known, rig, TrackingOptions()).note,)
    assert run.trajectory.unit == "m"
    assert all(pose.is_measured and pose.observability is Observability.ALL for pose in run.trajectory)
    wrong = np.array([compute_pose_error(pose, moved_path(pose.index) * actor_from_object) for pose in run.trajectory])
    several = len(names) > 1
    assert np.degrees(np.linalg.norm(wrong[:, :3], axis=1)).max() < (0.8 if several else 2.0)
    assert np.linalg.norm(wrong[:, 3:], axis=1).max() < (0.002 if several else 0.01)
    squares = [e @ np.linalg.solve(pose.covariance, e) / 6 for e, pose in zip(wrong, run.trajectory, strict=True)]
    assert 0.001 < np.mean(squares) < 2.0
    assert 0.2 < max(np.degrees(pose.sigma[:3]).max() for pose in run.trajectory) < 2.5
    if several and smooth:
        more = load_object(take / "sylpose" / OBJECT_FILE)
        assert more.fingerprint == known.fingerprint
        assert more.rig.names == names
        assert any(k.is_fixed for k in more._keyframes)
        with pytest.raises(ValueError, match="refine_calibration: object was learned with another rig"):
            track_session(open_session(take), options=RunOptions(overlay=False, refine_calibration=True, known=known))


@pytest.mark.slow
def test_recalibrated_cameras_increase_uncertainty(
    tmp_path: Path, known: KnownObject, actor_from_object: RigidTransform
) -> None:
    """Change the calibration by hundredths of a degree: the uncertainty grows as much as the errors."""
    take = write_box_recording(tmp_path / "take", moved_path, 6, seed=5)
    rng = np.random.default_rng(1)
    turns = [Rotation.from_rotvec(0.0012 * rng.normal(size=3)) for _ in RIG]
    cameras = [
        replace(c, camera_from_world=RigidTransform.from_rotation(t) * c.camera_from_world)
        for c, t in zip(RIG.cameras, turns, strict=True)
    ]
    calibration.save(Rig(cameras, "m"), tmp_path / "rig.toml")
    session = open_session(take, calibration=tmp_path / "rig.toml")
    same = track_session(open_session(take), tmp_path / "same", RunOptions(overlay=False, smooth=True, known=known))
    usual = np.mean([pose.sigma[:3].min() for pose in same.trajectory])
    for smooth in (False, True):
        run = track_session(session, tmp_path / "out", RunOptions(overlay=False, smooth=smooth, known=known))
        wrong = [compute_pose_error(pose, moved_path(pose.index) * actor_from_object) for pose in run.trajectory]
        squares = [e @ np.linalg.solve(p.covariance, e) / 6 for e, p in zip(wrong, run.trajectory, strict=True)]
        assert 0.02 < np.mean(squares) < 3.0
        assert min(np.degrees(pose.sigma[:3]).min() for pose in run.trajectory) > 0.2
        # The landmarks' information depends on the machine's rounding, so compare a ratio, which is 1.5 to 2.1 over the
        # seeds.
        assert 1.25 < np.mean([pose.sigma[:3].min() for pose in run.trajectory]) / usual < 4.0


def test_options_excluding_known_object(known: KnownObject, first: Path) -> None:
    boxes = open_session(first).boxes
    assert boxes
    with pytest.raises(ValueError, match="boxes: not allowed for a known object"):
        Tracker(RIG, boxes, known_object=known)
    with pytest.raises(ValueError, match="method: a known object needs 'landmarks', got 'epipolar'"):
        Tracker(RIG, method="epipolar", known_object=known)
    with pytest.raises(ValueError, match="distributed: nodes do not support known objects"):
        track_session(open_session(first), options=RunOptions(distributed="exact", known=known))
    with pytest.raises(ValueError, match="known: no object 'cup' in"):
        track_session(open_session(first), options=RunOptions(known={"cup": known}))


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ("nowhere.npz", "nowhere.npz: no such file; expected the object.npz of an earlier run"),
        ("calibration.toml", "calibration.toml: not a sylpose object file, or damaged"),
        ("cup=sylpose/object.npz", "cup=sylpose/object.npz: no such file"),
    ],
)
def test_invalid_object_files(
    said: str, words: str, first: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(first)
    before = {file: file.stat().st_mtime_ns for file in first.rglob("*")}
    assert main(["track", ".", "--object", said]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert err.count("\n") == 1
    assert {file: file.stat().st_mtime_ns for file in first.rglob("*")} == before


def test_duplicate_object_and_other_unit(first: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = str(first / "sylpose" / OBJECT_FILE)
    assert main(["track", str(first), "--out", str(tmp_path / "out"), "--object", file, "--object", file]) == 2
    assert capsys.readouterr().err == "sylpose: --object: given twice for object\n"
    calibration.save(Rig(RIG.cameras, "mm"), tmp_path / "rig.toml")
    arguments = ["track", str(first), "--out", str(tmp_path / "out"), "--object", file]
    assert main([*arguments, "--calibration", str(tmp_path / "rig.toml")]) == 2
    assert capsys.readouterr().err == f"sylpose: {file}: its lengths are in m, those of the calibration in mm\n"
    assert not (tmp_path / "out").exists()


def test_unwritable_point_cloud_is_reported(known: KnownObject, tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    with pytest.raises(OSError, match=r"cannot write .*taken: is a directory"):
        write_cloud(known, tmp_path / "taken")


def test_known_objects_are_assigned_by_name(first: Path, known: KnownObject) -> None:
    file, two = str(first / "sylpose" / OBJECT_FILE), ("mug", "tray")
    found = load_known_objects([f"tray={file}"], two, RIG)
    assert [*found] == ["tray"]
    np.testing.assert_array_equal(found["tray"].positions, known.positions)
    assert [*load_known_objects([f"mug={file}", f"tray={file}"], two, RIG)] == ["mug", "tray"]
    assert [*load_known_objects([f"cup={file}"], ("cup",), RIG)] == ["cup"]
    for message in (file, f"cup={file}"):
        with pytest.raises(ValueError, match=r"--object: expected NAME=FILE, for one of mug, tray, got"):
            load_known_objects([message], two, RIG)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as file:
        return {name: file[name] for name in file.files}


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("points", lambda a: np.asfortranarray(a)),
        ("points", lambda a: a.T),
        ("points", lambda a: a.astype("f4")),
        ("points", lambda a: np.full_like(a, np.nan)),
        ("keyframe_time", lambda a: a[::-1]),
        ("keyframe_world_from_object", lambda a: 2 * a),
        ("keyframe_world_from_object", lambda a: a + np.pad([[1e10]], ((0, 3), (3, 0)))),
        ("keyframe_world_from_object", lambda a: a * np.array([1, 1, -1, 1])[:, None]),
        ("keyframe_covariance", lambda a: a - np.eye(6)),
        ("landmark_information", lambda a: -a),
        ("landmark_camera", lambda a: a + 100),
        ("landmark_id", lambda a: a * 0),
        ("feature_keyframe", lambda a: a - 1),
        ("feature_landmark", lambda a: a + 10_000_000),
        ("feature_descriptor", lambda a: np.array([{"a": 1}] * len(a), object)),
        ("header", lambda _: np.array('{"format": "sylpose object 9"}')),
        ("header", lambda a: np.array(str(a).replace("sylpose object 1", "sylpose object 2"))),
        ("header", lambda a: np.array(re.sub(r'"radius":[^,]*', '"radius":-1', str(a)))),
        ("more", lambda _: np.zeros(3)),
    ],
)
def test_invalid_arrays_are_rejected(
    name: str, change: Callable[[np.ndarray], np.ndarray], first: Path, tmp_path: Path
) -> None:
    arrays = _arrays(first / "sylpose" / OBJECT_FILE)
    arrays[name] = change(arrays.get(name, np.zeros(0)))
    np.savez(tmp_path / "bad.npz", **arrays)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"bad\.npz: ") as caught:
        load_object(tmp_path / "bad.npz")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 600


def test_oversized_archive_is_rejected(tmp_path: Path, first: Path) -> None:
    arrays = _arrays(first / "sylpose" / OBJECT_FILE)
    arrays["points"] = np.zeros((23_000_000, 3))
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, values in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as out:
                np.lib.format.write_array(out, values, allow_pickle=False)
    with pytest.raises(ValueError, match="more than 512 MB"):
        load_object(tmp_path / "bomb.npz")


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, 1 << 30), byte=st.integers(1, 255), cut=st.booleans())
def test_damaged_object_files(first: Path, tmp_path: Path, at: int, byte: int, cut: bool) -> None:
    data = bytearray((first / "sylpose" / OBJECT_FILE).read_bytes())
    at %= len(data)
    if cut:
        del data[at:]
    else:
        data[at] ^= byte
    (tmp_path / "bad.npz").write_bytes(data)
    message = ""
    try:
        load_object(tmp_path / "bad.npz")  # changed dates in the archive are harmless
    except ValueError as error:
        message = str(error)
    assert not cut or message
    assert not message or message.startswith(f"{tmp_path / 'bad.npz'}: ")
    assert "\n" not in message


def _describe_error(file: Path, data: bytes) -> str:
    """Return the message about a file with this content, which must be one line; "" if it is read."""
    file.write_bytes(data)
    message = ""
    try:
        load_object(file)
    except ValueError as error:
        message = str(error)
    assert not message or message.startswith(f"{file}: ")
    assert message.isprintable()
    return message


@pytest.fixture(scope="module")
def small() -> bytes:
    """Return the file of a small object model."""
    return make_kinds()["object.npz"].samples[0]


def _replace_array(data: bytes, name: str, content: bytes) -> bytes:
    """Return an archive with another content of an array, and its checksum."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        contents = {other: archive.read(other) for other in archive.namelist()}
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w") as archive:
        for other, of in {**contents, f"{name}.npy": content}.items():
            archive.writestr(other, of)
    return whole.getvalue()


@pytest.mark.parametrize("how", ["flip", "cut", "replace"])
def test_each_region_of_the_file_is_damaged(small: bytes, tmp_path: Path, how: str) -> None:
    """Damage the file every few bytes: local headers, contents, directory and end of the archive."""
    rng, n_refused, positions = np.random.default_rng(0), 0, range(0, len(small), 19)
    for at in positions:
        data = bytearray(small)
        if how == "flip":
            data[at] ^= 1 << int(rng.integers(8))
        elif how == "cut":
            del data[at:]
        else:
            data[at : at + 16] = rng.bytes(len(data[at : at + 16]))
        n_refused += bool(_describe_error(tmp_path / "bad.npz", bytes(data)))
    # Dates, versions and comments may change.
    assert n_refused > {"flip": 0.7, "cut": 0.99, "replace": 0.95}[how] * len(positions)


@pytest.mark.parametrize(
    "name",
    ["header", *(pytest.param(n, marks=pytest.mark.slow) for n in ("points", "keyframe_stays", "feature_descriptor"))],
)
def test_damaged_array_headers_are_refused(small: bytes, tmp_path: Path, name: str) -> None:
    """Flip each bit of an array's header, with a valid checksum of the archive: type, shape and size must agree."""
    with zipfile.ZipFile(io.BytesIO(small)) as archive:
        content = archive.read(f"{name}.npy")
    assert content.startswith(b"\x93NUMPY")
    assert _describe_error(tmp_path / "bad.npz", _replace_array(small, name, content)) == ""
    used = content.index(b"}") + 1
    for bit in range(8 * used):
        at = bit // 8
        damaged = bytearray(content)
        damaged[at] ^= 1 << bit % 8
        message = _describe_error(tmp_path / "bad.npz", _replace_array(small, name, bytes(damaged)))
        assert message or 8 <= at < 10  # the length of the header, which ends with its line


def test_damaged_object_ends_a_command_with_one_line(
    first: Path, small: bytes, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with zipfile.ZipFile(io.BytesIO(small)) as archive:
        content = archive.read("points.npy")
    file = tmp_path / "bad.npz"
    for damaged in (content.replace(b"'<f8'", b"'<f8"), content.replace(b"(4, 3)", b"(4, 3"), b"\x92" + content[1:]):
        file.write_bytes(_replace_array(small, "points", damaged))
        assert main(["track", str(first), "--out", str(tmp_path / "out"), "--object", str(file)]) == 2
        err = capsys.readouterr().err
        assert err.startswith(f"sylpose: {file}: not a sylpose object file, or damaged (an array with")
        assert err.count("\n") == 1


def test_small_files_do_not_unpack_to_much(small: bytes, tmp_path: Path) -> None:
    """Announce fewer bytes than the archive unpacks to, and more elements than it has."""
    bomb = _replace_array(small, "points", bytes(1000))
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("points.npy", bytes(100_000_000))
    data = bytearray((tmp_path / "bomb.npz").read_bytes())
    sizes = [at for at in range(len(data) - 3) if data[at : at + 4] == (100_000_000).to_bytes(4, "little")]
    for at in sizes:
        data[at : at + 4] = (1000).to_bytes(4, "little")
    tracemalloc.start()
    assert "damaged" in _describe_error(tmp_path / "bomb.npz", bytes(data))
    huge = b"\x93NUMPY\x01\x00v\x00{'descr': '<f8', 'fortran_order': False, 'shape': (9999999999, 3), }   \n"
    assert "disagree" in _describe_error(tmp_path / "bomb.npz", _replace_array(bomb, "points", huge))
    assert tracemalloc.get_traced_memory()[1] < 20_000_000
    tracemalloc.stop()
