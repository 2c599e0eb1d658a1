"""Cameras in step: each waits until it has heard everybody's last message and repeats its own meanwhile, so that loss and
delay cost rounds and change nothing."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from sylpose.sylvester.distributed.messages import Inbox, Message, Packet, encode, read

__all__ = ["PATIENCE", "Link", "heard", "packets", "said"]

# Rounds of silence after which a camera is gone: at 30 % of loss once in 3e10 (derived).
PATIENCE = 20


@dataclass(frozen=True, eq=False)
class Link:
    """What one camera has said and heard.

    Attributes:
        sent: its last message, whose number it wants of all others next.
        before: the one before, for those who have not got it yet.
        waiting: (camera, number) -> message that came and is yet to be used.
        silent: camera -> rounds since anything was heard of it.
        refused: camera -> why nothing is read of it any more.
        behind: others are at numbers that this camera, which has just started, cannot follow.
    """

    camera: int
    others: tuple[int, ...]
    sent: Message
    before: Message | None = None
    waiting: dict[tuple[int, int], Message] = field(default_factory=dict)
    silent: dict[int, int] = field(default_factory=dict)
    refused: dict[int, str] = field(default_factory=dict)
    behind: bool = False

    @property
    def number(self) -> int:
        """Of the messages that are wanted."""
        return self.sent.round

    def missing(self, of: Iterable[int]) -> tuple[int, ...]:
        """Those whose message is wanted and not there; nobody waits for one that talks nonsense."""
        return tuple(
            c for c in of if c != self.camera and c not in self.refused and (c, self.number) not in self.waiting
        )

    def gone(self, c: int) -> bool:
        """Whether nothing was heard of a camera for long."""
        return self.silent.get(c, 0) > PATIENCE

    def there(self) -> dict[int, Message]:
        """The messages that are wanted, as far as they have come."""
        return {c: m for (c, n), m in sorted(self.waiting.items()) if n == self.number and c not in self.refused}

    def refusing(self, why: dict[int, str]) -> Link:
        """Reads nothing more of these."""
        return replace(self, refused={**why, **self.refused})


def heard(link: Link, inbox: Inbox, sizes: tuple[int, ...], special: Mapping[int, int]) -> Link:
    """With what came in.

    Args:
        sizes: how many values a message may have.
        special: numbers that may come at any time, and how many values those have. Of others a camera in step is never more
            than one ahead.
    """
    inbox = [(c, data) for c, data in inbox if c in link.others and c not in link.refused]
    waiting, refused, behind, spoke = dict(link.waiting), dict(link.refused), link.behind, set()
    news, malformed = read(inbox, (*sizes, *special.values()), {})
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
        spoke.add(c)
    silent = {c: 0 if c in spoke else link.silent.get(c, 0) + 1 for c in link.others}
    waiting = {key: m for key, m in waiting.items() if key[1] >= link.number and key[0] not in refused}
    return replace(link, waiting=waiting, silent=silent, refused=refused, behind=behind)


def said(link: Link, message: Message) -> Link:
    """Says the next message; the one before is for those who come after."""
    before = link.sent if message.round == link.number + 1 else None
    waiting = {key: m for key, m in link.waiting.items() if key[1] >= message.round}
    return replace(link, sent=message, before=before, waiting=waiting)


def packets(link: Link, again: Iterable[int] = ()) -> list[Packet]:
    """Its message to all; to those who may lack it, the one before again."""
    out = [Packet(link.others, encode(link.camera, link.sent))] if link.others else []
    late = tuple(again)
    return [*out, Packet(late, encode(link.camera, link.before))] if late and link.before is not None else out
