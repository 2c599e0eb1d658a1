"""Content of report.html, and its behavior in a browser."""

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

from sylpose.geometry.euler_angles import PAN_TILT_ROLL
from sylpose.io import calibration
from sylpose.report import page as report_page
from sylpose.report.files import write_trajectory
from sylpose.report.page import (
    ASSETS_DIR,
    COORDINATE_STEPS,
    MAX_BYTES,
    MISSING_COORDINATE,
    PageHeader,
    build_page_data,
    build_page_images,
    render_page,
    select_frames,
)
from sylpose.report.scene import IMAGE_GRID, Scene, Thumbnails, build_scene
from sylpose.results import FramePose, Trajectory
from sylpose.rig import Rig, make_look_at_camera
from sylpose.runs.page import write_report_page
from sylpose.runs.run_metadata import SETTINGS, USED_CALIBRATION
from sylpose.status import FrameStatus
from tests.chromium import OpenedPage, open_page
from tests.paths import REPOSITORY

if TYPE_CHECKING:
    from playwright.sync_api import Browser

CAMERAS = ("left", "<img src=x onerror=hacked=1>", "above")
RECORDING = "/data/Trial <script>hacked=2<\\u002fscript> & 7"
REASON = "nothing </script><script>hacked=3</script> moves"
FRAMES, LOST, TIMES = 30, range(12, 18), 1.7e9  # as seconds since 1970


def rig() -> Rig:
    eyes = ((1.0, 0, 0.2), (0, 1.2, 0.2), (0.1, 0.1, 0.9))
    return Rig(
        [make_look_at_camera(n, eye, (0, 0, 0), 800, (640, 480)) for n, eye in zip(CAMERAS, eyes, strict=True)], "m"
    )


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


def stills() -> Thumbnails:
    index = np.arange(10, 10 + FRAMES, 4)
    return Thumbnails(index, tuple((jpeg(k), None, jpeg(k)) for k in range(len(index))))


def make_result(folder: Path, run_trajectory: Trajectory) -> Path:
    """Make the page of a run from the files in its folder."""
    write_trajectory(folder, run_trajectory)
    calibration.save(rig(), folder / USED_CALIBRATION)
    (folder / SETTINGS).write_text(
        f'started = 2026-11-24T10:00:00+00:00\nrecording = "{RECORDING}"\nwarnings = ["The <i>clocks</i> differ."]\n'
        '[options]\nmethod = "landmarks"\nsmooth = true\n[versions]\nsylpose = "0.1.9"\nnumpy = "1.2.3"\n'
        '["</script>"]\nkey = "</td>"\n'
    )
    (folder / "overlay.mp4").touch()
    (folder / "overlay_7.mp4").touch()
    return write_report_page(folder, stills())


def floats(text: str) -> Any:
    return np.frombuffer(base64.b64decode(text), "<f4")


# --- content ---------------------------------------------------------------------------------------------------------


def test_numbers_are_those_of_the_csv(tmp_path: Path) -> None:
    page = make_result(tmp_path, trajectory()).read_text(encoding="utf-8")
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
            if not (name == "inliers" and k == 0):  # the first frame has no match partner
                assert np.allclose(values[k], cells, rtol=1e-6, atol=1e-6, equal_nan=True), (name, k)
    places = floats(data["place"]).reshape(-1, 3) + data["center"]
    assert np.allclose(places[20], [float(rows[20][c]) for c in ("tx", "ty", "tz")], atol=1e-7)
    # Frame times are distinct even in seconds since 1970.
    assert np.allclose(data["start"] + floats(data["time"]).astype(float), [float(r["time"]) for r in rows], atol=1e-6)


