"""Sessions: the frames of all cameras at one instant, from videos or image folders."""

from sylpose.capture.session import Session, open_session
from sylpose.capture.sources import Source
from sylpose.capture.timeline import Timeline

__all__ = ["Session", "Source", "Timeline", "open_session"]
