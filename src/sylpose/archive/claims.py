"""Claims: exclusive ownership of a recording by one live worker.

A claim is a file `claim-N.json` that is created only if it does not exist, which every store supports. The claim with
the highest number counts. Its worker renews it. A claim that is not renewed, or whose process is known to be dead, is
superseded by creating number N + 1, which again only one worker can. So no file needs a conditional update, which not
all stores support, and a worker that was only suspended detects that it was superseded.
"""

from __future__ import annotations

import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import msgspec

from sylpose.archive.stores import Store

__all__ = [
    "CLAIM_LIFETIME",
    "CLAIM_PREFIX",
    "Claim",
    "RecordingHeldError",
    "hold_claim",
    "host_id",
    "is_alive",
    "is_process_alive",
    "read_current_claim",
]

CLAIM_PREFIX = "claim-"
# Seconds between renewals, and until a claim expires (choice: eight missed renewals; a recording waits that long after
# its computer crashed; the clocks of computers must agree better than that).
RENEW_INTERVAL, CLAIM_LIFETIME = 15.0, 120.0
# Attempts to create a claim in competition with other workers (choice: after these another one is at work).
MAX_ATTEMPTS = 5


class Claim(msgspec.Struct, frozen=True):
    """Content of a claim file.

    Attributes:
        host, pid: the process that works.
        run: the command that started it.
        since, renewed: seconds since 1970.
    """

    host: str
    pid: int
    run: str
    since: float
    renewed: float


class RecordingHeldError(Exception):
    """Another worker holds the recording."""


def host_id() -> str:
    """Return an identifier of this computer; containers differ, since process IDs are only valid inside."""
    with suppress(OSError):
        return f"{socket.gethostname()}-{os.stat('/proc/self/ns/pid').st_ino}"
    return socket.gethostname()


def is_process_alive(pid: int) -> bool:
    """Return whether a process of this computer is alive; on Windows always True, as a check would kill it."""
    if os.name == "nt":
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # of another user
        return True
    return not _is_zombie(pid)


def _is_zombie(pid: int) -> bool:
    with suppress(OSError), open(f"/proc/{pid}/stat", encoding="utf-8", errors="replace") as file:
        return file.read().rpartition(")")[2].split()[0] == "Z"
    return False


def is_alive(claim: Claim) -> bool:
    """Return whether a claim's worker may still be at work."""
    if time.time() - claim.renewed > CLAIM_LIFETIME:
        return False
    return claim.host != host_id() or is_process_alive(claim.pid)


def read_current_claim(store: Store) -> Claim | None:
    """Return the valid claim, whether its worker is alive or not."""
    numbers = _claim_numbers(store)
    return _read_claim(store, numbers[-1]) if numbers else None


@contextmanager
def hold_claim(store: Store, run: str) -> Iterator[_OwnClaim]:
    """Hold the claim on a recording within the context.

    Args:
        store: the recording's folder in the destination.
        run: an earlier worker of the same run is superseded immediately, since the run's driver knows that it has died.

    Raises:
        RecordingHeldError: another live worker holds it; the message names it.
        OSError: the store does not respond.
    """
    own_claim = _OwnClaim(store, run)
    try:
        own_claim.start()
        yield own_claim
    finally:
        own_claim.stop()


def _acquire(store: Store, run: str) -> int:
    for _ in range(MAX_ATTEMPTS):
        numbers = _claim_numbers(store)
        if numbers:
            other = _read_claim(store, numbers[-1])
            if other is None:  # released meanwhile
                continue
            if other.run != run and is_alive(other):
                since = time.strftime("%H:%M:%S", time.localtime(other.since))
                raise RecordingHeldError(f"held by process {other.pid} of {other.host} since {since}")
        number = numbers[-1] + 1 if numbers else 0
        now = time.time()
        if store.create(_claim_name(number), msgspec.json.encode(Claim(host_id(), os.getpid(), run, now, now))):
            return number
    raise RecordingHeldError("held by another worker")


class _OwnClaim:
    """A claim of this process, renewed by a thread."""

    def __init__(self, store: Store, run: str) -> None:
        self._store, self._run, self._since = store, run, time.time()
        self._number = -1
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._renew, daemon=True, name="sylpose-claim")

    def start(self) -> None:
        self._number = _acquire(self._store, self._run)
        self._thread.start()

    def stop(self) -> None:
        """Release the claim and those that it superseded.

        After an interrupt between its creation and the assignment of its number, the claim is identified by its
        content.
        """
        self._end.set()
        if self._thread.is_alive():
            self._thread.join()
        with suppress(OSError):  # it expires
            numbers = _claim_numbers(self._store)
            last = self._number
            if last < 0:
                last = max((number for number in numbers if self._is_mine(number)), default=-1)
            for number in numbers:
                if number <= last:
                    self._store.remove(_claim_name(number))

    def _is_mine(self, number: int) -> bool:
        claim = _read_claim(self._store, number)
        return claim is not None and (claim.host, claim.pid, claim.run) == (host_id(), os.getpid(), self._run)

    @property
    def is_current(self) -> bool:
        """Return whether no other claim has superseded it."""
        return _claim_numbers(self._store)[-1:] == [self._number]

    def _renew(self) -> None:
        while not self._end.wait(RENEW_INTERVAL):
            with suppress(OSError):  # retried at the next renewal
                if not self.is_current:
                    return
                claim = Claim(host_id(), os.getpid(), self._run, self._since, time.time())
                self._store.write(_claim_name(self._number), msgspec.json.encode(claim))


def _claim_name(number: int) -> str:
    return f"{CLAIM_PREFIX}{number:06}.json"


def _claim_numbers(store: Store) -> list[int]:
    texts = [
        name.removeprefix(CLAIM_PREFIX).removesuffix(".json") for name in store.names() if name.startswith(CLAIM_PREFIX)
    ]
    return sorted(int(text) for text in texts if text.isascii() and text.isdigit() and len(text) < 18)


def _read_claim(store: Store, number: int) -> Claim | None:
    content = store.read(_claim_name(number))
    if content is None:
        return None
    try:
        return msgspec.json.decode(content, type=Claim)
    except msgspec.MsgspecError:  # partially written before a crash: without owner
        return Claim("", 0, "", 0.0, 0.0)
