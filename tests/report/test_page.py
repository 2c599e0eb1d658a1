"""report.html: what is in it, and that it does in a browser what it should."""

from __future__ import annotations

import base64
import csv
import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from sylpose import calibration
from sylpose.app.page import make_page
from sylpose.app.run_metadata import SETTINGS, USED
from sylpose.geometry.euler_angles import PAN_TILT_ROLL
from sylpose.report import page_data
from sylpose.report.files import write_trajectory
from sylpose.report.page import ASSETS, Head, page_of
from sylpose.report.page_data import GRAIN, MOST_BYTES, NOWHERE, data_of, images_of, shown_frames
from sylpose.report.scene import GRID, Scene, Stills, scene_of
from sylpose.results import FramePose, FrameStatus, Trajectory
from sylpose.rig import Rig, camera_at
from tests.browser import Opened, opened
from tests.paths import REPOSITORY

if TYPE_CHECKING:
    from playwright.sync_api import Browser

CAMERAS = ("left", "<img src=x onerror=hacked=1>", "above")
RECORDING = "/data/Trial <script>hacked=2<\\u002fscript> & 7"
REASON = "nothing </script><script>hacked=3</script> moves"
FRAMES, LOST, TIMES = 30, range(12, 18), 1.7e9  # as seconds since 1970


def rig() -> Rig:
    eyes = ((1.0, 0, 0.2), (0, 1.2, 0.2), (0.1, 0.1, 0.9))
    return Rig([camera_at(n, eye, (0, 0, 0), 800, (640, 480)) for n, eye in zip(CAMERAS, eyes, strict=True)], "m")


def pose(k: int) -> RigidTransform:
    return RigidTransform.from_components(
        [0.3 + 0.01 * k, -0.2, 0.002 * k], Rotation.from_euler("YXZ", [12 * k, k, 5], True)
    )


def trajectory(n: int = FRAMES, *, nothing: bool = False) -> Trajectory:
    frames = []
    for k in range(n):
        status = FrameStatus.LOST if k in LOST or nothing else FrameStatus.TRACKED if k else FrameStatus.FIRST
        frame = FramePose(
            10 + k, TIMES + k / 30, status, pose(k), 1e-6 * np.eye(6), np.full(3, 50 + k), np.full(3, 0.25)
        )
        if status is FrameStatus.LOST:
            frame = replace(frame, world_from_object=None, reason=REASON, residuals=np.full(3, np.nan))
        frames.append(replace(frame, matches=np.full(3, 60 + k)))
    if n > 5:
        frames[5] = replace(frames[5], faults=("above: <b>nudged</b>",))
    return Trajectory(frames, CAMERAS, "m")


def jpeg(k: int) -> bytes:
    image = np.full((48, 64, 3), 8 * k, np.uint8)
    return bytes(cv2.imencode(".jpg", image)[1])


def stills() -> Stills:
    index = np.arange(10, 10 + FRAMES, 4)
    return Stills(index, tuple((jpeg(k), None, jpeg(k)) for k in range(len(index))))


def result(folder: Path, its: Trajectory) -> Path:
    """The page of a run, from the files in its folder."""
    write_trajectory(folder, its)
    calibration.save(rig(), folder / USED)
    (folder / SETTINGS).write_text(
        f'begun = 2026-11-24T10:00:00+00:00\nrecording = "{RECORDING}"\nnoticed = ["The <i>clocks</i> differ."]\n'
        '[options]\nmethod = "landmarks"\nsmooth = true\n[versions]\nsylpose = "0.1.9"\nnumpy = "1.2.3"\n'
        '["</script>"]\nkey = "</td>"\n'
    )
    (folder / "overlay.mp4").touch()
    (folder / "overlay_7.mp4").touch()
    return make_page(folder, stills())


def floats(text: str) -> Any:
    return np.frombuffer(base64.b64decode(text), "<f4")


# --- what is in it ----------------------------------------------------------------------------------------------------


