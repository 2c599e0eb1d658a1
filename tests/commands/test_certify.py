"""`sylpose certify` as typed: its files, its output and wrong input; sessions of some cameras and reversed ones."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sylpose.commands.main import main
from sylpose.frames import Box, FrameSet
from sylpose.io.capture import Session, open_session
from sylpose.io.capture import session as sessions
from sylpose.io.capture.session import ReversedSession
from sylpose.runs import certify
from sylpose.runs.certificate_page import CERTIFICATE_FILES
from sylpose.runs.options import RunOptions
from sylpose.runs.run_result import Run
from sylpose.simulate.recordings import write_boxes
from tests.runs.test_certify import SDS, make_result

pytestmark = pytest.mark.usefixtures("undrawn")


def run(*args: object) -> int:
    return main(["certify", *map(str, args)])


def test_certificate_of_a_recording(
    session: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three cameras: every pair against all, and backwards from boxes in the last frame."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert run(session, "--stop", 10, "--unit", "mm") == 0
    out = capsys.readouterr().out
    assert "Not seen by these tests: errors that all cameras share" in out
    folder = session / "sylpose"
    assert {file.name for file in folder.iterdir()} == {*CERTIFICATE_FILES}
    assert not list(tmp_path.glob("sylpose-certify-*"))
    (found,) = json.loads((folder / CERTIFICATE_FILES[1]).read_text(encoding="utf-8"))["objects"]
    assert (found["frames"], found["measured"], found["unit"]) == (10, 10, "mm")
    kinds = [(test["kind"], test["coverage"]) for test in found["tests"]]
    assert kinds == [("part", 1.0)] * 3 + [("split", 1.0)] * 3 + [("direction", 1.0)]
    # The truth of such a recording is met to 0.3 degrees and 1 mm, also by each pair of cameras.
    for quantity, limit in (("rotation_deg", 0.3), ("position", 1.0)):
        estimate = found[quantity]
        assert 0 < estimate["error"] < limit
        assert estimate["error"] < estimate["bound_95"]
        assert estimate["factor_95"][0] < estimate["factor"] < estimate["factor_95"][1]
        assert not estimate["is_lower_bound"]
    assert "The motion since the first frame is accurate to" in (folder / CERTIFICATE_FILES[0]).read_text(
        encoding="utf-8"
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--bar", "left"], "--bar: the names of two objects are expected, such as left,right, got 'left'"),
        (["--bar", "left,right"], "--bar: two different objects of {} are expected (object), got left and right"),
        (["--start", "99"], "--start must be in 0 ... 11"),
        (["--boxes", "none.toml"], "none.toml"),
        (["--out", "{}"], "this is the recording's folder"),
        (["--object", "1"], "object 1: boxes or masks select the object; omit the number"),
        (["--seed", "-1"], "--seed must not be negative"),
    ],
)
def test_wrong_input_is_one_sentence(
    recording: Path, options: Sequence[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(recording, *(text.format(recording) for text in options)) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message.format(recording) in line
    assert not (recording / "sylpose").exists()


def test_parts_that_cannot_be_tracked_give_their_reason(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All cameras are tracked; parts have no boxes, or rays that do not meet."""
    opened = open_session(session)
    one_box = replace(opened, _boxes={"object": {"cam_0": opened.boxes["cam_0"]}})
    result = make_result(np.zeros((8, 6)), SDS, opened.rig.names)

    def track(of: Session, *_: object, **__: object) -> Run:
        if len(of.rig) < 3 or isinstance(of, ReversedSession):
            raise ValueError("boxes: the rays do not meet")
        return Run({"object": result}, (), (), {})

    monkeypatch.setattr(certify, "track_session", track)
    (certificate,) = certify.certify_session(one_box).objects
    assert [*certificate.remarks] == [
        "cam_0, cam_1: boxes: the rays do not meet.",
        "cam_0, cam_2: boxes: the rays do not meet.",
        "cam_1, cam_2: no box of the object in these cameras.",
        "backwards: boxes: the rays do not meet.",
    ]
    assert certificate.rotation is certificate.position is None


