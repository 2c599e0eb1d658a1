"""`sylpose box`: boxes drawn in a browser are written pixel-exactly."""

from __future__ import annotations

import json
import queue
import re
import threading
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np
import pytest

from sylpose.browser.box_hints import compute_epipolar_band
from sylpose.commands.main import main
from sylpose.frames import Box
from sylpose.io import calibration
from sylpose.io.capture.boxes import load_boxes
from tests.chromium import open_page


@dataclass
class RunningCommand:
    """Command in a thread, the URL that it opened, and its exit code once it has ended."""

    urls: queue.Queue[str] = field(default_factory=queue.Queue)
    codes: list[int] = field(default_factory=list)
    url: str = ""


@contextmanager
def box_command(monkeypatch: pytest.MonkeyPatch, *args: object) -> Iterator[RunningCommand]:
    """Run `sylpose box` in a thread; it must have ended when the block ends."""
    run = RunningCommand()

    def shown(url: str) -> bool:
        run.urls.put(url)
        return True

    monkeypatch.setattr("sylpose.browser.server.open_browser", shown)
    thread = threading.Thread(target=lambda: run.codes.append(main(["box", *map(str, args)])), daemon=True)
    thread.start()
    run.url = run.urls.get(timeout=60)
    yield run
    thread.join(timeout=60)
    assert not thread.is_alive()


def send_request(url: str, body: object = None) -> tuple[int, Any]:
    data = None if body is None else json.dumps(body).encode()
    try:
        with urllib.request.urlopen(urllib.request.Request(url, data), timeout=60) as answer:
            return answer.status, json.loads(answer.read())
    except urllib.error.HTTPError as refused:
        return refused.code, json.loads(refused.read())


def drag(page: Any, camera: str, from_: tuple[float, float], to: tuple[float, float]) -> None:
    """Drag the mouse between two points of a camera's image, in coordinates of pixel edges."""
    frame = page.locator(f".tile[data-camera={camera}] svg").bounding_box()
    view = [float(v) for v in page.locator(f".tile[data-camera={camera}] svg").get_attribute("viewBox").split()]
    scale = min(frame["width"] / view[2], frame["height"] / view[3])
    left = frame["x"] + (frame["width"] - scale * view[2]) / 2
    top = frame["y"] + (frame["height"] - scale * view[3]) / 2
    places = [(left + scale * (x - view[0]), top + scale * (y - view[1])) for x, y in (from_, to)]
    page.mouse.move(*places[0])
    page.mouse.down()
    page.mouse.move(*((a + b) / 2 for a, b in zip(*places, strict=True)))
    page.mouse.move(*places[1])
    page.mouse.up()