def test_numbers_are_those_of_the_csv(tmp_path: Path) -> None:
    page = result(tmp_path, trajectory()).read_text(encoding="utf-8")
    found = re.search('<script type="application/json" id="data">(.*?)</script>', page, re.S)
    assert found is not None
    data = json.loads(found[1])
    with (tmp_path / "trajectory.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    for name, columns, factor in (
        ("angle", ("pan_deg", "tilt_deg", "roll_deg"), 1.0),
        ("sigma", ("rx_sd_deg", "ry_sd_deg", "rz_sd_deg", "tx_sd", "ty_sd", "tz_sd"), 1.0),
        ("inliers", [f"inliers_{camera}" for camera in CAMERAS], 1.0),
        ("matches", [f"matches_{camera}" for camera in CAMERAS], 1.0),
    ):
        values = floats(data[name]).reshape(FRAMES, -1)
        for k, row in enumerate(rows):
            cells = [float(row[c]) * factor if row[c] and row["tx"] else np.nan for c in columns]
            if name == "matches" or (name == "inliers" and k in LOST):
                cells = [float(row[c]) for c in columns]
            if not (name == "inliers" and k == 0):  # the first is matched with nothing
                assert np.allclose(values[k], cells, rtol=1e-6, atol=1e-6, equal_nan=True), (name, k)
    places = floats(data["place"]).reshape(-1, 3) + data["center"]
    assert np.allclose(places[20], [float(rows[20][c]) for c in ("tx", "ty", "tz")], atol=1e-7)
    # Of seconds since 1970, too, frames have times of their own.
    assert np.allclose(data["start"] + floats(data["time"]).astype(float), [float(r["time"]) for r in rows], atol=1e-6)


def test_axes_are_drawn_where_cameras_see_them() -> None:
    its, cameras = trajectory(), rig()
    scene = scene_of(its, cameras, stills=stills())
    images = images_of(its, scene, cameras)
    drawn = np.frombuffer(base64.b64decode(images["axes"]), "<i2").reshape(len(images["index"]), 3, 3, -1, 2)
    for j, number in enumerate(images["index"]):
        k = number - 10
        if k in LOST:
            assert (drawn[j] == NOWHERE).all()
            continue
        for c, camera in enumerate(cameras):
            ends = pose(k).apply(np.vstack([np.zeros(3), scene.axis_length * np.eye(3)]))
            seen = (camera.project(ends) + 0.5) / camera.size * GRAIN
            assert np.abs(drawn[j, c, :, -1] - seen[1:]).max() <= 0.5 + 1e-9
            assert np.abs(drawn[j, c, :, 0] - seen[0]).max() <= 0.5 + 1e-9


def test_no_frame_that_went_wrong_is_left_out_for_being_short() -> None:
    its = trajectory(FRAMES)
    assert shown_frames(its, 100).tolist() == list(range(FRAMES))
    chosen = shown_frames(its, 6)
    assert len(chosen) == 6
    # Of frames 0 to 4 the first; the fifth has a fault; of 10 to 14 the first that is lost.
    assert chosen.tolist() == [0, 5, 12, 15, 20, 25]


def test_the_page_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    one = trajectory(2)
    many = Trajectory([replace(one[k > 0], index=k, time=k / 30) for k in range(page_data.MOST_FRAMES + 500)], CAMERAS)
    noise = np.random.default_rng(1).bytes(60_000)
    index = np.arange(0, 2400, 50)
    pictures = Stills(index, tuple((noise,) * 3 for _ in index))
    cameras = Rig(rig().cameras)
    scene = scene_of(many, cameras, stills=pictures)
    page = page_of(many, scene, cameras, PAN_TILT_ROLL, Head("long", "1"))
    assert 3_000_000 < len(page.encode()) < MOST_BYTES
    assert "Shown are 1250 of 2500 frames" in page
    assert "Images are of 12 frames" in page
    # Of many cameras, fewer frames.
    monkeypatch.setattr(page_data, "MOST_VALUES", 4000)
    assert data_of(many, scene, PAN_TILT_ROLL)["shown"] == 100


def test_the_bundle_is_of_its_sources() -> None:
    """After a change in web/: `make web`, which needs Node.js."""
    web = REPOSITORY / "web"
    digest = hashlib.sha256()
    for name in ("package-lock.json", *(f"src/{file.name}" for file in sorted((web / "src").iterdir()))):
        digest.update(f"{name}\n{(web / name).read_text(encoding='utf-8')}".encode())
    script = (ASSETS / "report.js").read_text(encoding="utf-8")
    assert script.startswith(f"/* sources {digest.hexdigest()}\n")
    notice = (ASSETS / "NOTICE").read_text(encoding="utf-8")
    for text in (script, (ASSETS / "report.css").read_text(encoding="utf-8")):
        assert notice in text
    assert notice.count("Permission is hereby granted") == 2
    assert all(name in notice for name in ("three ", "uplot "))
    assert "</script" not in script


# --- in a browser -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return result(tmp_path_factory.mktemp("found"), trajectory())


@pytest.fixture(scope="module")
def page(browser: Browser, found: Path) -> Iterator[Opened]:
    with opened(browser, found.as_uri()) as its:
        yield its
        assert its.requests == [found.as_uri()]
        assert its.errors == []


def go(opened: Opened, k: int) -> Any:
    slider = opened.page.locator("#slider")
    slider.evaluate("(slider, k) => { slider.value = k; slider.dispatchEvent(new Event('input')); }", k)
    return opened.state()


