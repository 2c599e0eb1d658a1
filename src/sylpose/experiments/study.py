"""Definition of a study, and the Monte Carlo comparison over levels that most studies use."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sylpose.experiments.estimators import Estimator, error_deg
from sylpose.experiments.figures import Lines, ReferenceCurve
from sylpose.experiments.scenes import Problem, Scene
from sylpose.experiments.table import ERROR_COLUMNS, Cell, Table, compute_error_cells


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
    trials: int = 40
    quick_trials: int = 4


class Levels(NamedTuple):
    """Quantity that a comparison varies.

    Attributes:
        name: its column in the table.
        label: its label in the figure.
        values: its levels.
        simulate: builds a problem from a scene, a level and a random generator.
        is_log: draw it on a logarithmic axis.
    """

    name: str
    label: str
    values: Sequence[float]
    simulate: Callable[[Scene, float, np.random.Generator], Problem]
    is_log: bool = True


def compare(
    levels: Levels,
    scenes: Sequence[Scene],
    estimators: Mapping[str, Estimator],
    title: str,
    reference: ReferenceCurve | None = None,
) -> tuple[Callable[[int, int], Table], Callable[[Table, Path], None]]:
    """Return `run` and `draw` of a study: all estimators on the same problems, with the same motions at every level.

    The table has the columns scene, method, `levels.name` and `ERROR_COLUMNS`.
    """

    def run(seed: int, trials: int) -> Table:
        rows = []
        for scene in scenes:
            for level in levels.values:
                problems = simulate_trials(partial(levels.simulate, scene, level), seed, trials)
                rows += [(scene.name, name, level, *score_estimator(of, problems)) for name, of in estimators.items()]
        return Table(("scene", "method", levels.name, *ERROR_COLUMNS), tuple(rows))

    return run, Lines(title, levels.name, levels.label, log_x=levels.is_log, reference=reference).draw


def simulate_trials(simulate: Callable[[np.random.Generator], Problem], seed: int, trials: int) -> list[Problem]:
    """Return the problems of all trials."""
    return [simulate(np.random.default_rng([seed, trial])) for trial in range(trials)]


def score_estimator(estimate: Estimator, problems: Iterable[Problem]) -> tuple[Cell, ...]:
    """Return the cells of `ERROR_COLUMNS` of an estimator's results."""
    answers = [(estimate(problem), problem.truth) for problem in problems]
    return compute_error_cells([error_deg(a, truth) for a, truth in answers], [a.certified for a, _ in answers])