def test_drawn_boxes_are_written(
    browser: Any, session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = load_boxes(session / "boxes.toml", calibration.load(session / "calibration.toml"))["object"]
    (session / "boxes.toml").unlink()
    first, second = truth["cam_0"], truth["cam_1"]
    with box_command(monkeypatch, session) as run, open_page(browser, run.url, online=True) as shown:
        page: Any = shown.page
        tile = {name: page.locator(f".tile[data-camera={name}]") for name in ("cam_0", "cam_1", "cam_2")}
        tile["cam_0"].locator("svg").wait_for()
        assert page.locator("polygon").count() == 0
        # A box in the first camera is shown as an epipolar band in the others.
        drag(page, "cam_0", (first.x, first.y), (first.x + first.width, first.y + first.height))
        for name in ("cam_1", "cam_2"):
            tile[name].locator("polygon[data-of=cam_0]").wait_for(state="attached")
        page.locator(
            "#cameras[aria-busy=false]"
        ).wait_for()  # wait for the hints of the final box, not of an intermediate one
        assert tile["cam_0"].locator("polygon").count() == 0
        rig = calibration.load(session / "calibration.toml")
        band = compute_epipolar_band(rig["cam_0"], first, rig["cam_1"]).outline + 0.5
        points = tile["cam_1"].locator("polygon").get_attribute("points").split()
        assert [[float(v) for v in p.split(",")] for p in points] == band.round(1).tolist()
        # A second box, first too large and misplaced: resized, moved, nudged by keys.
        x, y, right, bottom = second.x, second.y, second.x + second.width, second.y + second.height
        drag(page, "cam_1", (right + 12, bottom + 8), (x + 3, y - 2))
        drag(page, "cam_1", (right + 12, bottom + 8), (right + 3, bottom - 2))  # by its corner
        drag(page, "cam_1", (x + 20, y + 20), (x + 15, y + 33))  # by its middle
        for pressed in ("ArrowRight", "ArrowRight", "Shift+ArrowUp", "ArrowUp"):
            page.keyboard.press(pressed)
        numbers = tile["cam_1"].locator(".numbers").text_content()
        assert numbers == f"{second.width:.0f} × {second.height:.0f} px at {x:.0f}, {y:.0f}"
        # Delete and undo; Tab selects the next camera, Enter accepts the suggested box.
        page.keyboard.press("Delete")
        assert tile["cam_1"].locator(".own rect").count() == 0
        page.keyboard.press("Control+z")
        tile["cam_2"].locator("[data-suggested]").wait_for()
        page.keyboard.press("Tab")
        assert page.evaluate("document.activeElement.closest('.tile').dataset.camera") == "cam_2"
        page.keyboard.press("Enter")
        tile["cam_2"].locator(".own .box").wait_for()
        assert run.codes == []
        page.locator("#save").click()
        page.locator("#saved[open]").wait_for()
        assert "sylpose track" in page.locator("#next").text_content()
        assert shown.errors == []
        assert all(url.startswith(run.url) for url in shown.requests)
    assert run.codes == [0]
    drawn = load_boxes(session / "boxes.toml", rig)["object"]
    assert drawn["cam_0"] == first
    assert drawn["cam_1"] == second
    third = truth["cam_2"]
    assert drawn["cam_2"].x < third.x + 5
    assert drawn["cam_2"].x + drawn["cam_2"].width > third.x + third.width - 5
    output = capsys.readouterr().out
    assert str(session / "boxes.toml") in output
    assert f"Next: sylpose track {session}\n" in output


def test_several_objects_and_existing_boxes(browser: Any, session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = calibration.load(session / "calibration.toml")
    before = load_boxes(session / "boxes.toml", rig)["object"]
    out = session / "of two.toml"
    with (
        box_command(monkeypatch, session, "--out", out, "--start", 3) as run,
        open_page(browser, run.url, online=True, color_scheme="dark") as shown,
    ):
        page: Any = shown.page
        page.locator(".own .box").nth(2).wait_for()
        assert "frame 3" in page.locator("#recording").text_content()
        page.locator(".object input").fill("mug")
        page.keyboard.press("Enter")
        page.get_by_text("+ object").click()
        drag(page, "cam_0", (10, 200), (50, 230))
        # Zooming does not change pixel coordinates.
        page.locator(".tile[data-camera=cam_1] svg").hover()
        page.mouse.wheel(0, -400)
        view = page.locator(".tile[data-camera=cam_1] svg").get_attribute("viewBox")
        assert view != "0 0 320 240"
        left, top, width, height = (float(v) for v in view.split())
        a = (round(left + 0.1 * width), round(top + 0.1 * height))
        b = (round(left + 0.7 * width), round(top + 0.8 * height))
        drag(page, "cam_1", a, b)
        page.locator("#save").click()
        # The boxes do not intersect: the page reports it and continues.
        page.locator("#say.wrong").wait_for()
        page.locator("#save:enabled").wait_for()
        output = page.locator("#say").text_content()  # from the hints or from saving
        assert "cannot contain the same object" in output or "object_2: boxes: the boxes of" in output
        assert not out.exists()
        page.locator(".tile[data-camera=cam_1] svg").focus()
        page.keyboard.press("Delete")
        page.locator("#save").click()
        page.locator("#saved[open]").wait_for()
        assert "--start 3 --boxes" in page.locator("#next").text_content()
        # The browser console reports the refusal as a response with status 400.
        assert all("400" in error for error in shown.errors)
    assert run.codes == [0]
    assert load_boxes(out, rig) == {"mug": before, "object_2": {"cam_0": Box(10, 200, 40, 30)}}
    assert load_boxes(session / "boxes.toml", rig)["object"] == before


def test_names_are_escaped(browser: Any, session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "<img src=x>"
    for file in ("calibration.toml", "boxes.toml"):
        text = (session / file).read_text()
        (session / file).write_text(re.sub(r'"?\bcam_2\b"?', f'"{name}"', text))
    (session / "cam_2.mp4").rename(session / f"{name}.mp4")
    with box_command(monkeypatch, session) as run, open_page(browser, run.url, online=True) as shown:
        tile = shown.page.locator(".tile").nth(2)
        tile.locator(".own .box").wait_for()
        assert tile.locator(".name").inner_text() == name
        assert shown.page.locator("img").count() == 0
        assert shown.errors == []
        assert send_request(f"{run.url}boxes", {"object": {name: [1, 2, 30, 40]}})[0] == 200
    assert (session / "boxes.toml").read_text().splitlines()[1:] == [f'"{name}" = [1, 2, 30, 40]']


def test_requests_are_validated_like_files(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = session / "boxes.toml"
    before = file.read_bytes()
    cases: list[tuple[object, str]] = [
        ({}, "there is no box yet"),
        ({"object": {}}, "there is no box yet"),
        ({"object": {"cam_7": [1, 2, 3, 4]}}, "cam_7"),
        ({"object": {"cam_0": [1, 2, 3]}}, "boxes by camera are expected"),
        ({"object": {"cam_0": [1, 2, 3, "4"]}}, "boxes by camera are expected"),
        ({"object": {"cam_0": [1, 2, 3, -4]}}, "boxes.toml: the box of cam_0 must be finite with a positive width"),
        ({"object": {"cam_0": [1, 2, 3000, 4]}}, "boxes.toml: the box of cam_0 .* is not inside the image of 320x240"),
        ({"../up": {"cam_0": [1, 2, 30, 40]}}, "an object name must consist of letters"),
        ({"cam_1": {"cam_0": [1, 2, 30, 40]}}, "has a camera's name"),
        ({"a": {"cam_0": [1, 2, 30, 40]}, "A": {"cam_0": [1, 2, 30, 40]}}, "differ in case"),
        (
            {"object": {"cam_0": [1, 1, 20, 20], "cam_1": [290, 210, 20, 20]}},
            "the boxes of cam_0, cam_1 do not intersect",
        ),
        ([1], "boxes by camera are expected"),
    ]
    with box_command(monkeypatch, session) as run:
        for sent, words in cases:
            status, output = send_request(f"{run.url}boxes", sent)
            assert status == 400, sent
            assert re.search(words, output["error"]), output
            assert "\n" not in output["error"]
        assert send_request(f"{run.url}hints?boxes={quote('{')}")[0] == 400
        assert send_request(f"{run.url}hints?boxes={quote(json.dumps({'cam_0': [1, 2, 3000, 4]}))}")[0] == 400
        assert send_request(f"{run.url}image?camera=../calibration.toml")[0] == 400
        assert send_request(f"{run.url}state")[1]["boxes"]["object"]["cam_0"] == [int(v) for v in _numbers(before)]
        assert file.read_bytes() == before
        assert run.codes == []
        assert send_request(f"{run.url}boxes", {"mug": {"cam_0": [1, 2, 30, 40.5]}})[0] == 200
    assert run.codes == [0]
    assert file.read_text().splitlines()[1:] == ["", "[mug]", "cam_0 = [1, 2, 30, 40.5]"]


def _numbers(file: bytes) -> list[str]:
    line = next(line for line in file.decode().splitlines() if line.startswith("cam_0"))
    return line.partition("[")[2].rstrip("]").split(",")


def test_objects_must_match_the_masks(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (session / "boxes.toml").unlink()
    (session / "masks" / "mug").mkdir(parents=True)
    cv2.imwrite(str(session / "masks" / "mug" / "cam_0.png"), np.full((240, 320), 255, np.uint8))
    with box_command(monkeypatch, session) as run:
        assert send_request(f"{run.url}state")[1]["boxes"] == {"mug": {}}
        status, output = send_request(f"{run.url}boxes", {"object": {"cam_0": [1, 2, 30, 40]}})
        assert status == 400
        assert "has masks of mug: the boxes must be of the same objects, not of object" in output["error"]
        assert send_request(f"{run.url}boxes", {"mug": {"cam_0": [1, 2, 30, 40]}})[0] == 200
    assert run.codes == [0]


def test_interrupt_changes_no_file(
    session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {file.name: file.stat().st_mtime_ns for file in session.iterdir()}

    def interrupted(_: str) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr("sylpose.browser.server.open_browser", interrupted)
    assert main(["box", str(session)]) == 130
    assert capsys.readouterr().err == "sylpose: interrupted; no boxes were written\n"
    assert {file.name: file.stat().st_mtime_ns for file in session.iterdir()} == before


def test_invalid_frames_and_files_are_rejected(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def sentence(*args: object) -> str:
        assert main(["box", str(session), *map(str, args)]) == 2
        return capsys.readouterr().err

    assert "start must be in 0 ... 11" in sentence("--start", 12, "--no-browser")
    (session / "boxes.toml").write_text("cam_0 = 3")
    assert "boxes.toml: cam_0 = [x, y, width, height] is expected" in sentence("--no-browser")
    (session / "live.toml").write_text("[sources]\ncam_0 = 0\n")
    assert "has live cameras; boxes can only be drawn in recordings" in sentence("--no-browser")


def test_track_suggests_the_box_command(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (session / "boxes.toml").write_text("cam_0 = [1, 1, 20, 20]\ncam_1 = [290, 210, 20, 20]\n")
    for command in (["track", str(session), "--no-overlay"], ["check", str(session)]):
        assert main(command) == 2
        output = capsys.readouterr().err
        assert "the boxes of cam_0, cam_1 do not intersect in space" in output
        assert f"sylpose box {session} draws them" in output
    (session / "boxes.toml").unlink()
    assert main(["track", str(session), "--no-overlay", "--stop", "1"]) == 1
    assert f"sylpose box {session} draws them" in capsys.readouterr().err
