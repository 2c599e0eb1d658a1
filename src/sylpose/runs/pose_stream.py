"""Stream of poses during a run, to stdout or a UDP port."""

from __future__ import annotations

import re
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

__all__ = ["STDOUT", "open_pose_stream"]

STDOUT = "-"
_UDP = re.compile(r"udp://(\[[0-9a-fA-F:.%\w]+\]|[^\[\]/:]+):(\d{1,5})")


@contextmanager
def open_pose_stream(destination: str) -> Iterator[Callable[[str], None]]:
    """Open a stream; yield a function that sends one line.

    Args:
        destination: "-" for stdout, or udp://HOST:PORT for one datagram per line; a receiver is not required.

    Raises:
        ValueError: neither of these, or an unknown host.
        BrokenPipeError: while sending, if the reader of stdout has closed it.
    """
    if destination == STDOUT:
        yield _print_line
        return
    match = _UDP.fullmatch(destination)
    if match is None or not 0 < int(match[2]) < 1 << 16:
        raise ValueError(f"--stream: expected - for stdout or udp://HOST:PORT, got {destination!r}")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            match[1].strip("[]"), int(match[2]), type=socket.SOCK_DGRAM
        )[0]
    except (OSError, UnicodeError):
        raise ValueError(f"--stream {destination}: no such host") from None
    with socket.socket(family, kind, protocol) as out:
        out.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)

        def send(line: str) -> None:
            with suppress(OSError):  # no receiver, or the network is down: the next line may arrive
                out.sendto(line.encode(), address)

        yield send


def _print_line(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
