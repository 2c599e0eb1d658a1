"""Lockstep of nodes: each waits for the last message of all others and repeats its own meanwhile.

Lost and delayed messages cost rounds, but do not change the results.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from sylpose.sylvester.distributed.messages import Inbox, Message, Packet, decode_inbox, encode

__all__ = ["MAX_MISSED_ROUNDS", "Link", "make_packets", "process_inbox", "set_message"]

# Rounds without a message after which a node counts as gone: by chance once in 3e10 at 30 % loss (derived).
MAX_MISSED_ROUNDS = 20


@dataclass(frozen=True, eq=False)
class Link:
    """Messages of one node.

    Attributes:
        sent: its last message; those of the others with the same number are needed next.
        previous: the previous one, for nodes that lack it.
        waiting: (camera, number) -> message received and not used yet.
        missed_rounds: camera -> rounds since its last message.
        refused: camera -> reason why its messages are rejected.
        behind: the others are too far ahead for this node, which has just started.
    """

    camera: int
    others: tuple[int, ...]
    sent: Message
    previous: Message | None = None
    waiting: dict[tuple[int, int], Message] = field(default_factory=dict)
    missed_rounds: dict[int, int] = field(default_factory=dict)
    refused: dict[int, str] = field(default_factory=dict)
    behind: bool = False

    @property
    def number(self) -> int:
        """Number of the messages needed next."""
        return self.sent.round

    def missing(self, nodes: Iterable[int]) -> tuple[int, ...]:
        """Return the nodes whose messages are missing, except rejected ones."""
        return tuple(
            c for c in nodes if c != self.camera and c not in self.refused and (c, self.number) not in self.waiting
        )

    def is_gone(self, c: int) -> bool:
        """Return whether a node counts as gone."""
        return self.missed_rounds.get(c, 0) > MAX_MISSED_ROUNDS

    def available(self) -> dict[int, Message]:
        """Return the needed messages that have arrived."""
        return {c: m for (c, n), m in sorted(self.waiting.items()) if n == self.number and c not in self.refused}

    def reject(self, reasons: dict[int, str]) -> Link:
        """Return the link with these nodes rejected."""
        return replace(self, refused={**reasons, **self.refused})


def process_inbox(link: Link, inbox: Inbox, sizes: tuple[int, ...], special: Mapping[int, int]) -> Link:
    """Process the inbox.

    Args:
        sizes: allowed numbers of values of a message.
        special: message numbers that may arrive at any time, with their number of values. Other messages are at most
            one number ahead.
    """
    inbox = [(c, data) for c, data in inbox if c in link.others and c not in link.refused]
    waiting, refused, behind, active = dict(link.waiting), dict(link.refused), link.behind, set()
    news, malformed = decode_inbox(inbox, (*sizes, *special.values()), {})
    refused |= malformed
    for (c, n), message in sorted(news.items(), key=lambda item: item[0]):
        if message.values.size not in ((special[n],) if n in special else sizes):
            refused.setdefault(c, f"{message.values.size} values in message {n}")
            continue
        if n in special or n in (link.number, link.number + 1):
            waiting.setdefault((c, n), message)
        elif n > link.number and link.number == 0:
            behind = True
        elif n > link.number:
            refused.setdefault(c, f"message {n} when message {link.number} is due")
            continue
        active.add(c)
    missed_rounds = {c: 0 if c in active else link.missed_rounds.get(c, 0) + 1 for c in link.others}
    waiting = {key: m for key, m in waiting.items() if key[1] >= link.number and key[0] not in refused}
    return replace(link, waiting=waiting, missed_rounds=missed_rounds, refused=refused, behind=behind)


def set_message(link: Link, message: Message) -> Link:
    """Set the next message; keep the previous one for nodes that are behind."""
    previous = link.sent if message.round == link.number + 1 else None
    waiting = {key: m for key, m in link.waiting.items() if key[1] >= message.round}
    return replace(link, sent=message, previous=previous, waiting=waiting)


def make_packets(link: Link, repeat_to: Iterable[int] = ()) -> list[Packet]:
    """Return the last message for all nodes, and the previous one for those in `repeat_to`."""
    out = [Packet(link.others, encode(link.camera, link.sent))] if link.others else []
    receivers = tuple(repeat_to)
    return (
        [*out, Packet(receivers, encode(link.camera, link.previous))]
        if receivers and link.previous is not None
        else out
    )