def test_axes_are_drawn_at_their_projections() -> None:
    its, cameras = trajectory(), rig()
    scene = build_scene(its, cameras, thumbnails=stills())
    images = build_page_images(its, scene, cameras)
    drawn = np.frombuffer(base64.b64decode(images["axes"]), "<i2").reshape(len(images["index"]), 3, 3, -1, 2)
    for j, number in enumerate(images["index"]):
        k = number - 10
        if k in LOST:
            assert (drawn[j] == MISSING_COORDINATE).all()
            continue
        for c, camera in enumerate(cameras):
            ends = pose(k).apply(np.vstack([np.zeros(3), scene.axis_length * np.eye(3)]))
            seen = (camera.project(ends) + 0.5) / camera.size * COORDINATE_STEPS
            assert np.abs(drawn[j, c, :, -1] - seen[1:]).max() <= 0.5 + 1e-9
            assert np.abs(drawn[j, c, :, 0] - seen[0]).max() <= 0.5 + 1e-9


def test_short_failures_are_shown() -> None:
    its = trajectory(FRAMES)
    assert select_frames(its, 100).tolist() == list(range(FRAMES))
    chosen = select_frames(its, 6)
    assert len(chosen) == 6
    # Of frames 0 to 4 the first; frame 5 has a fault; of 10 to 14 the first lost one.
    assert chosen.tolist() == [0, 5, 12, 15, 20, 25]


def test_page_size_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    one = trajectory(2)
    many = Trajectory([replace(one[k > 0], index=k, time=k / 30) for k in range(report_page.MAX_FRAMES + 500)], CAMERAS)
    noise = np.random.default_rng(1).bytes(60_000)
    index = np.arange(0, 2400, 50)
    pictures = Thumbnails(index, tuple((noise,) * 3 for _ in index))
    cameras = Rig(rig().cameras)
    scene = build_scene(many, cameras, thumbnails=pictures)
    page = render_page(many, scene, cameras, PAN_TILT_ROLL, PageHeader("long", "1"))
    assert 3_000_000 < len(page.encode()) < MAX_BYTES
    assert "1250 of 2500 frames are shown" in page
    assert "reduced images of 12 frames" in page
    # Fewer frames fit with less space.
    monkeypatch.setattr(report_page, "MAX_VALUES", 4000)
    assert build_page_data(many, scene, PAN_TILT_ROLL)["shown"] == 100


def test_bundle_matches_its_sources() -> None:
    """After a change in web/, run `make web`, which requires Node.js."""
    web = REPOSITORY / "web"
    digest = hashlib.sha256()
    for name in ("package-lock.json", *(f"src/{file.name}" for file in sorted((web / "src").iterdir()))):
        digest.update(f"{name}\n{(web / name).read_text(encoding='utf-8')}".encode())
    script = (ASSETS_DIR / "report.js").read_text(encoding="utf-8")
    assert script.startswith(f"/* sources {digest.hexdigest()}\n")
    notice = (ASSETS_DIR / "NOTICE").read_text(encoding="utf-8")
    for text in (script, (ASSETS_DIR / "report.css").read_text(encoding="utf-8")):
        assert notice in text
    assert notice.count("Permission is hereby granted") == 2
    assert all(name in notice for name in ("three ", "uplot "))
    assert "</script" not in script


# --- in a browser -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_result(tmp_path_factory.mktemp("found"), trajectory())


@pytest.fixture(scope="module")
def page(browser: Browser, found: Path) -> Iterator[OpenedPage]:
    with open_page(browser, found.as_uri()) as its:
        yield its
        assert its.requests == [found.as_uri()]
        assert its.errors == []


def go_to_frame(opened: OpenedPage, k: int) -> Any:
    slider = opened.page.locator("#slider")
    slider.evaluate("(slider, k) => { slider.value = k; slider.dispatchEvent(new Event('input')); }", k)
    return opened.state()


def object_matrix(scene: Scene, k: int) -> Any:
    """Return the view's object matrix of a frame, in WebGL's column order."""
    matrix = scene.world_from_object[k].copy()
    matrix[:3, 3] = (matrix[:3, 3] - scene.center) / scene.camera_distance
    return matrix.T.ravel()


