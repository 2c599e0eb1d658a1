"""Who works on a recording: one worker, as long as it lives.

A claim is a file `claim-N.json` that is created only where there is none, which every store can do. The one of the highest
number counts. Its worker renews it; one that is not renewed, or whose process is known to be gone, is superseded by
creating number N + 1, which again only one of several can. So no file is ever changed under a condition, which not all
stores can do, and a worker that was only stopped for a while sees that it was superseded.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import msgspec

from sylpose.archive.stores import Place

__all__ = [
    "CLAIM",
    "EXPIRES",
    "Claim",
    "Held",
    "claimed",
    "here",
    "holder",
    "is_alive",
    "process_lives",
]

CLAIM = "claim-"
# Seconds between two renewals, and after which a claim counts for nothing (choice: eight renewals missed; so long must a
# recording wait whose computer died; the clocks of computers must agree to less).
BEAT, EXPIRES = 15.0, 120.0
# How often another one may be faster (choice: it is then at work).
TRIES = 5


class Claim(msgspec.Struct, frozen=True):
    """Attributes:
    host, pid: the process that works.
    run: the command that started it.
    since, renewed: seconds since 1970.
    """

    host: str
    pid: int
    run: str
    since: float
    renewed: float


class Held(Exception):
    """Another worker has the recording."""


def here() -> str:
    """This computer; a container is another one, since its numbers of processes mean nothing elsewhere."""
    with suppress(OSError):
        return f"{socket.gethostname()}-{os.stat('/proc/self/ns/pid').st_ino}"
    return socket.gethostname()


def process_lives(pid: int) -> bool:
    """Of this computer; on Windows, where asking would end it, yes."""
    if os.name == "nt":
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # somebody else's
        return True
    return not _is_zombie(pid)


def _is_zombie(pid: int) -> bool:
    with suppress(OSError), open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:
        return file.read().rpartition(")")[2].split()[0] == "Z"
    return False


def is_alive(claim: Claim) -> bool:
    """Whether a claim's worker may still be at work."""
    if time.time() - claim.renewed > EXPIRES:
        return False
    return claim.host != here() or process_lives(claim.pid)


def holder(place: Place) -> Claim | None:
    """The claim that counts, alive or not."""
    numbers = _numbers(place)
    return _read(place, numbers[-1]) if numbers else None


@contextmanager
def claimed(place: Place, run: str) -> Iterator[_Mine]:
    """Within it the recording is this process's.

    Args:
        run: an earlier worker of the same run is superseded at once: whoever started both knows that it is gone.

    Raises:
        Held: by another one that is alive, which the sentence names.
        OSError: the store does not answer.
    """
    mine = _Mine(place, run)
    try:
        mine.start()
        yield mine
    finally:
        mine.stop()


def _take(place: Place, run: str) -> int:
    for _ in range(TRIES):
        numbers = _numbers(place)
        if numbers:
            other = _read(place, numbers[-1])
            if other is None:  # given back in between
                continue
            if other.run != run and is_alive(other):
                since = time.strftime("%H:%M:%S", time.localtime(other.since))
                raise Held(f"held by process {other.pid} of {other.host} since {since}")
        number = numbers[-1] + 1 if numbers else 0
        now = time.time()
        if place.create(_name(number), msgspec.json.encode(Claim(here(), os.getpid(), run, now, now))):
            return number
    raise Held("held by another worker")


class _Mine:
    """A claim that a thread renews."""

    def __init__(self, place: Place, run: str) -> None:
        self._place, self._run, self._since = place, run, time.time()
        self._number = -1
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._renew, daemon=True, name="sylpose-claim")

    def start(self) -> None:
        self._number = _take(self._place, self._run)
        self._thread.start()

    def stop(self) -> None:
        """Gives the claim back, and those that it has superseded before it.

        Where an interrupt came between its creation and the knowledge of its number, the file says which it is.
        """
        self._end.set()
        if self._thread.is_alive():
            self._thread.join()
        with suppress(OSError):  # it expires
            numbers = _numbers(self._place)
            last = self._number
            if last < 0:
                last = max((number for number in numbers if self._is_mine(number)), default=-1)
            for number in numbers:
                if number <= last:
                    self._place.remove(_name(number))

    def _is_mine(self, number: int) -> bool:
        claim = _read(self._place, number)
        return claim is not None and (claim.host, claim.pid, claim.run) == (here(), os.getpid(), self._run)

    @property
    def counts(self) -> bool:
        """Whether nobody has superseded it."""
        return _numbers(self._place)[-1:] == [self._number]

    def _renew(self) -> None:
        while not self._end.wait(BEAT):
            with suppress(OSError):  # the next time, perhaps
                if not self.counts:
                    return
                claim = Claim(here(), os.getpid(), self._run, self._since, time.time())
                self._place.write(_name(self._number), msgspec.json.encode(claim))


def _name(number: int) -> str:
    return f"{CLAIM}{number:06}.json"


def _numbers(place: Place) -> list[int]:
    texts = [name.removeprefix(CLAIM).removesuffix(".json") for name in place.names() if name.startswith(CLAIM)]
    return sorted(int(text) for text in texts if text.isascii() and text.isdigit() and len(text) < 18)


def _read(place: Place, number: int) -> Claim | None:
    content = place.read(_name(number))
    if content is None:
        return None
    try:
        return msgspec.json.decode(content, type=Claim)
    except msgspec.MsgspecError:  # half written by a computer that died: nobody's
        return Claim("", 0, "", 0.0, 0.0)
