"""Definition of a study, and the Monte Carlo comparison that most studies use."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sylpose.experiments.estimators import Estimator, error_deg
from sylpose.experiments.scenes import Problem
from sylpose.experiments.table import ERROR_COLUMNS, Cell, Table, compute_error_cells

__all__ = ["Study", "run_comparison", "score_estimator"]


class Study(NamedTuple):
    """One of the paper's experiments.

    Attributes:
        name: its name on the command line.
        question: the research question, a sentence.
        run: computes the table from a seed and the number of trials; reproducible except for run times.
        draw: writes the figure of a table to a path.
        summarize: summarizes a table in sentences.
        trials, quick_trials: number of trials by default, and in quick mode.
    """

    name: str
    question: str
    run: Callable[[int, int], Table]
    draw: Callable[[Table, Path], None]
    summarize: Callable[[Table], list[str]]
    trials: int
    quick_trials: int


def run_comparison(
    level_name: str,
    problems: Mapping[str, Callable[[float, np.random.Generator], Problem]],
    levels: Sequence[float],
    estimators: Mapping[str, Estimator],
    seed: int,
    trials: int,
) -> Table:
    """Run a Monte Carlo study: all estimators on the same problems, with the same motions at every level.

    Args:
        level_name: name of the column with the varied quantity.
        problems: per scene, builds a problem from a level and a random generator.
        levels: values of the varied quantity.
        estimators: by name.
        seed: seed of the random generators.
        trials: number of trials per scene and level.

    Returns:
        A table with columns scene, method, `level_name` and `ERROR_COLUMNS`.
    """
    rows = []
    for scene, make in problems.items():
        for level in levels:
            trial_problems = [make(level, np.random.default_rng([seed, trial])) for trial in range(trials)]
            rows += [
                (scene, method, level, *score_estimator(estimate, trial_problems))
                for method, estimate in estimators.items()
            ]
    return Table(("scene", "method", level_name, *ERROR_COLUMNS), tuple(rows))


def score_estimator(estimate: Estimator, problems: Iterable[Problem]) -> tuple[Cell, ...]:
    """Return the cells of `ERROR_COLUMNS` of an estimator's results."""
    answers = [(estimate(problem), problem.truth) for problem in problems]
    return compute_error_cells([error_deg(a, truth) for a, truth in answers], [a.certified for a, _ in answers])
