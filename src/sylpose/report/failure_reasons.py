"""Why a run has no pose, in sentences."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from sylpose.results import Trajectory

__all__ = ["alike", "why_nothing"]

# So many sentences say why there is no pose.
MOST_REASONS = 8
# A number that stands by itself, not one within a name.
_NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?!\w)")


def why_nothing(trajectory: Trajectory) -> list[str]:
    """What happened to the frames of a trajectory without any pose, in sentences."""
    said = [
        f"{_frames(count)}: {status.value}. {status.text}"
        for status, count in Counter(f.status for f in trajectory).most_common()
    ]
    reasons = alike([f.reason for f in trajectory if f.reason])
    said += [f"{_frames(count)}: {reason}" for reason, count in reasons[:MOST_REASONS]]
    if len(reasons) > MOST_REASONS:
        said.append(f"and {len(reasons) - MOST_REASONS} more reasons: see the column reason of trajectory.csv")
    return said


def alike(sentences: Sequence[str]) -> list[tuple[str, int]]:
    """Sentences that differ in their numbers only as one, with the least and the most of each, and how many they are; the
    most frequent first."""
    groups = dict[str, list[list[str]]]()
    for sentence in sentences:
        groups.setdefault(_NUMBER.sub("0", sentence), []).append(_NUMBER.findall(sentence))
    said = [(_with(pattern, list(zip(*numbers, strict=True))), len(numbers)) for pattern, numbers in groups.items()]
    return sorted(said, key=lambda one: -one[1])


def _with(pattern: str, numbers: Sequence[Sequence[str]]) -> str:
    """A sentence with what each of its numbers has been."""
    ranges = [(min(these, key=float), max(these, key=float)) for these in numbers]
    words = iter(low if float(low) == float(high) else f"{low} to {high}" for low, high in ranges)
    return _NUMBER.sub(lambda _: next(words), pattern)


def _frames(count: int) -> str:
    return f"{count} frame{'s' if count > 1 else ''}"