def test_all_parts_follow_the_selected_body(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its number is that of all cameras: parts of them have boxes about its first pose, reversed runs about its last."""
    unboxed = replace(open_session(session), _boxes={})
    result = make_result(np.zeros((8, 6)), SDS, unboxed.rig.names)
    runs = list[tuple[tuple[str, ...], set[str], int | None, int]]()

    def track(of: Session, _: Path, options: RunOptions, **__: object) -> Run:
        runs.append((of.rig.names, {*of.boxes}, options.candidate, options.start))
        return Run({"object": result}, (), (), {})

    monkeypatch.setattr(certify, "track_session", track)
    monkeypatch.setattr(certify, "bound_sphere", lambda rig, *_: dict.fromkeys(rig.names, Box(9, 9, 9, 9)))
    certify.certify_session(unboxed, candidate=2)
    names = unboxed.rig.names
    assert runs[0] == (names, set(), 2, 0)
    assert len(runs) == 5
    assert all(boxes == {*cameras} and candidate is None for cameras, boxes, candidate, _ in runs[1:])
    assert [start for *_, start in runs] == [0] * 4 + [unboxed.n_frames - len(result)]


def test_interrupted_runs_write_nothing(
    session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        assert list(tmp_path.glob("sylpose-certify-*"))
        raise KeyboardInterrupt

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr(certify, "track_session", interrupt)
    assert run(session) == 130
    assert f"interrupted; nothing was written into {session / 'sylpose'}" in capsys.readouterr().err
    assert not (session / "sylpose").exists()
    assert not list(tmp_path.glob("sylpose-certify-*"))


def read(session: Session, start: int = 0, stop: int | None = None, every: int = 1) -> list[FrameSet]:
    return list(session.frames(start, stop, every, on_problem=pytest.fail))


def test_reversed_session_has_the_same_frames(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = open_session(recording)
    monkeypatch.setattr(sessions, "MAX_CHUNK_BYTES", 5 * 3 * 3 * 320 * 240)  # five frame sets of three cameras
    turned = ReversedSession.from_session(session)
    forward, backward = read(session), read(turned)
    assert [f.index for f in backward] == [f.index for f in forward]
    assert [f.time for f in backward] == pytest.approx([f.time for f in forward])
    for f, b in zip(forward, backward[::-1], strict=True):
        for one, other in zip(f.images, b.images, strict=True):
            np.testing.assert_array_equal(one, other)
    some = read(turned, 2, 11, 3)
    assert [f.index for f in some] == [2, 5, 8]
    np.testing.assert_array_equal(some[1].images[2], backward[5].images[2])
    assert not turned.boxes
    box = {"cam_1": Box(1, 2, 30, 40)}
    assert turned.with_boxes({"object": box}).select_object("object").boxes == box


def test_reversed_time_stamps(recording: Path) -> None:
    session = open_session(recording)
    old = session.timeline
    stamps = old.times[:, None] + [0.001, 0.002, 0.003]
    turned = ReversedSession.from_session(replace(session, timeline=replace(old, stamps=stamps)))
    last = read(turned, 0, 1)[0]
    # The latest of the cameras is the earliest when time runs backwards.
    assert last.times == pytest.approx(np.array([-0.001, -0.002, -0.003]))


def test_session_of_some_cameras(session: Path) -> None:
    complete, part = open_session(session), open_session(session).select_cameras(["cam_2", "cam_0"])
    assert part.rig.names == ("cam_0", "cam_2")
    assert part.without == ("cam_1",)
    assert part.boxes == {name: box for name, box in complete.boxes.items() if name != "cam_1"}
    one, other = read(complete, 3, 4)[0], read(part, 3, 4)[0]
    assert (other.index, other.time) == (one.index, one.time)
    np.testing.assert_array_equal(other.images[1], one.images[2])
    for names in ([], ["cam_9"]):
        with pytest.raises(ValueError, match="names: some of the cameras cam_0, cam_1, cam_2 are expected"):
            complete.select_cameras(names)


def test_bar_between_objects_of_the_session(session: Path) -> None:
    boxes = {"cam_0": (10, 10, 50, 50), "cam_1": (10, 10, 50, 50)}
    write_boxes(session, {"left": boxes, "right": boxes})
    opened = open_session(session)
    certify.check_bar(opened, ("left", "right"))
    for wrong in (("left", "left"), ("left", "middle")):
        with pytest.raises(ValueError, match="bar: two different objects"):
            certify.check_bar(opened, wrong)
