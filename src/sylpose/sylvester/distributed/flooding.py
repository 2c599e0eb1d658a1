"""Evidence shown on a sparse network: each camera passes on what it was shown, until all have seen all.

A message is one camera's moments and rotation, those that were passed on least often so far, and what the sender has come
to. On a line of n cameras all is everywhere after about 2 n rounds, where all hear each other after two. Lost messages cost
rounds; a camera that is never heard of is missed for good once nothing new has come for long.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from sylpose.geometry.arrays import FloatArray
from sylpose.moments import PairMoments
from sylpose.sylvester.distributed.evidence_exchange import AGREED, opened, shown_values
from sylpose.sylvester.distributed.fault_decision import UNKNOWN, Verdict, verdict
from sylpose.sylvester.distributed.lockstep import PATIENCE
from sylpose.sylvester.distributed.messages import Message, Packet, encode

__all__ = ["PASSED", "Passing", "begun", "passed_on", "passing_packets"]

# Numbers of a message: which camera, what it shows, the sender's answer (derived).
PASSED = 1 + 54 + 9


@dataclass(frozen=True, eq=False)
class Passing:
    """What one camera was shown.

    Attributes:
        shown: camera -> (54,) as it showed them. times: camera -> how often they were passed on.
        answers: neighbour -> (9,) its answer, once it says that it has all.
        silent: neighbour -> rounds since it was heard.
        still: rounds since anything new came. lingered: rounds since all neighbours have this camera's answer.
        verdict: of all that was shown, once that is all that will be.
    """

    camera: int
    neighbours: tuple[int, ...]
    n_cameras: int
    aim: bool
    shown: dict[int, FloatArray]
    times: dict[int, int] = field(default_factory=dict)
    answers: dict[int, FloatArray] = field(default_factory=dict)
    silent: dict[int, int] = field(default_factory=dict)
    refused: dict[int, str] = field(default_factory=dict)
    still: int = 0
    lingered: int = 0
    verdict: Verdict = UNKNOWN

    @property
    def all_shown(self) -> bool:
        """Nothing more will come."""
        return len(self.shown) == self.n_cameras or self.still > PATIENCE + self.n_cameras


def begun(
    camera: int, neighbours: tuple[int, ...], n_cameras: int, rotation: FloatArray, moments: PairMoments, aim: bool
) -> Passing:
    """A camera shows its own."""
    return Passing(camera, neighbours, n_cameras, aim, {camera: shown_values(rotation, moments)})


def passed_on(p: Passing, messages: Mapping[tuple[int, int], Message], heard: Collection[int]) -> Passing:
    """With the neighbours' messages, by sender and round, each of `PASSED` numbers; of whom anything was heard."""
    shown, answers, refused = dict(p.shown), dict(p.answers), dict(p.refused)
    for (sender, _), message in sorted(messages.items(), key=lambda item: item[0]):
        of, values = int(message.values[0]), message.values[1:55]
        if message.final:
            answers[sender] = message.values[55:]
        try:
            if not 0 <= of < p.n_cameras:
                raise ValueError(f"moments of camera {of}, of {p.n_cameras}")
            opened(values, p.aim)
            shown.setdefault(of, values)
        except ValueError as error:
            refused.setdefault(sender, str(error))
    silent = {c: 0 if c in heard else p.silent.get(c, 0) + 1 for c in p.neighbours}
    still = 0 if len(shown) > len(p.shown) else p.still + 1
    p = replace(p, shown=shown, answers=answers, refused=refused, silent=silent, still=still)
    if not p.all_shown:
        return replace(p, verdict=UNKNOWN, lingered=0)
    if still == 0 or p.verdict is UNKNOWN:
        p = replace(p, verdict=verdict({c: opened(v, p.aim) for c, v in sorted(shown.items())}, aim=p.aim))
    agree = all(
        c in answers and np.linalg.norm(answers[c] - answer_of(p)) < AGREED
        for c in p.neighbours
        if silent[c] <= PATIENCE
    )
    converged = agree and p.verdict.rotation is not None
    return replace(p, verdict=replace(p.verdict, converged=converged), lingered=p.lingered + 1 if converged else 0)


def passing_packets(p: Passing, number: int, clean: bool) -> tuple[Passing, list[Packet]]:
    """What it passes on next, the same to all neighbours."""
    c = min(p.shown, key=lambda c: (p.times.get(c, 0), c != p.camera, c))
    message = Message(number, clean, p.all_shown, np.concatenate([[c], p.shown[c], answer_of(p)]))
    packets = [Packet(p.neighbours, encode(p.camera, message))] if p.neighbours else []
    return replace(p, times={**p.times, c: p.times.get(c, 0) + 1}), packets


def answer_of(p: Passing) -> FloatArray:
    """(9,) its rotation; zeros without one."""
    return np.zeros(9) if p.verdict.rotation is None else p.verdict.rotation.ravel()
