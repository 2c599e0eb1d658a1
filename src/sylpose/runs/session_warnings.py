"""Warnings about a session before it is tracked."""

from __future__ import annotations

import shlex

import numpy as np

from sylpose.io.capture import Session
from sylpose.io.capture.live import LiveSession
from sylpose.runs.console_output import select_solved_frames
from sylpose.runs.run_result import Run

__all__ = ["boxes_hint", "explain_failures", "find_session_warnings"]

# Timestamps of one frame set that deviate more from their mean, frames, cause a warning (choice: cameras without a
# common trigger reach one frame in either direction).
MAX_TIMESTAMP_SPREAD = 2.0


def find_session_warnings(session: Session | LiveSession, start: int = 0) -> list[str]:
    """Return warnings about a session that is tracked from frame `start` on, as sentences."""
    warnings = [*session.warnings]
    if isinstance(session, LiveSession):
        return warnings
    n, parts = session.n_frames, []
    for name, column in zip(session.rig.names, session.timeline.frames.T, strict=True):
        present = np.flatnonzero(column >= 0)
        if not len(present):
            parts.append(f"{name} has none of them")
        elif len(present) < n:
            missing = int(present[-1] - present[0] + 1 - len(present))
            gap_text = f" without {missing} in between" if missing else ""
            parts.append(f"{name} has {present[0]} to {present[-1]}{gap_text}")
    if parts:
        warnings.append(f"Not every camera has all frames 0 to {n - 1}: {', '.join(parts)}.")
    deviations = session.timeline.stamps - session.timeline.times[:, None]
    if session.rate and np.nanmax(np.abs(deviations), initial=0.0) * session.rate > MAX_TIMESTAMP_SPREAD:
        worst = float(np.nanmax(np.abs(deviations)))
        warnings.append(
            f"The cameras' timestamps of one frame set are up to {worst:.3g} s from their mean, so frames of different "
            "times are combined. Check that the clocks are synchronized."
        )
    # All objects have boxes or none.
    if session.select_object(session.objects[0]).boxes and start > 0:
        warnings.append(f"The boxes are assumed to be of frame {start}, where tracking starts.")
    return warnings


def boxes_hint(session: Session | LiveSession) -> str:
    """Return the option or command that provides boxes for a session."""
    return "--boxes" if isinstance(session, LiveSession) else f"sylpose box {shlex.quote(str(session.path))} draws them"


def explain_failures(session: Session | LiveSession, run: Run) -> list[str]:
    """Explain for each object without a solved frame why there is none, one sentence per object."""
    reasons = []
    for name, trajectory in run.trajectories.items():
        if select_solved_frames(trajectory):
            continue
        prefix = f"{name}: " if len(run.trajectories) > 1 else ""
        statuses = [frame.status for frame in trajectory if frame.world_from_object is None]
        if not len(trajectory):
            reasons.append(f"{prefix}no frame was tracked")
        elif not statuses:
            reasons.append(
                f"{prefix}no motion could be estimated: there is only the first frame, the reference of all poses"
            )
        else:
            sentence = f"{prefix}no frame could be solved. {max(statuses, key=statuses.count).text}"
            if not session.select_object(name).boxes and session.masks is None:
                sentence += (
                    f" Provide boxes of the object in the first frame ({boxes_hint(session)}) or masks (--masks) to "
                    "select it."
                )
            reasons.append(sentence)
    return reasons
