"""Discovery of recordings, their names, and the inputs of their digests."""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
import pytest

from sylpose.archive.recordings import Recording, TrackingOptions, find_recordings
from sylpose.io.stores import ObjectStore, Store, is_url, open_store, resolve_location


def archive(folder: Path, *files: str) -> Path:
    for file in files:
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(file)
    return folder


LAB = (
    "day1/a/calibration.toml",
    "day1/a/cam_0.mp4",
    "day1/a/cam_1.mp4",
    "day1/a/sylpose/overlay.mp4",
    "day1/a/masks/cam_0/1.png",
    "day1/b/rig.yml",
    "day1/b/cam_0/0001.png",
    "day1/b/cam_1/0001.png",
    "day1/b/boxes.toml",
    "day2/calibration.toml",
    "day2/video/c.avi",
    "notes/overlay.mp4",
    "notes/photo.jpg",
    ".trash/x/calibration.toml",
    ".trash/x/cam_0.mp4",
)


def by_name(*sources: object, calibration: str | None = None, out: Store | None = None) -> dict[str, Recording]:
    found, _ = find_recordings([str(source) for source in sources], TrackingOptions(), calibration, out)
    return {recording.name: recording for recording in found}


def in_memory(name: str, folder: Path) -> str:
    """Copy the folder's files to an in-memory object store."""
    pytest.importorskip("obstore", reason="the extra `archive`")
    store = open_store(f"memory://{name}/archive")
    for path in folder.rglob("*"):
        if path.is_file():
            store.write(path.relative_to(folder).as_posix(), path)
    return store.url


@pytest.mark.parametrize("where", ["folder", "memory"])
def test_recordings_are_found_below_source(tmp_path: Path, where: str) -> None:
    lab = str(archive(tmp_path / "lab", *LAB))
    lab = lab if where == "folder" else in_memory("found", Path(lab))
    found, remarks = find_recordings([lab], TrackingOptions())
    assert {r.name: r.path for r in found} == {"day1/a": f"{lab}/day1/a", "day1/b": f"{lab}/day1/b"}
    assert remarks == [f"{lab}: skipped without a calibration: day2/video."]


def test_single_recording_name_and_shared_calibration(tmp_path: Path) -> None:
    lab = archive(tmp_path / "lab", *LAB)
    assert list(by_name(lab / "day1/a")) == ["a"]
    assert list(by_name(lab / "day1")) == ["a", "b"]
    found = by_name(lab / "day1", lab / "day2", calibration=str(lab / "day2/calibration.toml"))
    assert found["a"].calibration is None
    assert found["video"].calibration == str(lab / "day2/calibration.toml")
    assert set(by_name(lab, calibration=str(lab / "day2/calibration.toml"))) == {"day1/a", "day1/b", "day2/video"}


def test_digests_depend_on_inputs(tmp_path: Path) -> None:
    lab = archive(tmp_path / "lab", *LAB)
    rig = lab / "day2/calibration.toml"
    before = by_name(lab / "day1", lab / "day2", calibration=str(rig))
    archive(lab, "day1/a/sylpose/trajectory.csv")  # written by sylpose
    assert by_name(lab / "day1", lab / "day2", calibration=str(rig)) == before
    os.utime(lab / "day1/a/cam_0.mp4", ns=(1, 1))
    rig.write_text("moved")
    after = by_name(lab / "day1", lab / "day2", calibration=str(rig))
    assert {name for name in before if before[name].digest != after[name].digest} == {"a", "video"}


def test_digests_depend_on_world_file(tmp_path: Path) -> None:
    lab, world = archive(tmp_path / "lab", *LAB, "floor.toml"), tmp_path / "lab" / "floor.toml"
    (tmp_path / "lab" / "list.csv").write_text("path,world\nday1/a,floor.toml\nday1/b,up=-y\n")
    digests = []
    for content in ("up", "down"):
        world.write_text(content)
        given = find_recordings([str(lab / "day1")], TrackingOptions(world=str(world)))[0]
        listed = by_name(lab / "list.csv")
        assert [r.world for r in given] == [str(world)] * 2
        assert [r.world for r in listed.values()] == [str(world), "up=-y"]
        digests.append([r.digest for r in (*given, *listed.values())])
    changed = [a != b for a, b in zip(*digests, strict=True)]
    assert changed == [True, True, True, False]
    words = find_recordings([str(lab / "day1")], TrackingOptions(world="up=-y"))[0]
    assert words[0].digest != by_name(lab / "day1")["a"].digest
    with pytest.raises(FileNotFoundError, match=r"nothing\.toml: no such file \(world\)"):
        find_recordings([str(lab / "day1")], TrackingOptions(world="nothing.toml"))


def test_results_within_archive_are_not_searched(tmp_path: Path) -> None:
    lab = archive(tmp_path / "lab", *LAB, "results/day1/a/calibration.refined.toml", "results/day1/a/cam.mp4")
    assert set(by_name(lab, out=open_store(lab / "results"))) == {"day1/a", "day1/b"}
    with pytest.raises(ValueError, match="would be in the folder of its videos"):
        by_name(lab, out=open_store(lab))