def placed(scene: Scene, k: int) -> Any:
    """The matrix that the view has for a frame, as WebGL has them: by columns."""
    matrix = scene.world_from_object[k].copy()
    matrix[:3, 3] = (matrix[:3, 3] - scene.center) / scene.reach
    return matrix.T.ravel()


def test_the_slider_moves_the_object(page: Opened) -> None:
    scene = scene_of(trajectory(), rig())
    for k in (0, 7, 29):
        state = go(page, k)
        assert (state["frame"], state["index"], state["visible"]) == (k, 10 + k, True)
        assert np.allclose(state["matrix"], placed(scene, k), atol=1e-6)
    assert page.page.locator("#at").inner_text().startswith("Frame 39 0.967 s")
    assert "of frame 38, the nearest" in page.page.locator("#still-of").inner_text()
    assert page.page.locator("#stills img").nth(0).get_attribute("src") == (
        "data:image/jpeg;base64," + base64.b64encode(jpeg(7)).decode()
    )
    assert page.page.locator("#stills .none").nth(1).is_visible()


def test_keys_and_play_move_the_slider(page: Opened) -> None:
    go(page, 0)
    page.page.locator("body").press("ArrowRight")
    assert page.state("frame") == [1]
    page.page.locator("body").press("Shift+ArrowRight")
    assert page.state("frame") == [11]
    page.page.locator("body").press("ArrowLeft")
    assert page.state("frame", "playing") == [10, False]
    page.page.get_by_role("slider", name="Frame").press("ArrowRight")
    assert page.state("frame") == [11]
    page.page.get_by_label("Speed").select_option("0.1")
    page.page.get_by_role("button", name="Play").click()
    page.page.wait_for_function("() => window.sylpose.state().frame >= 12")
    page.page.get_by_role("button", name="Pause").click()
    assert page.state("playing") == [False]


def test_frames_without_a_pose_say_why(page: Opened) -> None:
    before = go(page, 11)["matrix"]
    state = go(page, 14)
    assert (state["status"], state["visible"]) == ("lost", False)
    assert state["matrix"] == before  # where it was last, pale
    assert page.page.locator("#view-said").inner_text() == f"lost: {REASON}"
    assert "Nothing </script><script>hacked=3</script> moves." in page.page.locator("#why").inner_text()
    go(page, 5)
    assert page.page.locator("#view-said").is_hidden()
    assert "above: <b>nudged</b>" in page.page.locator("#why").inner_text()


def test_plots_zoom_together_and_a_click_goes_there(page: Opened) -> None:
    go(page, 0)
    assert page.state("range") == [[0, pytest.approx(29 / 30)]]  # since the first frame
    assert len(page.state("panels")[0]) == 6
    plot = page.page.locator("#plots .u-over").nth(2)
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    assert box is not None
    middle = box["y"] + box["height"] / 2
    # To what lies between a quarter and three quarters.
    page.page.mouse.move(box["x"] + 0.25 * box["width"], middle)
    page.page.mouse.down()
    page.page.mouse.move(box["x"] + 0.75 * box["width"], middle, steps=4)
    page.page.mouse.up()
    (zoomed,) = page.state("range")
    assert np.allclose(zoomed, [0.25 * 29 / 30, 0.75 * 29 / 30], atol=0.01)
    assert page.state("frame") == [0]
    page.page.mouse.click(box["x"] + 0.5 * box["width"], middle)
    assert abs(page.state("frame")[0] - 14.5) <= 0.5
    # All panels have the same times: in another one, the same place is the same frame.
    other = page.page.locator("#plots .u-over").nth(5)
    other.click(position={"x": 0.02 * box["width"], "y": 20})
    assert abs(page.state("frame")[0] - 0.26 * 29) <= 1
    page.page.get_by_role("button", name="All", exact=True).click()
    assert page.state("range") == [[0, pytest.approx(29 / 30)]]  # since the first frame
    page.page.get_by_role("button", name="Zoom in").click()
    (nearer,) = page.state("range")
    assert nearer[1] - nearer[0] == pytest.approx(0.5 * 29 / 30, rel=1e-3)


def test_what_files_say_is_text(page: Opened) -> None:
    page.page.locator("summary").click()
    assert page.page.evaluate("() => window.hacked") is None
    assert page.page.locator("img[src=x], i:has-text('clocks'), b:has-text('nudged')").count() == 0
    said = page.page.locator("body").inner_text()
    for words in (
        "seconds since 1700000000.000",
        "Trial <script>hacked=2</script> & 7",
        CAMERAS[1],
        "The <i>clocks</i> differ.",
        "</td>",
    ):
        assert words in said, words
    assert "2026-11-24 10:00 UTC" in said
    assert "sylpose 0.1.9, NumPy 1.2.3" in said
    links = page.page.locator(".images a")
    assert [links.nth(k).get_attribute("href") for k in range(links.count())] == ["overlay.mp4", "overlay_7.mp4"]


