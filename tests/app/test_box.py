"""`sylpose box`: boxes drawn in a browser come into the file to the pixel."""

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

from sylpose import calibration
from sylpose.app.box_hints import epipolar_band
from sylpose.capture.boxes import load_boxes
from sylpose.cli import main
from sylpose.frames import Box
from tests.browser import opened


@dataclass
class Running:
    """A command in a thread, the address that it opened, and its exit code once it has ended."""

    urls: queue.Queue[str] = field(default_factory=queue.Queue)
    codes: list[int] = field(default_factory=list)
    url: str = ""


@contextmanager
def box_command(monkeypatch: pytest.MonkeyPatch, *args: object) -> Iterator[Running]:
    """`sylpose box`, which has ended by itself when the block has."""
    run = Running()

    def shown(url: str) -> bool:
        run.urls.put(url)
        return True

    monkeypatch.setattr("sylpose.app.box.open_browser", shown)
    thread = threading.Thread(target=lambda: run.codes.append(main(["box", *map(str, args)])), daemon=True)
    thread.start()
    run.url = run.urls.get(timeout=60)
    yield run
    thread.join(timeout=60)
    assert not thread.is_alive()


def ask(url: str, body: object = None) -> tuple[int, Any]:
    data = None if body is None else json.dumps(body).encode()
    try:
        with urllib.request.urlopen(urllib.request.Request(url, data), timeout=60) as answer:
            return answer.status, json.loads(answer.read())
    except urllib.error.HTTPError as refused:
        return refused.code, json.loads(refused.read())


def drag(page: Any, camera: str, from_: tuple[float, float], to: tuple[float, float]) -> None:
    """From one place of a camera's image to another, as edges of its pixels count."""
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


