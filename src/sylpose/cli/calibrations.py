"""`sylpose calibration convert`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sylpose.cli.asked import app, examples, spoken

__all__ = ["convert"]


calibration_app = typer.Typer(help="Calibration files: convert.", no_args_is_help=True, rich_markup_mode=None)
app.add_typer(calibration_app, name="calibration")


@calibration_app.command(epilog=examples("sylpose calibration convert camera_array.toml calibration.yml"))
@spoken
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="Calibration in any format that sylpose reads.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="A .toml (sylpose's), .yml, .json or .xml (OpenCV's).")],
) -> None:
    """Write a calibration in another format.

    Read are sylpose, Anipose and Caliscope TOML, and OpenCV FileStorage YAML, JSON and XML; written are sylpose TOML and
    OpenCV FileStorage.
    """
    from sylpose import calibration

    rig = calibration.load(source)
    calibration.save(rig, target)
    print(f"{target}: {len(rig)} cameras ({', '.join(rig.names)})")
