"""Recordings and live sessions: synchronized frame sets from videos, image folders and streams."""

from sylpose.io.capture.session import Session, open_session
from sylpose.io.capture.sources import Source
from sylpose.io.capture.timeline import Timeline

__all__ = ["Session", "Source", "Timeline", "open_session"]
