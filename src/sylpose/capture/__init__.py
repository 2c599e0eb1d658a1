"""Recordings and live sessions: synchronized frame sets from videos, image folders and streams."""

from sylpose.capture.session import Session, open_session
from sylpose.capture.sources import Source
from sylpose.capture.timeline import Timeline

__all__ = ["Session", "Source", "Timeline", "open_session"]
