"""What to know about a session before it is tracked."""

from __future__ import annotations

import shlex

import numpy as np

from sylpose.capture import Session
from sylpose.capture.live import LiveSession

__all__ = ["boxes_by", "notes"]

# Time stamps of one frame set that are further from their mean than this, frames, are said to be wrong (choice:
# a frame late beside a frame early is what cameras without a common trigger do).
FAR_APART = 2.0


def notes(session: Session | LiveSession, start: int = 0) -> list[str]:
    """What to know about a session before it is tracked from frame `start` on, in sentences."""
    found = [*session.warnings]
    if isinstance(session, LiveSession):
        return found
    n, parts = session.n_frames, []
    for name, column in zip(session.rig.names, session.timeline.frames.T, strict=True):
        shown = np.flatnonzero(column >= 0)
        if not len(shown):
            parts.append(f"{name} has none of them")
        elif len(shown) < n:
            missing = int(shown[-1] - shown[0] + 1 - len(shown))
            within = f" without {missing} in between" if missing else ""
            parts.append(f"{name} has {shown[0]} to {shown[-1]}{within}")
    if parts:
        found.append(f"Not every camera has all frames 0 to {n - 1}: {', '.join(parts)}.")
    apart = session.timeline.stamps - session.timeline.times[:, None]
    if session.rate and np.nanmax(np.abs(apart), initial=0.0) * session.rate > FAR_APART:
        worst = float(np.nanmax(np.abs(apart)))
        found.append(
            f"The cameras' time stamps of one frame set are up to {worst:.3g} s from their mean: frames of different times "
            "are taken for one. Are the clocks the same?"
        )
    # All objects have boxes or none.
    if session.of(session.objects[0]).boxes and start > 0:
        found.append(f"The boxes are taken to be of frame {start}, where tracking starts.")
    return found


def boxes_by(session: Session | LiveSession) -> str:
    """What to type for boxes of a session."""
    return "--boxes" if isinstance(session, LiveSession) else f"sylpose box {shlex.quote(str(session.path))} draws them"