def test_slider_moves_the_object(page: OpenedPage) -> None:
    scene = build_scene(trajectory(), rig())
    for k in (0, 7, 29):
        state = go_to_frame(page, k)
        assert (state["frame"], state["index"], state["visible"]) == (k, 10 + k, True)
        assert np.allclose(state["matrix"], object_matrix(scene, k), atol=1e-6)
    assert page.page.locator("#at").inner_text().startswith("Frame 39 0.967 s")
    assert "of frame 38, the nearest" in page.page.locator("#still-of").inner_text()
    assert page.page.locator("#stills img").nth(0).get_attribute("src") == (
        "data:image/jpeg;base64," + base64.b64encode(jpeg(7)).decode()
    )
    assert page.page.locator("#stills .none").nth(1).is_visible()


def test_keys_and_play_move_the_slider(page: OpenedPage) -> None:
    go_to_frame(page, 0)
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


def test_frames_without_pose_show_reason(page: OpenedPage) -> None:
    before = go_to_frame(page, 11)["matrix"]
    state = go_to_frame(page, 14)
    assert (state["status"], state["visible"]) == ("lost", False)
    assert state["matrix"] == before  # the last pose, pale
    assert page.page.locator("#view-said").inner_text() == f"lost: {REASON}"
    assert "Nothing </script><script>hacked=3</script> moves." in page.page.locator("#why").inner_text()
    go_to_frame(page, 5)
    assert page.page.locator("#view-said").is_hidden()
    assert "above: <b>nudged</b>" in page.page.locator("#why").inner_text()


def test_plots_zoom_together_and_click_selects_frame(page: OpenedPage) -> None:
    go_to_frame(page, 0)
    assert page.state("range") == [[0, pytest.approx(29 / 30)]]  # since the first frame
    assert len(page.state("panels")[0]) == 6
    plot = page.page.locator("#plots .u-over").nth(2)
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    assert box is not None
    middle = box["y"] + box["height"] / 2
    # Zoom to the range from a quarter to three quarters.
    page.page.mouse.move(box["x"] + 0.25 * box["width"], middle)
    page.page.mouse.down()
    page.page.mouse.move(box["x"] + 0.75 * box["width"], middle, steps=4)
    page.page.mouse.up()
    (zoomed,) = page.state("range")
    assert np.allclose(zoomed, [0.25 * 29 / 30, 0.75 * 29 / 30], atol=0.01)
    assert page.state("frame") == [0]
    page.page.mouse.click(box["x"] + 0.5 * box["width"], middle)
    assert abs(page.state("frame")[0] - 14.5) <= 0.5
    # All panels share the time axis: the same position in another panel is the same frame.
    other = page.page.locator("#plots .u-over").nth(5)
    other.click(position={"x": 0.02 * box["width"], "y": 20})
    assert abs(page.state("frame")[0] - 0.26 * 29) <= 1
    page.page.get_by_role("button", name="All", exact=True).click()
    assert page.state("range") == [[0, pytest.approx(29 / 30)]]  # since the first frame
    page.page.get_by_role("button", name="Zoom in").click()
    (nearer,) = page.state("range")
    assert nearer[1] - nearer[0] == pytest.approx(0.5 * 29 / 30, rel=1e-3)


def test_file_contents_are_escaped(page: OpenedPage) -> None:
    page.page.locator("summary").click()
    assert page.page.evaluate("() => window.hacked") is None
    assert page.page.locator("img[src=x], i:has-text('clocks'), b:has-text('nudged')").count() == 0
    body_text = page.page.locator("body").inner_text()
    for words in (
        "seconds since 1700000000.000",
        "Trial <script>hacked=2</script> & 7",
        CAMERAS[1],
        "The <i>clocks</i> differ.",
        "</td>",
    ):
        assert words in body_text, words
    assert "2026-11-24 10:00 UTC" in body_text
    assert "sylpose 0.1.9, NumPy 1.2.3" in body_text
    links = page.page.locator(".images a")
    assert [links.nth(k).get_attribute("href") for k in range(links.count())] == ["overlay.mp4", "overlay_7.mp4"]


