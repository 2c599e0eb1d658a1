"""report.html of runs: made at their end, the same after an interruption, and made anew by `sylpose report`."""

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

from sylpose.app.page import make_page
from sylpose.app.run import track_session
from sylpose.app.thumbnails import FEWEST, Album, step_after
from sylpose.capture import open_session
from sylpose.cli import main
from sylpose.frames import FrameSet
from sylpose.report.formats import PAGE
from sylpose.report.scene import Stills

FRAMES = 6


def sets(positions: range) -> Iterator[FrameSet]:
    for k in positions:
        image = np.full((6, 8, 3), k % 200, np.uint8)
        yield FrameSet(100 + 3 * k, float(k), (None, None), (image, None), (None, None))


@pytest.mark.parametrize("n", [1, FEWEST, 2 * FEWEST - 1, 2 * FEWEST, 2 * FEWEST + 1, 301])
def test_an_album_is_spread_evenly_and_bounded(n: int) -> None:
    album = Album(2)
    for frames in sets(range(n)):
        album.put(frames)
    stills = album.stills()
    step = step_after(n)
    assert stills.index.tolist() == [100 + 3 * k for k in range(0, n, step)]
    assert min(n, FEWEST) <= len(stills.index) < 2 * FEWEST
    for number, (first, second) in zip(stills.index, stills.images, strict=True):
        assert second is None
        assert first is not None
        seen = np.asarray(cv2.imdecode(np.frombuffer(first, np.uint8), cv2.IMREAD_COLOR), float)
        assert abs(float(np.mean(seen)) - (number - 100) // 3 % 200) < 3


@pytest.mark.parametrize(("n", "at"), [(5, 2), (60, 47), (60, 48), (200, 100), (200, 199)])
def test_an_album_goes_on_as_if_nothing_had_been(n: int, at: int) -> None:
    whole, again = Album(2), Album(2)
    for frames in sets(range(n)):
        whole.put(frames)
    again.go_on(at, sets(range(0, at, step_after(at))))
    for frames in sets(range(at, n)):
        again.put(frames)
    assert again.stills().index.tolist() == whole.stills().index.tolist()
    assert again.stills().images == whole.stills().images


def run(recording: Path, out: Path, **options: Any) -> bytes:
    track_session(open_session(recording), out, stop=FRAMES, overlay=False, **options)
    return undated(out / PAGE)


def undated(page: Path) -> bytes:
    """Without when the run began."""
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


def test_an_interrupted_run_comes_to_the_same_page(recording: Path, whole: Path, tmp_path: Path) -> None:
    asked = itertools.count(1)
    with pytest.raises(KeyboardInterrupt):
        run(recording, tmp_path, interrupted=lambda: next(asked) == 4)
    assert len(images_in(tmp_path / PAGE)["index"]) == 4
    assert run(recording, tmp_path, resume=True) == undated(whole / PAGE)
    assert images_in(tmp_path / PAGE)["index"] == list(range(FRAMES))


def test_a_page_is_made_anew(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "out"
    shutil.copytree(whole, folder)
    page = (whole / PAGE).read_bytes()
    # From the page that is there; from the recording.
    for there in (True, False):
        if not there:
            (folder / PAGE).unlink()
        assert main(["report", str(folder)]) == 0
        said = capsys.readouterr().out
        assert said == f"File          {folder / PAGE}\n"
        assert (folder / PAGE).read_bytes() == page
    # Of a recording that is not as it was, no images.
    (folder / PAGE).unlink()
    settings = (folder / "settings.toml").read_text()
    (folder / "settings.toml").write_text(re.sub('images = "....', 'images = "abcd', settings))
    assert main(["report", str(folder)]) == 0
    said = capsys.readouterr().out
    assert "a page without images" in said
    assert "the recording's images are not those of the run" in said
    assert images_in(folder / PAGE)["index"] == []
    # What is no page is not taken for one.
    (folder / PAGE).write_text("<p>mine</p>")
    assert main(["report", str(folder)]) == 2
    assert "report.html: no page of sylpose" in capsys.readouterr().err
    assert (folder / PAGE).read_text() == "<p>mine</p>"


def test_what_looked_wrong_before_the_run_is_in_it(session: Path, tmp_path: Path) -> None:
    boxes = (session / "boxes.toml").read_text().splitlines()
    (session / "boxes.toml").write_text("\n".join(boxes[:2]))
    track_session(open_session(session), tmp_path, stop=3, overlay=False)
    page = (tmp_path / PAGE).read_text(encoding="utf-8")
    said = "A box in one camera only (cam_0): it does not tell how far away the object is"
    assert f"<li>{said}" in page
    assert "<h2>What looked wrong before the run</h2>" in page


def test_a_folder_without_a_record_has_a_page(whole: Path, tmp_path: Path) -> None:
    """As 0.1.0 left them, beside a calibration."""
    shutil.copy(whole / "trajectory.csv", tmp_path)
    shutil.copy(whole / "calibration.used.toml", tmp_path)
    page = make_page(tmp_path, Stills()).read_text(encoding="utf-8")
    assert f"<h1>{tmp_path.name}</h1>" in page
    assert "sylpose report" in page


def test_no_trajectory_is_no_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(tmp_path)]) == 2
    assert "trajectory.csv: no such file" in capsys.readouterr().err
