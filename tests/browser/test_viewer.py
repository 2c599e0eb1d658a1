"""`sylpose show` and `track --show`: contents of the page and access to it (SECURITY.md)."""

from __future__ import annotations

import http.client
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest

from sylpose.browser.scene_page import MAX_PATH_SEGMENTS, TRACKED_COLOR, escape_markdown, split_path, status_color
from sylpose.browser.server import HOST, VISER_MISSING, serve_viewer
from sylpose.browser.viewer import LivePage, ObjectPath, ResultPlayer, collect_frames
from sylpose.commands.main import main
from sylpose.io import calibration
from sylpose.io.capture import open_session
from sylpose.io.capture.random_access import RandomAccessReader
from sylpose.runs.options import RunOptions
from sylpose.runs.page import read_scenes
from sylpose.runs.run import track_session
from sylpose.runs.run_metadata import open_source_recording
from sylpose.status import FrameStatus
from sylpose.tracking.context import TrackedFrame
from sylpose.tracking.tracker import track
from tests.chromium import OpenedPage, open_page
from tests.conftest import FRAMES

TRACKED = 6
SMALL = {"width": 480, "height": 300}


@pytest.fixture(scope="module")
def result(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a result of the first frames of `recording`."""
    out = tmp_path_factory.mktemp("result")
    track_session(open_session(recording), out, RunOptions(stop=TRACKED, overlay=False))
    return out


@pytest.fixture
def server() -> Iterator[tuple[Any, str]]:
    pytest.importorskip("viser", reason="the extra `viewer`")
    with serve_viewer() as started:
        yield started


def wrong_in(shown: OpenedPage) -> list[str]:
    """Return a page's console errors, without those about missing graphics cards and viser's use of three.js."""
    return [line for line in shown.errors if not line.startswith(("THREE.Clock", "[.WebGL"))]


def until(what: Callable[[], object]) -> None:
    """Wait for a condition, up to a minute."""
    end = time.monotonic() + 60
    while not what():
        assert time.monotonic() < end, "it did not come about"
        time.sleep(0.02)


# --- access control ---------------------------------------------------------------------------------------------------


def status_of(port: int, path: str, **headers: str) -> int:
    connection = http.client.HTTPConnection(HOST, port, timeout=60)
    connection.request("GET", path, headers={name.replace("_", "-"): value for name, value in headers.items()})
    status = connection.getresponse().status
    connection.close()
    return status


def test_access_requires_secret_address(server: tuple[Any, str]) -> None:
    viser, url = server
    port, path = urlsplit(url).port or 0, urlsplit(url).path
    assert viser.get_host() == urlsplit(url).hostname == HOST
    assert len(path) > 32
    assert status_of(port, path) == 200
    assert status_of(port, f"{path}nothing") == 404
    for wrong in ("/", path[:-3], f"{path[:-1]}x/", "/index.html"):
        assert status_of(port, wrong) == 403, wrong
    assert status_of(port, path, Host=f"evil.example:{port}") == 403
    assert status_of(port, path, Origin="http://evil.example") == 403
    # The socket that transfers the scene.
    arguments = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec_WebSocket_Version": "13",
        "Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ==",
        "Sec_WebSocket_Protocol": f"viser-v{sys.modules['viser'].__version__}",
    }
    assert status_of(port, path[:-1], **arguments) == 101
    assert status_of(port, path[:-1], **arguments, Origin=f"http://{HOST}:{port}") == 101
    assert status_of(port, "/", **arguments) == 403
    assert status_of(port, path[:-1], **arguments, Origin="http://evil.example") == 403
    assert status_of(port, path[:-1], **arguments, Host=f"evil.example:{port}") == 403


def test_share_tunnel_is_disabled(server: tuple[Any, str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Viser's share tunnel makes a page public, and any page could request it."""
    viser, _ = server
    made: list[object] = []
    monkeypatch.setattr("viser._viser.ViserTunnel", lambda *a, **_: made.append(a))
    messages = sys.modules["viser._messages"]
    for handler in viser._websock_server._incoming_handlers[messages.ShareUrlRequest]:
        handler(0, messages.ShareUrlRequest())
    time.sleep(0.2)
    assert made == []
    assert viser.request_share_url() is None


def test_used_port_is_named(server: tuple[Any, str]) -> None:
    port = urlsplit(server[1]).port
    with pytest.raises(OSError, match=f"--port {port}: cannot listen there"), serve_viewer(port=port or 0):
        pass
    with pytest.raises(OSError, match=r"--host no\.such\.name"), serve_viewer("no.such.name"):
        pass


def test_missing_viser_message(
    result: Path, recording: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    for command in (["show", str(result)], ["track", str(recording), "--show", "--out", str(tmp_path / "out")]):
        assert main(command) == 2
        assert capsys.readouterr().err == f"sylpose: {VISER_MISSING}\n"
    assert not (tmp_path / "out").exists()


# --- the recording ----------------------------------------------------------------------------------------------------


def test_source_recording_is_found(result: Path, recording: Path) -> None:
    session = open_source_recording(result)
    frames = list(open_session(recording).frames(0, 3))
    with RandomAccessReader(session) as stills:
        for image, wanted in zip(stills.read_frame_set(2), frames[2].images, strict=True):
            np.testing.assert_array_equal(image, wanted)


def test_source_recording_with_frame_offsets(session: Path, tmp_path: Path) -> None:
    (session / "boxes.toml").unlink()
    arguments = ["track", str(session), "--stop", "2", "--no-overlay", "--out", str(tmp_path / "out")]
    (session / "offsets.toml").write_text("cam_2 = 0.05\n")
    assert main([*arguments, "--frame-offset", "cam_1=2"]) in (0, 1)
    opened_again = open_source_recording(tmp_path / "out")
    first = opened_again.timeline.frames[0]
    plain_ones = open_session(session).timeline.frames[0]
    assert first.tolist() != plain_ones.tolist()
    moved = session.rename(tmp_path / "elsewhere")
    with pytest.raises(FileNotFoundError):
        open_source_recording(tmp_path / "out")
    assert open_source_recording(tmp_path / "out", moved).timeline.frames[0].tolist() == first.tolist()


def test_changed_recording_is_rejected(session: Path, tmp_path: Path) -> None:
    track_session(open_session(session), tmp_path / "out", RunOptions(stop=2, overlay=False))
    settings = tmp_path / "out" / "settings.toml"
    text = settings.read_text()
    assert open_source_recording(tmp_path / "out").n_frames == FRAMES
    (session / "timestamps.csv").write_text(
        "frame,cam_0,cam_1,cam_2\n" + "".join(f"{k},{k / 20},{k / 20},{k / 20}\n" for k in range(FRAMES))
    )
    with pytest.raises(ValueError, match="the recording's timestamps or offsets are not those of the run"):
        open_source_recording(tmp_path / "out")
    (session / "timestamps.csv").unlink()
    with (session / "cam_0.mp4").open("ab") as file:
        file.write(b"\0" * 8)
    with pytest.raises(ValueError, match="the recording's images are not those of the run"):
        open_source_recording(tmp_path / "out")
    # Looking up such a name would send the user's credentials to that computer.
    for elsewhere in (r"\\evil.example\share", "//evil.example/share"):
        where = next(line for line in text.splitlines() if line.startswith("recording = "))
        settings.write_text(text.replace(where, f"recording = '{elsewhere}'"))
        with pytest.raises(ValueError, match="on another computer"):
            open_source_recording(tmp_path / "out")
    settings.write_text(text.partition("[cameras]")[0])
    with pytest.raises(ValueError, match="there is no recording"):
        open_source_recording(tmp_path / "out")
    settings.write_text("recording = 3\n")
    with pytest.raises(ValueError, match=r"settings\.toml: expected the settings of a run"):
        open_source_recording(tmp_path / "out")
    settings.unlink()
    with pytest.raises(FileNotFoundError, match=r"no settings\.toml"):
        open_source_recording(tmp_path / "out")


# --- what is drawn ----------------------------------------------------------------------------------------------------


def test_path_gaps_and_colors() -> None:
    places = np.arange(30.0).reshape(10, 3)
    places[4] = np.nan
    statuses = [FrameStatus.TRACKED.value] * 10
    statuses[7] = FrameStatus.COASTING.value
    pieces = split_path(places, statuses)
    assert set(pieces) == {TRACKED_COLOR, status_color(FrameStatus.COASTING.value)}
    starts = sorted(int(piece[0, 0]) // 3 for its in pieces.values() for piece in its)
    assert starts == [0, 1, 2, 5, 6, 7, 8]
    np.testing.assert_array_equal(pieces[status_color("coasting")], places[None, 6:8])
    assert split_path(np.full((3, 3), np.nan), ["lost"] * 3) == {}
    assert split_path(np.empty((0, 3)), []) == {}


def test_long_path_is_subsampled_with_gaps() -> None:
    n = 2 * MAX_PATH_SEGMENTS + 7
    places = np.column_stack([np.arange(n), np.zeros(n), np.zeros(n)]).astype(float)
    places[1001] = np.nan
    (pieces,) = split_path(places, [FrameStatus.TRACKED.value] * n).values()
    assert MAX_PATH_SEGMENTS / 2 < len(pieces) <= MAX_PATH_SEGMENTS
    assert not ((pieces[:, 0, 0] < 1001) & (pieces[:, 1, 0] > 1001)).any()
    way = ObjectPath(max_points=64)
    for k in range(5000):
        way.add(np.full(3, np.nan) if k == 1001 else np.array([k, 0.0, 0.0]), FrameStatus.TRACKED.value)
        assert len(way.positions) < 64 == way._max_points
        assert len(way.positions) == len(way.statuses)
    assert len(way.positions) > 30
    (pieces,) = split_path(np.array(way.positions), way.statuses).values()
    assert not ((pieces[:, 0, 0] < 1001) & (pieces[:, 1, 0] > 1001)).any()
    assert pieces[0, 0, 0] < 200
    assert pieces[-1, 1, 0] > 4700


def test_text_is_escaped_for_markdown() -> None:
    assert escape_markdown("<img src=x onerror=alert(1)>\n# **a** {b}") == (
        r"\<img src\=x onerror\=alert\(1\)\> \# \*\*a\*\* \{b\}"
    )
    assert escape_markdown("0,3° länger") == r"0\,3° länger"


def test_slider_moves_object(browser: Any, server: tuple[Any, str], result: Path) -> None:
    viser, url = server
    scenes = read_scenes(result)
    # A name that would be markup if it were not escaped.
    (scene,) = scenes.values()
    scenes = {"": replace(scene, cameras=("<img src=x>", *scene.cameras[1:]))}
    rig = calibration.load(result / "calibration.used.toml")
    with (
        RandomAccessReader(open_source_recording(result)) as stills,
        ResultPlayer(viser, scenes, rig, stills, "a <b>title</b>") as player,
    ):
        nodes = player.page._objects[""]
        before = np.array(nodes.axes.position)
        until(lambda: all(image.visible for image in player.page._recorded_images))
        with open_page(browser, url, online=True, viewport=SMALL) as shown:
            shown.page.get_by_role("slider").first.wait_for(timeout=60_000)
            until(lambda: viser.get_clients())
            shown.page.get_by_text("a <b>title</b>").first.wait_for()
            shown.page.get_by_text(f"Frame 0, 0.000 s, 1 of {TRACKED}").first.wait_for()
            shown.page.wait_for_timeout(500)
            first = shown.page.screenshot(timeout=60_000)
            slider = shown.page.get_by_role("slider").first
            slider.focus()
            slider.press("End")
            until(lambda: player.current == TRACKED - 1)
            last = scene.world_from_object[-1, :3, 3]
            np.testing.assert_allclose(nodes.axes.position, (last - scene.center) / scene.camera_distance, atol=1e-9)
            assert np.linalg.norm(nodes.axes.position - before) > 1e-3
            # The nodes of a frame are updated one after another.
            until(lambda: nodes.axes.visible and nodes.ellipsoid.visible)
            shown.page.get_by_text(f"{TRACKED} of {TRACKED}").wait_for(timeout=60_000)
            shown.page.wait_for_timeout(500)
            assert shown.page.screenshot(timeout=60_000) != first
            # Camera view: the camera's image is behind the object, and its frustum is hidden.
            player.page.set_view(next(iter(viser.get_clients().values())), 1)
            depth = player.page._recorded_images[1].scale
            assert depth > 1.0 > player.page._recorded_images[0].scale
            assert [lines.visible for lines in player.page._lines] == [True, False, True]
            assert shown.page.locator("img[src=x]").count() == 0
            assert wrong_in(shown) == []
            assert all(address.startswith((url, "blob:")) for address in shown.requests)


def test_view_moves_position_and_target_of_a_client(server: tuple[Any, str], result: Path) -> None:
    """A camera's view looks from its center through the image; the view of all looks at the origin of the page."""
    viser, _ = server
    scenes, rig = read_scenes(result), calibration.load(result / "calibration.used.toml")
    with ResultPlayer(viser, scenes, rig, None, "title") as player:
        assert tuple(viser.initial_camera.look_at) == (0.0, 0.0, 0.0)
        client = SimpleNamespace(camera=SimpleNamespace(), atomic=nullcontext)
        player.page.set_view(client, None)
        assert client.camera.look_at == (0.0, 0.0, 0.0)
        player.page.set_view(client, 1)
        camera, scene = rig.cameras[1], next(iter(scenes.values()))
        np.testing.assert_allclose(
            client.camera.position, (camera.center - scene.center) / scene.camera_distance, atol=1e-6
        )
        direction = np.subtract(client.camera.look_at, client.camera.position)
        # The image's middle is near the optical axis.
        assert direction @ camera.direction > 0.95 * np.linalg.norm(direction)


def test_playback_to_the_end(server: tuple[Any, str], result: Path) -> None:
    viser, _ = server
    rig = calibration.load(result / "calibration.used.toml")
    player = ResultPlayer(viser, read_scenes(result), rig, None, "title")
    # Outside the `with` block, no thread plays: on a busy machine it could end between two lines.
    assert player.button.label == "Play"
    player.play(True)
    assert player.button.label == "Pause"
    with player:
        until(lambda: player.current == TRACKED - 1)
        until(lambda: player.button.label == "Play")
    player.play(True)  # once more, from the first frame
    assert player.current < TRACKED - 1
    player.play(False)
    # Layers.
    player.page.visible["Points"] = False
    player.page.refresh()
    nodes = player.page._objects[""]
    assert not nodes.points.visible
    assert nodes.axes.visible
    assert nodes.path[TRACKED_COLOR].visible
    player.page.visible["Path"] = False
    player.page.refresh()
    assert not nodes.path[TRACKED_COLOR].visible


def test_frame_without_pose(server: tuple[Any, str], result: Path) -> None:
    viser, _ = server
    (scene,) = read_scenes(result).values()
    poses = scene.world_from_object.copy()
    poses[2] = np.nan
    statuses = (*scene.status[:2], "lost", *scene.status[3:])
    reasons = (*scene.reason[:2], "nothing <i>was</i> seen", *scene.reason[3:])
    scenes = {"": replace(scene, world_from_object=poses, status=statuses, reason=reasons)}
    with ResultPlayer(viser, scenes, calibration.load(result / "calibration.used.toml"), None, "title") as player:
        player.show(2)
        nodes = player.page._objects[""]
        assert not nodes.axes.visible
        assert not nodes.ellipsoid.visible
        assert "**lost**" in player.description.content
        assert r"nothing \<i\>was\<\/i\> seen" in player.description.content
        player.show(3)
        assert nodes.axes.visible


def test_several_objects_on_one_page(server: tuple[Any, str], result: Path, tmp_path: Path) -> None:
    viser, _ = server
    for name in ("mug", "tray"):
        (tmp_path / name).mkdir()
        for file in ("trajectory.csv", "object.npz"):
            if (result / file).exists():
                (tmp_path / name / file).write_bytes((result / file).read_bytes())
    (tmp_path / "calibration.used.toml").write_bytes((result / "calibration.used.toml").read_bytes())
    scenes = read_scenes(tmp_path)
    assert list(scenes) == ["mug", "tray"]
    assert collect_frames(scenes)[0].tolist() == list(range(TRACKED))
    rig = calibration.load(tmp_path / "calibration.used.toml")
    scenes["tray"] = replace(scenes["tray"], unit="first distances")  # as of an object of one camera
    with ResultPlayer(viser, scenes, rig, None, "two") as player:
        player.show(3)
        assert {name: nodes.axes.visible for name, nodes in player.page._objects.items()} == {"mug": True, "tray": True}
        assert "mug" in player.description.content
        assert "tray" in player.description.content
        positions = [line for line in player.description.content.splitlines() if line.startswith("at ")]
        assert ["first distances" in line for line in positions] == [False, True]
    with pytest.raises(FileNotFoundError, match="a folder that sylpose track wrote"):
        read_scenes(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"trajectory\.csv"):
        read_scenes(tmp_path / "empty")


# --- stand-alone ------------------------------------------------------------------------------------------------------


def test_standalone_page(browser: Any, result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("viser", reason="the extra `viewer`")
    page = tmp_path / "scene.html"
    assert main(["show", str(result), "--save", str(page)]) == 0
    assert str(page) in capsys.readouterr().out
    assert page.stat().st_size < 8e6
    with open_page(browser, page.as_uri(), viewport=SMALL) as shown:
        shown.page.locator("canvas").first.wait_for(timeout=60_000)
        shown.page.wait_for_timeout(1000)
        assert wrong_in(shown) == []
        assert all(address.startswith(("file:", "blob:")) for address in shown.requests)


def test_invalid_results(result: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def sentence(*args: object) -> str:
        assert main(["show", *map(str, args), "--no-browser"]) == 2
        return capsys.readouterr().err

    assert "expected a folder that sylpose track wrote" in sentence(tmp_path / "nowhere")
    assert "nowhere: no such folder" in sentence(result, "--recording", tmp_path / "nowhere")


# --- live page --------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("undrawn")
def test_show_does_not_change_results(
    recording: Path, result: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("viser", reason="the extra `viewer`")
    drawn: list[int] = []
    draw = LivePage._draw_object

    def seen(page: LivePage, name: str, tracked: TrackedFrame) -> str:
        drawn.append(tracked.pose.index)
        return draw(page, name, tracked)

    monkeypatch.setattr(LivePage, "_draw_object", seen)
    arguments = ["track", str(recording), "--show", "--no-browser", "--stop", str(TRACKED), "--no-overlay"]
    assert main([*arguments, "--out", str(tmp_path / "shown")]) == 0
    message = capsys.readouterr()
    assert "Open http://127.0.0.1:" in message.out
    assert f"To see it again: sylpose show {tmp_path / 'shown'}" in message.out
    assert "the page" not in message.err
    assert drawn
    for name in ("trajectory.tum", "trajectory.csv", "tracked.tum", "tracked.csv"):
        assert (tmp_path / "shown" / name).read_bytes() == (result / name).read_bytes(), name


def test_tracker_does_not_wait_for_page(
    server: tuple[Any, str], recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frames that arrive during drawing are skipped, but stay in the path; a failing page reports it once."""
    viser, _ = server
    session = open_session(recording)
    frames = list(track(session.frames(0, 4), session.rig, session.boxes))
    let_go, looks, draw = threading.Event(), list[int](), LivePage._draw

    def slow(page: LivePage) -> None:
        looks.append(len(looks))
        assert let_go.wait(60)
        draw(page)

    monkeypatch.setattr(LivePage, "_draw", slow)
    with LivePage(viser, session.rig, {"object": session.rig.unit}, "title") as page:
        for tracked in frames:  # all of them, before the page has drawn one
            page.update("object", tracked)
        assert len(looks) <= 1
        let_go.set()
        nodes = page.page._objects["object"]
        until(lambda: nodes.axes.visible and len(nodes.path[TRACKED_COLOR].points) == len(frames) - 1)
        until(lambda: f"Frame {frames[-1].pose.index}" in page.status_text.content)
        until(lambda: all(image.visible for image in page.page._recorded_images))
        assert nodes.points.visible

        def broken(*_: object) -> None:
            raise RuntimeError("no more")

        monkeypatch.setattr(page.page, "set_pose", broken)
        page.update("object", frames[0])
        until(lambda: page.error)
        assert page.error == "the page stopped updating (RuntimeError: no more)"
        page.update("object", frames[1])
