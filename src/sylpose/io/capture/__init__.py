"""Recordings and live sessions: synchronized frame sets from videos, image folders and streams.

| module | content |
|---|---|
| `sources`, `RecordingFolder` | which file of a folder is of which camera: the place for other programs' folders |
| `sources`, `Source` | what a file states: size, frame count, rate; the place for time stamps and orientation |
| `timeline` | frame of each camera and time of each frame set, from sources or timestamps.csv |
| `images`, `frame_readers`, `random_access` | pixels, as coded: of one file, in order, in any order |
| `boxes`, `names` | regions of the objects; file names and cameras |
| `session` | a recording |
| `live`, `streams`, `frame_assembly`, `growing` | cameras, network streams and growing folders |
"""

from sylpose.io.capture.session import Session, open_session
from sylpose.io.capture.sources import Source
from sylpose.io.capture.timeline import Timeline

__all__ = ["Session", "Source", "Timeline", "open_session"]
