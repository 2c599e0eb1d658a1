"""report.html of runs: written at the end, the same after an interruption, and rebuilt by `sylpose report`."""

from __future__ import annotations

import itertools
import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sylpose.commands.main import main
from sylpose.frames import FrameSet
from sylpose.io.capture import open_session
from sylpose.report.files import PAGE_FILE
from sylpose.report.scene import Thumbnails
from sylpose.runs.options import RunOptions
from sylpose.runs.page import MIN_THUMBNAILS, ThumbnailAlbum, thumbnail_step, write_report_page
from sylpose.runs.run import track_session

FRAMES = 4


def sets(positions: range) -> Iterator[FrameSet]:
    for k in positions:
        image = np.full((6, 8, 3), k % 200, np.uint8)
        yield FrameSet(100 + 3 * k, float(k), (None, None), (image, None), (None, None))


@pytest.mark.parametrize(
    "n", [1, MIN_THUMBNAILS, 2 * MIN_THUMBNAILS - 1, 2 * MIN_THUMBNAILS, 2 * MIN_THUMBNAILS + 1, 301]
)
def test_album_is_evenly_spread_and_bounded(n: int) -> None:
    album = ThumbnailAlbum(2)
    for frames in sets(range(n)):
        album.put(frames)
    stills = album.stills()
    step = thumbnail_step(n)
    assert stills.index.tolist() == [100 + 3 * k for k in range(0, n, step)]
    assert min(n, MIN_THUMBNAILS) <= len(stills.index) < 2 * MIN_THUMBNAILS
    for number, (first, second) in zip(stills.index, stills.images, strict=True):
        assert second is None
        assert first is not None
        seen = np.asarray(cv2.imdecode(np.frombuffer(first, np.uint8), cv2.IMREAD_COLOR), float)
        assert abs(float(np.mean(seen)) - (number - 100) // 3 % 200) < 3


@pytest.mark.parametrize(("n", "at"), [(5, 2), (60, 47), (60, 48), (200, 100), (200, 199)])
def test_album_after_resume(n: int, at: int) -> None:
    whole, again = ThumbnailAlbum(2), ThumbnailAlbum(2)
    for frames in sets(range(n)):
        whole.put(frames)
    again.restore(at, sets(range(0, at, thumbnail_step(at))))
    for frames in sets(range(at, n)):
        again.put(frames)
    assert again.stills().index.tolist() == whole.stills().index.tolist()
    assert again.stills().images == whole.stills().images


def run(recording: Path, out: Path, interrupted: Any = None, **options: Any) -> bytes:
    options |= {"stop": FRAMES, "overlay": False, "smooth": False}
    track_session(open_session(recording), out, RunOptions(**options), interrupted=interrupted)
    return undated(out / PAGE_FILE)


def undated(page: Path) -> bytes:
    """Return the page without the start time of the run."""
    return re.sub(rb"20\d\d-\d\d-\d\d[ T]\d\d:\d\d[^<]*", b"then", page.read_bytes())


@pytest.fixture(scope="module")
def whole(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("out")
    run(recording, out)
    return out


def images_in(page: Path) -> Any:
    found = re.search('id="images-data">(.*?)</script>', page.read_text(encoding="utf-8"), re.S)
    assert found is not None
    return json.loads(found[1])


def test_interrupted_run_yields_same_page(recording: Path, whole: Path, tmp_path: Path) -> None:
    arguments = itertools.count(1)
    with pytest.raises(KeyboardInterrupt):
        run(recording, tmp_path, interrupted=lambda: next(arguments) == 3)
    assert len(images_in(tmp_path / PAGE_FILE)["index"]) == 3
    assert run(recording, tmp_path, resume=True) == undated(whole / PAGE_FILE)
    assert images_in(tmp_path / PAGE_FILE)["index"] == list(range(FRAMES))


def test_report_rebuilds_page(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "out"
    shutil.copytree(whole, folder)
    page = (whole / PAGE_FILE).read_bytes()
    # With the images of the existing page; with those of the recording.
    for there in (True, False):
        if not there:
            (folder / PAGE_FILE).unlink()
        assert main(["report", str(folder)]) == 0
        message = capsys.readouterr().out
        assert message == f"File          {folder / PAGE_FILE}\n"
        assert (folder / PAGE_FILE).read_bytes() == page
    # A changed recording yields no images.
    (folder / PAGE_FILE).unlink()
    settings = (folder / "settings.toml").read_text()
    (folder / "settings.toml").write_text(re.sub('images = "....', 'images = "abcd', settings))
    assert main(["report", str(folder)]) == 0
    message = capsys.readouterr().out
    assert "the page has no images" in message
    assert "the recording's images are not those of the run" in message
    assert images_in(folder / PAGE_FILE)["index"] == []
    # Another file is not accepted as a page.
    (folder / PAGE_FILE).write_text("<p>mine</p>")
    assert main(["report", str(folder)]) == 2
    assert "report.html: not a page of sylpose" in capsys.readouterr().err
    assert (folder / PAGE_FILE).read_text() == "<p>mine</p>"


def test_page_contains_warnings(session: Path, tmp_path: Path) -> None:
    boxes = (session / "boxes.toml").read_text().splitlines()
    (session / "boxes.toml").write_text("\n".join(boxes[:2]))
    track_session(open_session(session), tmp_path, RunOptions(stop=2, overlay=False, smooth=False))
    page = (tmp_path / PAGE_FILE).read_text(encoding="utf-8")
    message = "Only one camera has a box (cam_0): the object"
    assert f"<li>{message}" in page
    assert "<h2>Problems found before the run</h2>" in page


def test_page_without_settings(whole: Path, tmp_path: Path) -> None:
    """Use a folder as written by 0.1.0, next to a calibration."""
    shutil.copy(whole / "trajectory.csv", tmp_path)
    shutil.copy(whole / "calibration.used.toml", tmp_path)
    page = write_report_page(tmp_path, Thumbnails()).read_text(encoding="utf-8")
    assert f"<h1>{tmp_path.name}</h1>" in page
    assert "sylpose report" in page


def test_missing_trajectory(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(tmp_path)]) == 2
    assert "no result in it; expected a recording that was tracked" in capsys.readouterr().err
