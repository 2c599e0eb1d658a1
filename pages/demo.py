"""Rebuild the documents' pictures of the demo.

    python -m pages.demo        four minutes on two cores, with the browser of the tests (`make browser`)

Writes docs/images/demo.png, report.png, report_html.png and certificate.png.
"""

from __future__ import annotations

import io
from pathlib import Path
from tempfile import TemporaryDirectory

import av
import numpy as np
from PIL import Image

from pages.gallery import DOCS
from sylpose.commands.certify import CertifyOptions, certify
from sylpose.commands.demo import DemoOptions, demo
from sylpose.report.files import read_trajectory
from sylpose.report.plots import INK, X_COLOR, Y_COLOR, Z_COLOR, create_figure, style_panel
from sylpose.results import Trajectory
from tests.chromium import launch_browser, open_page

# The frame whose images are shown, and the picture's width in pixels (choice).
FRAME, WIDTH = 32, 1378
# Size of the browser window, pixels.
WINDOW = {"width": 1300, "height": 905}


def curves(trajectory: Trajectory, height: float) -> Image.Image:
    """Plot angles and position over time, with the shown frame marked."""
    figure = create_figure(4.7, height)
    angles, position = figure.subplots(2, 1, sharex=True)
    at = trajectory.times
    turns = np.degrees([frame.pan_tilt_roll for frame in trajectory])
    moved = 1000 * (trajectory.positions - trajectory.positions[0])
    for panel, values, names, colors in (
        (angles, turns, ("pan", "tilt", "roll"), (Y_COLOR, X_COLOR, Z_COLOR)),
        (position, moved, ("x", "y", "z"), (X_COLOR, Y_COLOR, Z_COLOR)),
    ):
        apart, last = 0.06 * np.ptp(values), -np.inf
        for k in np.argsort(values[-1]):
            last = max(values[-1, k], last + apart)  # labels must not overlap
            panel.plot(at, values[:, k], color=colors[k], linewidth=2)
            panel.annotate(names[k], (at[-1], last), (4, 0), textcoords="offset points", color=colors[k], va="center")
        panel.axvline(at[FRAME], color=INK, alpha=0.5, linewidth=1.2)
        style_panel(panel)
        panel.set_xlim(at[0], 1.12 * at[-1])
    angles.set_ylabel("angle (degrees)")
    position.set_ylabel("position since the start (mm)")
    position.set_xlabel("time (s)")
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return Image.open(file).convert("RGB")


def beside(seen: Image.Image, trajectory: Trajectory) -> Image.Image:
    """Combine the images of a frame, as in overlay.mp4, with the plots."""
    width = round(0.625 * WIDTH)
    seen = seen.resize((width, round(seen.height * width / seen.width)), Image.Resampling.LANCZOS)
    plots = curves(trajectory, 4.7 * seen.height / (WIDTH - width))
    whole = Image.new("RGB", (WIDTH, seen.height), "white")
    whole.paste(seen, (0, 0))
    whole.paste(plots.resize((WIDTH - width, seen.height), Image.Resampling.LANCZOS), (width, 0))
    return whole


def _save(image: Image.Image, path: Path) -> None:
    """Save with 256 colors, a quarter of the bytes; maximum coverage keeps thin lines."""
    image.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=1, dither=Image.Dither.NONE).save(path, optimize=True)


def picture_certificate(file: Path) -> Image.Image:
    """Take a picture of the upper part of a certificate."""
    with (
        launch_browser() as browser,
        open_page(browser, file.as_uri(), viewport={"width": 1200, "height": 750}) as page,
    ):
        return Image.open(io.BytesIO(page.page.screenshot())).convert("RGB")


def main() -> None:
    images = DOCS / "images"
    with TemporaryDirectory() as temporary:
        folder = Path(temporary) / "demo"
        demo(DemoOptions(out=folder))
        results = folder / "sylpose"
        with av.open(str(results / "overlay.mp4")) as video:
            seen = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)][FRAME]
        picture = beside(Image.fromarray(seen), read_trajectory(results / "trajectory.csv"))
        _save(picture, images / "demo.png")
        _save(Image.open(results / "report.png").convert("RGB"), images / "report.png")
        with (
            launch_browser() as browser,
            open_page(browser, (results / "report.html").as_uri(), viewport=WINDOW) as page,
        ):
            for _ in range(4):
                page.page.locator("body").press("Shift+ArrowRight")
            page.page.wait_for_timeout(1500)
            shot = Image.open(io.BytesIO(page.page.screenshot())).convert("RGB")
        _save(shot, images / "report_html.png")
        certify(CertifyOptions(session=folder))
        _save(picture_certificate(results / "certificate.html"), images / "certificate.png")


if __name__ == "__main__":
    main()