def test_it_is_as_wide_as_a_telephone(browser: Browser, found: Path) -> None:
    with opened(browser, found.as_uri(), viewport={"width": 360, "height": 740}, color_scheme="dark") as its:
        assert its.page.evaluate("() => document.documentElement.scrollWidth") <= 360
        assert its.page.evaluate("() => getComputedStyle(document.body).backgroundColor") == "rgb(15, 19, 23)"
        assert its.errors == []


@pytest.mark.parametrize("size", [(1300, 900), (1366, 700), (360, 740)])
def test_the_player_covers_nothing_that_it_moves(browser: Browser, found: Path, size: tuple[int, int]) -> None:
    """Wherever the page is scrolled to; on a telephone, whatever is above the images scrolls away beneath it."""
    with opened(browser, found.as_uri(), viewport={"width": size[0], "height": size[1]}) as its:
        height = its.page.evaluate("() => document.documentElement.scrollHeight")
        stuck = False
        for y in range(0, height - size[1], 90):
            its.page.evaluate("y => window.scrollTo(0, y)", y)
            player, view, images = (
                its.page.evaluate("name => document.querySelector(name).getBoundingClientRect().toJSON()", name)
                for name in (".transport", "#view", "#images")
            )
            assert player["top"] >= view["bottom"]
            if size[0] > 980:
                assert player["top"] >= images["bottom"]
                assert images["bottom"] == view["bottom"]
            stuck |= player["top"] == 6
            assert player["top"] >= 6  # it is never out of reach once it has been seen
        assert stuck


def test_the_view_is_from_where_images_hide_nothing(browser: Browser, tmp_path: Path) -> None:
    """An image that stands in the usual line of sight makes it another one."""
    its, cameras = trajectory(), rig()
    scene = scene_of(its, cameras, stills=stills())
    right, ahead, up = scene.axes
    usual = 0.36 * right - 0.8 * ahead + 0.88 * up
    usual /= np.linalg.norm(usual)
    across = np.cross(usual, right) / np.linalg.norm(np.cross(usual, right))
    plane = np.stack(np.meshgrid(*[np.linspace(-2, 2, GRID)] * 2), axis=-1) @ [np.cross(across, usual), across]
    sheets = scene.sheets.copy()
    sheets[0] = its.positions[its.solved].mean(axis=0) + scene.axis_length * (3 * usual + plane)
    page = page_of(its, replace(scene, sheets=sheets), cameras, PAN_TILT_ROLL, Head("a", "1"))
    (tmp_path / "page.html").write_text(page, encoding="utf-8")
    with opened(browser, (tmp_path / "page.html").as_uri()) as shown:
        assert shown.state("hidden") == [0]
        shown.page.get_by_label("Look").select_option("at the object")
        assert shown.state("hidden") == [0]
        assert shown.errors == []


def test_what_rounding_leaves_is_nothing(page: Opened) -> None:
    go(page, 0)
    said = page.page.locator("#plots .panel").nth(0).locator("output")
    assert [said.nth(k).inner_text() for k in range(3)] == ["0", "0", "0"]
    go(page, 29)
    assert [said.nth(k).inner_text() for k in range(3)] == ["0.290", "0", "0.0580"]


def test_no_plot_of_features_where_none_match(browser: Browser, tmp_path: Path) -> None:
    its = trajectory(nothing=True)
    its = Trajectory([replace(frame, matches=np.zeros(3, np.int64)) for frame in its], CAMERAS, "m")
    with opened(browser, result(tmp_path, its).as_uri()) as page:
        assert page.state("panels") == [[]]
        assert page.page.locator(".over-time").is_hidden()
        assert page.errors == []


def test_a_run_that_found_nothing_says_why(browser: Browser, tmp_path: Path) -> None:
    path = result(tmp_path, trajectory(nothing=True))
    with opened(browser, path.as_uri()) as its:
        before, notice = its.page.locator(".notice.failed").all_inner_texts()
        assert "What looked wrong before the run" in before
        assert "The <i>clocks</i> differ." in before
        assert f"30 frames: lost. {FrameStatus.LOST.text}" in notice
        assert f"30 frames: {REASON}" in notice
        assert its.state("visible", "panels") == [False, ["Features that match"]]
        assert "0 of 30 frames with a pose." in its.page.locator(".lead").inner_text()
        assert its.errors == []
