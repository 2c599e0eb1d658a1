"""What a study is, and the Monte Carlo comparison that most of them are."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sylpose.experiments.estimators import Estimator, error_deg
from sylpose.experiments.scenes import Problem
from sylpose.experiments.table import ERROR_COLUMNS, Cell, Table, error_columns

__all__ = ["Study", "compare", "score"]


class Study(NamedTuple):
    """One of the paper's experiments.

    Attributes:
        name: what it is called on the command line.
        question: what it asks, a sentence.
        run: from a seed and the number of trials; the same seed gives the same table, times aside.
        draw: a table's figure, to a path.
        findings: what a table says, in sentences.
        trials, quick_trials: how many by default, and where it has to be quick.
    """

    name: str
    question: str
    run: Callable[[int, int], Table]
    draw: Callable[[Table, Path], None]
    findings: Callable[[Table], list[str]]
    trials: int
    quick_trials: int


def compare(
    level_name: str,
    problems: Mapping[str, Callable[[float, np.random.Generator], Problem]],
    levels: Sequence[float],
    estimators: Mapping[str, Estimator],
    seed: int,
    trials: int,
) -> Table:
    """A Monte Carlo study: all estimators on the same problems, the same motions at every level.

    Args:
        level_name: of the column with what is varied.
        problems: by scene, makes one from a level and a generator.

    Returns:
        columns scene, method, `level_name` and `ERROR_COLUMNS`.
    """
    rows = []
    for scene, make in problems.items():
        for level in levels:
            drawn = [make(level, np.random.default_rng([seed, trial])) for trial in range(trials)]
            rows += [(scene, method, level, *score(estimate, drawn)) for method, estimate in estimators.items()]
    return Table(("scene", "method", level_name, *ERROR_COLUMNS), tuple(rows))


def score(estimate: Estimator, problems: Iterable[Problem]) -> tuple[Cell, ...]:
    """The cells of `ERROR_COLUMNS` of an estimator's answers."""
    answers = [(estimate(problem), problem.truth) for problem in problems]
    return error_columns([error_deg(a, truth) for a, truth in answers], [a.certified for a, _ in answers])
