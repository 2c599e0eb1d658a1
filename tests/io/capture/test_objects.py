"""Sessions of several objects: boxes and masks by object name."""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from sylpose.frames import Box, FrameSet
from sylpose.geometry.arrays import BoolArray
from sylpose.io import calibration
from sylpose.io.capture import Session, open_session
from sylpose.io.capture.boxes import DEFAULT_OBJECT_NAME, load_boxes
from sylpose.rig import Camera, Rig

SIZE = (64, 48)
FRAMES = 3
BOXES = "[mug]\ncam_0 = [1, 2, 3, 4]\n[tray]\ncam_1 = [5, 6, 7, 8]\n0 = [9, 10, 11, 12]\n"
MUG, TRAY = slice(0, 10), slice(20, 40)  # image columns of the objects


def make_rig(n: int = 2) -> Rig:
    matrix = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    return Rig([Camera(f"cam_{c}", SIZE, matrix, np.zeros(5), RigidTransform.identity()) for c in range(n)])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A session of two cameras with three images each, without boxes and masks."""
    calibration.save(make_rig(), tmp_path / "calibration.toml")
    for c in range(2):
        (tmp_path / f"cam_{c}").mkdir()
        for k in range(FRAMES):
            cv2.imwrite(str(tmp_path / f"cam_{c}" / f"{k:04d}.png"), np.full(SIZE[::-1], 100, np.uint8))
    return tmp_path


def open_folder(folder: Path) -> Session:
    return open_session(folder, calibration=folder / "calibration.toml")


def write_mask(path: Path, columns: slice = MUG, size: tuple[int, int] = SIZE) -> None:
    image = np.zeros(size[::-1], np.uint8)
    image[:, columns] = 255
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def mask_columns(found: BoolArray | None) -> list[int] | None:
    return None if found is None else np.flatnonzero(found.any(axis=0)).tolist()


def object_columns(name: str, frames: FrameSet) -> list[list[int] | None]:
    return [mask_columns(m) for m in frames.for_object(name).masks]


# One object


def test_one_object_without_boxes_and_masks(folder: Path) -> None:
    session = open_folder(folder)
    assert session.objects == (DEFAULT_OBJECT_NAME,)
    assert session.boxes == {}
    assert session.select_object(DEFAULT_OBJECT_NAME).boxes == {}
    frames = next(session.frames())
    assert frames.masks == (None, None)
    assert frames.object_masks == {}
    assert frames.for_object(DEFAULT_OBJECT_NAME) is frames


@pytest.mark.parametrize("named", [False, True])
def test_one_object_with_or_without_name(folder: Path, named: bool) -> None:
    (folder / "boxes.toml").write_text("[mug]\n" * named + "cam_1 = [1, 2, 3, 4]\n")
    write_mask(folder / "masks" / ("mug" if named else "") / "cam_0.png")
    session = open_folder(folder)
    assert session.objects == (("mug",) if named else (DEFAULT_OBJECT_NAME,))
    assert session.boxes == {"cam_1": Box(1, 2, 3, 4)}
    frames = next(session.frames())
    assert frames.object_masks == {}
    assert [mask_columns(m) for m in frames.masks] == [list(range(10)), None]
    assert frames.for_object(session.objects[0]) is frames


def test_unnamed_object_has_default_name(folder: Path) -> None:
    (folder / "boxes.toml").write_text(f"[{DEFAULT_OBJECT_NAME}]\ncam_1 = [1, 2, 3, 4]\n")
    write_mask(folder / "masks" / "cam_0.png")
    assert open_folder(folder).objects == (DEFAULT_OBJECT_NAME,)


# Several objects


def test_boxes_of_several_objects(folder: Path) -> None:
    (folder / "boxes.toml").write_text(BOXES)
    session = open_folder(folder)
    assert session.objects == ("mug", "tray")
    assert session.select_object("mug").objects == ("mug",)
    assert session.select_object("mug").boxes == {"cam_0": Box(1, 2, 3, 4)}
    assert list(session.select_object("tray").boxes.items()) == [
        ("cam_0", Box(9, 10, 11, 12)),
        ("cam_1", Box(5, 6, 7, 8)),
    ]
    with pytest.raises(ValueError, match=r"several objects \(mug, tray\)"):
        _ = session.boxes
    with pytest.raises(ValueError, match=r"no object 'cup' in the session \(mug, tray\)"):
        session.select_object("cup")
    frames = next(session.frames())
    assert frames.masks == (None, None)
    assert frames.for_object("mug") is frames


def test_masks_of_several_objects(folder: Path) -> None:
    write_mask(folder / "masks" / "tray" / "cam_0.png", TRAY)
    write_mask(folder / "masks" / "mug" / "Cam0.png", MUG)
    for k in (0, 2):
        write_mask(folder / "masks" / "mug" / "1" / f"{k}.png", slice(k + 1, k + 3))
    session = open_folder(folder)
    assert session.objects == ("mug", "tray")
    assert session.select_object("tray").boxes == {}
    frame_sets = list(session.frames())
    both = [*range(10), *range(20, 40)]
    assert [object_columns("mug", f) for f in frame_sets] == [[list(range(10)), m] for m in ([1, 2], None, [3, 4])]
    assert [object_columns("tray", f) for f in frame_sets] == [[list(range(20, 40)), None]] * FRAMES
    # The union of the masks is known if each object has one.
    assert [[mask_columns(m) for m in f.masks] for f in frame_sets] == [[both, None]] * FRAMES
    assert frame_sets[0].for_object("mug").images is frame_sets[0].images
    with pytest.raises(ValueError, match=r"no object 'cup' in the frame set \(mug, tray\)"):
        frame_sets[0].for_object("cup")


def test_session_of_one_object_yields_its_masks(folder: Path) -> None:
    (folder / "boxes.toml").write_text("[tray]\ncam_0 = [5, 6, 7, 8]\n[mug]\ncam_0 = [1, 2, 3, 4]\n")
    for c in range(2):
        write_mask(folder / "masks" / "mug" / f"cam_{c}.png", MUG)
        write_mask(folder / "masks" / "tray" / f"cam_{c}.png", TRAY)
    session = open_folder(folder)
    assert session.objects == ("tray", "mug")  # in the order of the boxes
    whole = list(session.frames())
    for name in session.objects:
        for frames, one in zip(whole, session.select_object(name).frames(), strict=True):
            assert one.object_masks == {}
            assert object_columns(name, frames) == object_columns(name, one) == [mask_columns(m) for m in one.masks]


def test_missing_image_has_no_masks(folder: Path) -> None:
    for name, where in (("mug", MUG), ("tray", TRAY)):
        write_mask(folder / "masks" / name / "cam_1.png", where)
    (folder / "cam_1" / "0001.png").write_bytes(b"no image")
    frame_sets = list(open_folder(folder).frames(on_problem=lambda _: None))
    assert [object_columns("tray", f)[1] is None for f in frame_sets] == [False, True, False]
    assert [f.masks[1] is None for f in frame_sets] == [False, True, False]


def test_unreadable_mask_affects_only_its_object(folder: Path) -> None:
    write_mask(folder / "masks" / "mug" / "cam_0.png", MUG)
    write_mask(folder / "masks" / "tray" / "cam_0" / "0.png", TRAY)
    write_mask(folder / "masks" / "tray" / "cam_0" / "1.png", TRAY, (80, 48))
    problems: list[str] = []
    frames = list(open_folder(folder).frames(on_problem=problems.append))[1]
    assert object_columns("mug", frames)[0] == list(range(10))
    assert object_columns("tray", frames)[0] is None
    assert frames.masks[0] is None
    assert len(problems) == 1
    assert "tray" in problems[0]


def test_object_may_appear_later(folder: Path) -> None:
    write_mask(folder / "masks" / "mug" / "cam_0.png", MUG)
    for k in range(FRAMES):
        write_mask(folder / "masks" / "tray" / "cam_0" / f"{k}.png", TRAY if k == 2 else slice(0))
    assert [object_columns("tray", f)[0] for f in open_folder(folder).frames()] == [[], [], list(range(20, 40))]


def test_manually_built_frame_sets() -> None:
    white, black = np.ones((2, 2), bool), np.zeros((2, 2), bool)
    images = (np.zeros((2, 2, 3), np.uint8),)
    plain = FrameSet(0, 0.0, (None,), images, (white,))
    assert plain.for_object("anything") is plain
    frames = FrameSet(0, 0.0, (None,), images, (white,), {"a": (white,), "b": (black,)})
    assert frames.for_object("b").masks == (black,)
    assert frames.for_object("b").for_object("b").masks == (black,)


names = st.text("abcXYZ019_-", max_size=12).map(lambda name: f"x{name}")  # never a camera name
boxes = st.tuples(st.integers(0, 30), st.floats(0, 20, allow_subnormal=False), st.integers(1, 30), st.floats(0.125, 20))
tables = st.dictionaries(st.sampled_from([f"cam_{c}" for c in range(4)]), boxes, min_size=1)


@given(st.dictionaries(names, tables, min_size=1, max_size=4).filter(lambda d: len({n.lower() for n in d}) == len(d)))
def test_boxes_round_trip(objects: dict[str, dict[str, tuple[float, float, float, float]]]) -> None:
    lines = []
    for name, table in objects.items():
        lines += [f'["{name}"]', *(f"{camera} = {list(box)}" for camera, box in table.items())]
    with tempfile.TemporaryDirectory() as where:
        path = Path(where) / "boxes.toml"
        path.write_text("\n".join(lines))
        read = load_boxes(path, make_rig(4))
    assert list(read) == list(objects)
    for name, table in objects.items():
        assert list(read[name]) == sorted(table)
        for camera, box in table.items():
            found = read[name][camera]
            assert (found.x, found.y, found.width, found.height) == pytest.approx(box, abs=1e-12)


# Bad input


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("cam_0 = [1, 2, 3, 4]\n[mug]\ncam_0 = [1, 2, 3, 4]", "cam_0 is outside the tables of mug"),
        ("title = 'two'\n[mug]\ncam_0 = [1, 2, 3, 4]", "title is outside"),
        ("[mug]\n[tray]\ncam_0 = [1, 2, 3, 4]", r"\[mug\] has no box in any camera"),
        ("[mug]\ncam_7 = [1, 2, 3, 4]", r"\[mug\]: cam_7 is not a camera of the calibration"),
        ("[mug]\ncam_0 = [1, 2, 3, 4]\n[tray]\ncam_1 = [1, 2, 3]", r"\[tray\]: cam_1 = \[x, y, width, height\]"),
        ("[mug]\ncam_1 = [1, 2, 0, 4]", r"\[mug\]: the box of cam_1 must be finite"),
        ("[mug]\ncam_1 = [60, 2, 20, 4]", r"\[mug\]: the box of cam_1 \[60, 2, 20, 4\] is not inside"),
        ("[mug.left]\ncam_1 = [1, 2, 3, 4]", r"\[mug\]: left is not a camera"),
        ('[""]\ncam_0 = [1, 2, 3, 4]', "letters, digits, - and _, got ''"),
        ('["a/b"]\ncam_0 = [1, 2, 3, 4]', "got 'a/b'"),
        ('["Tasse groß"]\ncam_0 = [1, 2, 3, 4]', "got 'Tasse groß'"),
        ('["mug\\n"]\ncam_0 = [1, 2, 3, 4]', "letters, digits"),
        ("[mug]\ncam_0 = [1, 2, 3, 4]\n[Mug]\ncam_0 = [1, 2, 3, 4]", "mug and Mug differ in case only"),
        ("[mug]\ncam_0 = [1, 2, 3, 4]\n[mug]\ncam_1 = [1, 2, 3, 4]", "not valid TOML"),
        ("[cam_0]\ncam_0 = [1, 2, 3, 4]", "the object cam_0 has a camera's name"),
        ("[1]\ncam_0 = [1, 2, 3, 4]", "the object 1 has a camera's name"),
        ("cam_0 = 7", r"boxes\.toml: cam_0 = \[x, y, width, height\] is expected"),
    ],
)
def test_invalid_boxes_are_rejected(folder: Path, text: str, match: str) -> None:
    (folder / "boxes.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=match) as caught:
        open_folder(folder)
    assert str(caught.value).startswith(str(folder / "boxes.toml"))
    assert str(caught.value).count("\n") == 0


@pytest.mark.parametrize(
    ("files", "match"),
    [
        (["cam_0.png", "mug/cam_1.png"], r"mug is not a camera .* and cam_0\.png is not an object folder"),
        (["cam_0/0000.png", "mug/cam_1.png"], "mug is not a camera .* and cam_0 is not an object folder"),
        (["cup.png", "mug/cam_1.png"], "cup, mug is not a camera"),
        (["mug/cam_1.png", "tray/cam_4.png"], "tray: cam_4 is not a camera"),
        (["mug/cam_1.png", "tray/notes.txt"], "tray: contains no masks"),
        (["mug/cam_1.png", "Mug/cam_0.png"], "differ in case only"),
        (["my mug/cam_1.png"], "letters, digits, - and _, got 'my mug'"),
        (["mug/cam_1/0000.png", "mug/1.jpg"], "mug: neither a camera .* not 1.jpg"),
        (["mug/cam_1/0000.png", "mug/cam_1.jpg"], r"cam_1 and cam_1\.jpg are both for camera cam_1"),
        (["mug/cam_1/first.png"], "cam_1: masks with frame numbers"),
        # A misnamed camera folder, or one whose frame numbers match cameras.
        (["cam_8/0000.png"], r"cam_8: neither a camera .* nor an object, .* not 0000\.png"),
        (["cam_8/0000.png", "cam_0/0000.png"], "cam_8 is not a camera .* and cam_0 is not an object folder"),
        # Object folders whose names match cameras.
        (["0/cam_0.png", "1/cam_0.png"], r"0: named like camera cam_0, but contains cam_0\.png"),
        (["1/cam_0/0000.png"], "1: named like camera cam_1, but contains cam_0"),
    ],
)
def test_invalid_mask_folders_are_rejected(folder: Path, files: list[str], match: str) -> None:
    for file in files:
        if file.endswith(".txt"):
            (folder / "masks" / file).parent.mkdir(parents=True)
            (folder / "masks" / file).touch()
        else:
            write_mask(folder / "masks" / file)
    if "Mug/cam_0.png" in files and len(list((folder / "masks").iterdir())) == 1:
        pytest.skip("this file system does not tell capital from small letters")
    with pytest.raises(ValueError, match=match) as caught:
        open_folder(folder)
    assert str(caught.value).startswith(str(folder / "masks"))


def test_object_with_only_empty_masks_is_rejected(folder: Path) -> None:
    write_mask(folder / "masks" / "mug" / "cam_0.png")
    write_mask(folder / "masks" / "tray" / "cam_0.png", slice(0))
    with pytest.raises(ValueError, match=r"cam_0\.png: the mask is empty"):
        open_folder(folder)
    (folder / "masks" / "tray" / "cam_0.png").unlink()
    for k in range(FRAMES):
        write_mask(folder / "masks" / "tray" / "cam_0" / f"{k}.png", slice(0))
    with pytest.raises(
        ValueError, match=r"tray/cam_0/0\.png: this and all later masks are empty; the object must be white"
    ):
        open_folder(folder)


@pytest.mark.parametrize(
    ("text", "files", "match"),
    [
        (BOXES, ["mug/cam_0.png"], r"boxes\.toml has boxes of mug, tray, but .*masks has masks of mug:"),
        (BOXES, ["mug/cam_0.png", "box/cam_0.png"], "boxes of mug, tray, but .* masks of box, mug:"),
        (BOXES, ["cam_0.png"], "boxes of mug, tray, but .* masks of object:"),
        ("cam_0 = [1, 2, 3, 4]", ["mug/cam_0.png"], "boxes of object, but .* masks of mug:"),
    ],
)
def test_boxes_and_masks_of_different_objects_are_rejected(
    folder: Path, text: str, files: list[str], match: str
) -> None:
    (folder / "boxes.toml").write_text(text)
    for file in files:
        write_mask(folder / "masks" / file)
    with pytest.raises(ValueError, match=match):
        open_folder(folder)
