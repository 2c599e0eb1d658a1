"""Sentences that explain why a run has no pose."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

from sylpose.results import Trajectory

# Maximum number of sentences that explain a missing pose.
MAX_REASONS = 8
# A standalone number, not part of a name.
_NUMBER = re.compile(r"(?<![\w.])\d+(?:\.\d+)?(?!\w)")


def explain_missing_poses(trajectory: Trajectory) -> list[str]:
    """Explain, in sentences, why a trajectory contains no pose."""
    counts = Counter(f.status for f in trajectory).most_common()
    sentences = [f"{_format_frame_count(count)}: {status.value}. {status.text}" for status, count in counts]
    reasons = group_sentences([f.reason for f in trajectory if f.reason])
    sentences += [f"{_format_frame_count(count)}: {reason}" for reason, count in reasons[:MAX_REASONS]]
    if len(reasons) > MAX_REASONS:
        sentences.append(f"and {len(reasons) - MAX_REASONS} more reasons: see the column reason of trajectory.csv")
    return sentences


def group_sentences(sentences: Sequence[str]) -> list[tuple[str, int]]:
    """Group sentences that differ only in their numbers.

    Returns:
        (sentence, count), most frequent first; each number that varies becomes the range of its values.
    """
    groups = dict[str, list[list[str]]]()
    for sentence in sentences:
        groups.setdefault(_NUMBER.sub("0", sentence), []).append(_NUMBER.findall(sentence))
    grouped = [
        (_fill_ranges(pattern, list(zip(*numbers, strict=True))), len(numbers)) for pattern, numbers in groups.items()
    ]
    return sorted(grouped, key=lambda one: -one[1])


def _fill_ranges(pattern: str, numbers: Sequence[Sequence[str]]) -> str:
    """Fill a sentence with the range of each of its numbers."""
    ranges = [(min(values, key=float), max(values, key=float)) for values in numbers]
    words = iter(low if float(low) == float(high) else f"{low} to {high}" for low, high in ranges)
    return _NUMBER.sub(lambda _: next(words), pattern)


def _format_frame_count(count: int) -> str:
    return f"{count} frame{'s' if count > 1 else ''}"
