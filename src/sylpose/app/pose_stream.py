"""Who is told each pose as soon as it is known: whoever reads stdout, or a UDP port."""

from __future__ import annotations

import re
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

__all__ = ["STDOUT", "listener"]

STDOUT = "-"
_UDP = re.compile(r"udp://(\[[0-9a-fA-F:.%\w]+\]|[^\[\]/:]+):(\d{1,5})")


@contextmanager
def listener(to: str) -> Iterator[Callable[[str], None]]:
    """What tells a line to somebody.

    Args:
        to: "-" for stdout, or udp://HOST:PORT, each line a datagram; nobody needs to be there.

    Raises:
        ValueError: neither of these; a host that is not known.
        BrokenPipeError: while telling: whoever read stdout has gone.
    """
    if to == STDOUT:
        yield _print
        return
    found = _UDP.fullmatch(to)
    if found is None or not 0 < int(found[2]) < 1 << 16:
        raise ValueError(f"--stream: - for stdout, or udp://HOST:PORT is expected, got {to!r}")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            found[1].strip("[]"), int(found[2]), type=socket.SOCK_DGRAM
        )[0]
    except (OSError, UnicodeError):
        raise ValueError(f"--stream {to}: no such host") from None
    with socket.socket(family, kind, protocol) as out:
        out.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

        def send(line: str) -> None:
            with suppress(OSError):  # nobody listens, or the network is down: the next one may arrive
                out.sendto(line.encode(), address)

        yield send


def _print(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