def test_boxes_are_drawn(
    browser: Any, session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    truth = load_boxes(session / "boxes.toml", calibration.load(session / "calibration.toml"))["object"]
    (session / "boxes.toml").unlink()
    first, second = truth["cam_0"], truth["cam_1"]
    with box_command(monkeypatch, session) as run, opened(browser, run.url, online=True) as shown:
        page: Any = shown.page
        tile = {name: page.locator(f".tile[data-camera={name}]") for name in ("cam_0", "cam_1", "cam_2")}
        tile["cam_0"].locator("svg").wait_for()
        assert page.locator("polygon").count() == 0
        # A box in the first camera is a band in the others.
        drag(page, "cam_0", (first.x, first.y), (first.x + first.width, first.y + first.height))
        for name in ("cam_1", "cam_2"):
            tile[name].locator("polygon[data-of=cam_0]").wait_for(state="attached")
        page.locator(
            "#cameras[aria-busy=false]"
        ).wait_for()  # what it shows is of the whole box, not of part of the way
        assert tile["cam_0"].locator("polygon").count() == 0
        rig = calibration.load(session / "calibration.toml")
        band = epipolar_band(rig["cam_0"], first, rig["cam_1"]).outline + 0.5
        points = tile["cam_1"].locator("polygon").get_attribute("points").split()
        assert [[float(v) for v in p.split(",")] for p in points] == band.round(1).tolist()
        # A second one, too large and in the wrong place at first: resized, moved, nudged.
        x, y, right, bottom = second.x, second.y, second.x + second.width, second.y + second.height
        drag(page, "cam_1", (right + 12, bottom + 8), (x + 3, y - 2))
        drag(page, "cam_1", (right + 12, bottom + 8), (right + 3, bottom - 2))  # by its corner
        drag(page, "cam_1", (x + 20, y + 20), (x + 15, y + 33))  # by its middle
        for pressed in ("ArrowRight", "ArrowRight", "Shift+ArrowUp", "ArrowUp"):
            page.keyboard.press(pressed)
        numbers = tile["cam_1"].locator(".numbers").text_content()
        assert numbers == f"{second.width:.0f} × {second.height:.0f} px at {x:.0f}, {y:.0f}"
        # Removed and got back; the next camera by Tab, which takes what is suggested there.
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
    said = capsys.readouterr().out
    assert str(session / "boxes.toml") in said
    assert f"Next: sylpose track {session}\n" in said


def test_several_objects_and_what_is_there_already(
    browser: Any, session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = calibration.load(session / "calibration.toml")
    before = load_boxes(session / "boxes.toml", rig)["object"]
    out = session / "of two.toml"
    with (
        box_command(monkeypatch, session, "--out", out, "--start", 3) as run,
        opened(browser, run.url, online=True, color_scheme="dark") as shown,
    ):
        page: Any = shown.page
        page.locator(".own .box").nth(2).wait_for()
        assert "frame 3" in page.locator("#recording").text_content()
        page.locator(".object input").fill("mug")
        page.keyboard.press("Enter")
        page.get_by_text("+ object").click()
        drag(page, "cam_0", (10, 200), (50, 230))
        # Zoomed in, and out again: pixels stay where they are.
        page.locator(".tile[data-camera=cam_1] svg").hover()
        page.mouse.wheel(0, -400)
        view = page.locator(".tile[data-camera=cam_1] svg").get_attribute("viewBox")
        assert view != "0 0 320 240"
        left, top, width, height = (float(v) for v in view.split())
        a = (round(left + 0.1 * width), round(top + 0.1 * height))
        b = (round(left + 0.7 * width), round(top + 0.8 * height))
        drag(page, "cam_1", a, b)
        page.locator("#save").click()
        # They are not of one thing: the page says it, and goes on.
        page.locator("#say.wrong").wait_for()
        page.locator("#save:enabled").wait_for()
        said = page.locator("#say").text_content()  # of the hints, or of what was to be saved
        assert "not of one thing" in said or "object_2: boxes: no place in space" in said
        assert not out.exists()
        page.locator(".tile[data-camera=cam_1] svg").focus()
        page.keyboard.press("Delete")
        page.locator("#save").click()
        page.locator("#saved[open]").wait_for()
        assert "--start 3 --boxes" in page.locator("#next").text_content()
        # The refusal is an answer with status 400, which the console tells.
        assert all("400" in error for error in shown.errors)
    assert run.codes == [0]
    assert load_boxes(out, rig) == {"mug": before, "object_2": {"cam_0": Box(10, 200, 40, 30)}}
    assert load_boxes(session / "boxes.toml", rig)["object"] == before


def test_names_are_text(browser: Any, session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = "<img src=x>"
    for file in ("calibration.toml", "boxes.toml"):
        text = (session / file).read_text()
        (session / file).write_text(re.sub(r'"?\bcam_2\b"?', f'"{name}"', text))
    (session / "cam_2.mp4").rename(session / f"{name}.mp4")
    with box_command(monkeypatch, session) as run, opened(browser, run.url, online=True) as shown:
        tile = shown.page.locator(".tile").nth(2)
        tile.locator(".own .box").wait_for()
        assert tile.locator(".name").inner_text() == name
        assert shown.page.locator("img").count() == 0
        assert shown.errors == []
        assert ask(f"{run.url}boxes", {"object": {name: [1, 2, 30, 40]}})[0] == 200
    assert (session / "boxes.toml").read_text().splitlines()[1:] == [f'"{name}" = [1, 2, 30, 40]']


def test_what_is_sent_is_looked_at_as_files_are(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
        ({"../up": {"cam_0": [1, 2, 30, 40]}}, "an object's name is made of letters"),
        ({"cam_1": {"cam_0": [1, 2, 30, 40]}}, "has a camera's name"),
        ({"a": {"cam_0": [1, 2, 30, 40]}, "A": {"cam_0": [1, 2, 30, 40]}}, "differ in capital letters"),
        ({"object": {"cam_0": [1, 1, 20, 20], "cam_1": [290, 210, 20, 20]}}, "no place in space .*cam_0, cam_1"),
        ([1], "boxes by camera are expected"),
    ]
    with box_command(monkeypatch, session) as run:
        for sent, words in cases:
            status, said = ask(f"{run.url}boxes", sent)
            assert status == 400, sent
            assert re.search(words, said["error"]), said
            assert "\n" not in said["error"]
        assert ask(f"{run.url}hints?boxes={quote('{')}")[0] == 400
        assert ask(f"{run.url}hints?boxes={quote(json.dumps({'cam_0': [1, 2, 3000, 4]}))}")[0] == 400
        assert ask(f"{run.url}image?camera=../calibration.toml")[0] == 400
        assert ask(f"{run.url}state")[1]["boxes"]["object"]["cam_0"] == [int(v) for v in _numbers(before)]
        assert file.read_bytes() == before
        assert run.codes == []
        assert ask(f"{run.url}boxes", {"mug": {"cam_0": [1, 2, 30, 40.5]}})[0] == 200
    assert run.codes == [0]
    assert file.read_text().splitlines()[1:] == ["", "[mug]", "cam_0 = [1, 2, 30, 40.5]"]


def _numbers(file: bytes) -> list[str]:
    line = next(line for line in file.decode().splitlines() if line.startswith("cam_0"))
    return line.partition("[")[2].rstrip("]").split(",")


def test_objects_are_those_of_the_masks(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (session / "boxes.toml").unlink()
    (session / "masks" / "mug").mkdir(parents=True)
    cv2.imwrite(str(session / "masks" / "mug" / "cam_0.png"), np.full((240, 320), 255, np.uint8))
    with box_command(monkeypatch, session) as run:
        assert ask(f"{run.url}state")[1]["boxes"] == {"mug": {}}
        status, said = ask(f"{run.url}boxes", {"object": {"cam_0": [1, 2, 30, 40]}})
        assert status == 400
        assert "has masks of mug: the boxes must be of the same objects, not of object" in said["error"]
        assert ask(f"{run.url}boxes", {"mug": {"cam_0": [1, 2, 30, 40]}})[0] == 200
    assert run.codes == [0]


def test_an_interrupt_leaves_everything_as_it_was(
    session: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {file.name: file.stat().st_mtime_ns for file in session.iterdir()}

    def interrupted(_: str) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr("sylpose.app.box.open_browser", interrupted)
    assert main(["box", str(session)]) == 130
    assert capsys.readouterr().err == "sylpose: interrupted; no boxes were written\n"
    assert {file.name: file.stat().st_mtime_ns for file in session.iterdir()} == before


def test_what_cannot_be_drawn_into(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def sentence(*args: object) -> str:
        assert main(["box", str(session), *map(str, args)]) == 2
        return capsys.readouterr().err

    assert "start must be in 0 ... 11" in sentence("--start", 12, "--no-browser")
    (session / "boxes.toml").write_text("cam_0 = 3")
    assert "boxes.toml: cam_0 = [x, y, width, height] is expected" in sentence("--no-browser")
    (session / "live.toml").write_text("[sources]\ncam_0 = 0\n")
    assert "of live cameras; boxes are drawn into recordings" in sentence("--no-browser")


def test_track_says_how_boxes_come_about(session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (session / "boxes.toml").write_text("cam_0 = [1, 1, 20, 20]\ncam_1 = [290, 210, 20, 20]\n")
    for command in (["track", str(session), "--no-overlay"], ["check", str(session)]):
        assert main(command) == 2
        said = capsys.readouterr().err
        assert "no place in space is inside the boxes of cam_0, cam_1" in said
        assert f"sylpose box {session} draws them anew" in said
    (session / "boxes.toml").unlink()
    assert main(["track", str(session), "--no-overlay", "--stop", "1"]) == 1
    assert f"sylpose box {session} draws them" in capsys.readouterr().err