def test_page_fits_a_phone_screen(browser: Browser, found: Path) -> None:
    with open_page(browser, found.as_uri(), viewport={"width": 360, "height": 740}, color_scheme="dark") as its:
        assert its.page.evaluate("() => document.documentElement.scrollWidth") <= 360
        assert its.page.evaluate("() => getComputedStyle(document.body).backgroundColor") == "rgb(15, 19, 23)"
        assert its.errors == []


@pytest.mark.parametrize("size", [(1300, 900), (1366, 700), (360, 740)])
def test_player_does_not_cover_views(browser: Browser, found: Path, size: tuple[int, int]) -> None:
    """At any scroll position; on a phone, content above the images scrolls away beneath it."""
    with open_page(browser, found.as_uri(), viewport={"width": size[0], "height": size[1]}) as its:
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
            assert player["top"] >= 6  # it stays reachable once visible
        assert stuck


def test_view_avoids_occluding_images(browser: Browser, tmp_path: Path) -> None:
    """An image that blocks the default viewing direction changes it."""
    its, cameras = trajectory(), rig()
    scene = build_scene(its, cameras, thumbnails=stills())
    right, ahead, up = scene.axes
    usual = 0.36 * right - 0.8 * ahead + 0.88 * up
    usual /= np.linalg.norm(usual)
    across = np.cross(usual, right) / np.linalg.norm(np.cross(usual, right))
    plane = np.stack(np.meshgrid(*[np.linspace(-2, 2, IMAGE_GRID)] * 2), axis=-1) @ [np.cross(across, usual), across]
    sheets = scene.image_planes.copy()
    sheets[0] = its.positions[its.measured_mask].mean(axis=0) + scene.axis_length * (3 * usual + plane)
    page = render_page(its, replace(scene, image_planes=sheets), cameras, PAN_TILT_ROLL, PageHeader("a", "1"))
    (tmp_path / "page.html").write_text(page, encoding="utf-8")
    with open_page(browser, (tmp_path / "page.html").as_uri()) as shown:
        assert shown.state("hidden") == [0]
        shown.page.get_by_label("Look").select_option("at the object")
        assert shown.state("hidden") == [0]
        assert shown.errors == []


def test_rounded_zeros_have_no_sign(page: OpenedPage) -> None:
    go_to_frame(page, 0)
    outputs = page.page.locator("#plots .panel").nth(0).locator("output")
    assert [outputs.nth(k).inner_text() for k in range(3)] == ["0", "0", "0"]
    go_to_frame(page, 29)
    assert [outputs.nth(k).inner_text() for k in range(3)] == ["0.290", "0", "0.0580"]


def test_feature_plot_is_hidden_without_matches(browser: Browser, tmp_path: Path) -> None:
    its = trajectory(nothing=True)
    its = Trajectory([replace(frame, matches=np.zeros(3, np.int64)) for frame in its], CAMERAS, "m")
    with open_page(browser, make_result(tmp_path, its).as_uri()) as page:
        assert page.state("panels") == [[]]
        assert page.page.locator(".over-time").is_hidden()
        assert page.errors == []


def test_failed_run_shows_reasons(browser: Browser, tmp_path: Path) -> None:
    path = make_result(tmp_path, trajectory(nothing=True))
    with open_page(browser, path.as_uri()) as its:
        before, notice = its.page.locator(".notice.failed").all_inner_texts()
        assert "Problems found before the run" in before
        assert "The <i>clocks</i> differ." in before
        assert f"30 frames: lost. {FrameStatus.LOST.text}" in notice
        assert f"30 frames: {REASON}" in notice
        assert its.state("visible", "panels") == [False, ["Features that match"]]
        assert "0 of 30 frames with a pose." in its.page.locator(".lead").inner_text()
        assert its.errors == []