MANIFEST = """
[[recording]]
path = "day1/a"
start = 3

[[recording]]
path = "day2/video"
name = "second/c"
calibration = "day2/calibration.toml"
method = "epipolar"
smooth = false
"""
TABLE = (
    "path,name,calibration,start,method,smooth\nday1/a,,,3,,\nday2/video,second/c,day2/calibration.toml,,epipolar,0\n"
)


@pytest.mark.parametrize(("name", "content"), [("list.toml", MANIFEST), ("list.csv", TABLE)])
@pytest.mark.parametrize("where", ["folder", "memory"])
def test_manifest_with_individual_options(tmp_path: Path, name: str, content: str, where: str) -> None:
    folder = archive(tmp_path / "lab", *LAB)
    (folder / name).write_text(content)
    lab = str(folder) if where == "folder" else in_memory(f"manifest-{name}", folder)
    found = by_name(f"{lab}/{name}")
    assert list(found) == ["day1/a", "second/c"]
    first, second = found.values()
    assert first.options == msgspec.structs.asdict(TrackingOptions(start=3))
    assert second.options == msgspec.structs.asdict(TrackingOptions(method="epipolar", smooth=False))
    assert second.calibration == f"{lab}/day2/calibration.toml"
    assert first.digest != by_name(lab)["day1/a"].digest


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        (
            "m.toml",
            '[[recording]]\npath = "day1/a"\nstart = "x"',
            "recording 1: start: expected `int`, got `str`",
        ),
        ("m.csv", "path,start\nday1/a,1\nday1/b,x\n", "recording 2: start: expected `int`, got `str`"),
        (
            "m.csv",
            "path,strat\nday1/a,1\n",
            "recording 1: unknown field `strat`; columns are path, name",
        ),
        ("m.csv", "name\na\n", "recording 1: object missing required field `path`"),
        ("m.csv", "path\nday1/a,7\n", "unknown field `more cells than the header has`"),
        ("m.toml", "recording = 3", "expected `array`, got `int`"),
        ("m.toml", "[[recording]\n", "columns are"),
        ("m.csv", "path\n", "no recording in it"),
        ("m.csv", "path\nday1/x\n", "day1/x: no such folder"),
        ("m.csv", "path,boxes\nday1/a,b.toml\n", "b.toml: no such file (boxes)"),
        ("m.csv", "path,method\nday1/a,magic\n", "magic"),
        ("m.csv", "path\nday1/a\nday1/a\n", "would both be named"),
        ("m.csv", "path,name\nday1/a,x\nday1/b,x/y\n", "recording x/y would be inside the results of x"),
    ],
)
def test_invalid_manifests_raise_one_sentence(tmp_path: Path, name: str, content: str, said: str) -> None:
    lab = archive(tmp_path / "lab", *LAB)
    (lab / name).write_text(content)
    with pytest.raises((ValueError, FileNotFoundError)) as error:
        by_name(lab / name)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("sources", "said"),
    [
        (["nothing"], "no such folder"),
        (["none.toml"], "no such manifest"),
        (["lab/notes"], "no recording in it (a folder with videos or images and a calibration)"),
        (["uncalibrated"], "but video without a calibration: set one with --calibration"),
        (["lab/day1", "other"], "use their common parent folder"),
        (["gopher://x/y"], "gopher://x/y: "),
    ],
)
def test_invalid_sources_raise_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sources: list[str], said: str
) -> None:
    archive(tmp_path / "lab", *LAB)
    archive(tmp_path / "other/a", "calibration.toml", "cam_0.mp4")
    archive(tmp_path / "uncalibrated", "video/c.avi")
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ValueError, FileNotFoundError)) as error:
        by_name(*sources)
    assert said in str(error.value)


def test_circular_links_terminate(tmp_path: Path) -> None:
    lab = archive(tmp_path / "lab", *LAB)
    (lab / "day1/again").symlink_to(lab)
    (lab / "linked").symlink_to(archive(tmp_path / "elsewhere", "calibration.toml", "cam_0.mp4"))
    assert {"day1/a", "day1/b", "linked"} <= set(by_name(lab))


def test_places() -> None:
    pytest.importorskip("obstore", reason="the extra `archive`")
    assert is_url("s3://bucket/x")
    assert not is_url("C:\\recordings")
    assert open_store("file:///data/x") == open_store("/data/x")
    assert resolve_location("../x", open_store("/data/y")).url == "/data/x"
    assert resolve_location("x", open_store("memory://a/b/")).url == "memory://a/b/x"
    assert resolve_location("../x", open_store("memory://a/b/")).url == "memory://a/x"
    assert resolve_location("../../../x", open_store("memory://a/b")).url == "memory://a/x"  # the same bucket
    assert resolve_location("s3://bucket/x", open_store("/data")).url == "s3://bucket/x"
    assert isinstance(open_store("s3://bucket/x"), ObjectStore)
