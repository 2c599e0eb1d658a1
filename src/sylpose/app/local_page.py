"""A page for the browser of who started the command, and for nobody else: on this computer, by an address that is a secret.

Another user of the computer does not know the address; another page in the same browser does not either, and a name that
somebody has pointed at this computer (DNS rebinding) is refused.
"""

from __future__ import annotations

import hmac
import os
import secrets
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from types import TracebackType
from typing import Any, Protocol, Self
from urllib.parse import parse_qsl, urlsplit

import msgspec

__all__ = [
    "HOST",
    "MAX_BODY",
    "Answer",
    "Get",
    "LocalPage",
    "Post",
    "as_json",
    "new_secret",
    "open_browser",
    "path_within",
]

HOST = "127.0.0.1"
# Bytes of what a page may send (choice: a hundred objects in a hundred cameras).
MAX_BODY = 2**20
# Seconds that who has connected may take to ask (choice).
PATIENCE = 10.0
# Nothing from elsewhere, and no page around this one.
_HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


@dataclass(frozen=True)
class Answer:
    """What is answered.

    Attributes:
        body: its bytes.
        kind: their media type.
        status: HTTP's.
        then: called once it is on its way.
    """

    body: bytes
    kind: str
    status: int = 200
    then: Callable[[], None] | None = None


def as_json(value: object, status: int = 200, then: Callable[[], None] | None = None) -> Answer:
    """A value as JSON."""
    return Answer(msgspec.json.encode(value), "application/json", status, then)


class Headers(Protocol):
    """Of a request."""

    def get(self, name: str, /) -> str | None: ...


Get = Callable[[Mapping[str, str]], Answer]
Post = Callable[[bytes], Answer]


class LocalPage:
    """A context within which the page is served, by threads beside this one.

    A `ValueError` of what answers becomes `{"error": sentence}` with status 400.

    Args:
        gets: by path, what answers with the query's values; "" is the page itself.
        posts: by path, what answers to the bytes that are sent.
        port: 0 for any that is free.

    Attributes:
        url: of the page, the secret in it.

    Raises:
        OSError: naming the port that is taken.
    """

    def __init__(self, gets: Mapping[str, Get], posts: Mapping[str, Post], port: int = 0) -> None:
        secret = new_secret()
        try:
            self._server = _Server((HOST, port), _Handler)
        except (OSError, OverflowError) as error:
            why = getattr(error, "strerror", None) or str(error)
            raise OSError(f"--port {port}: cannot listen there ({why.lower()}); 0 takes one that is free") from None
        self._server.gets, self._server.posts, self._server.secret = dict(gets), dict(posts), secret
        self.url = f"http://{HOST}:{self._server.server_address[1]}/{secret}/"
        self._thread = threading.Thread(target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    # Elsewhere it lets a port be taken again at once; on Windows by two programs at a time.
    allow_reuse_address = os.name != "nt"
    gets: dict[str, Get]
    posts: dict[str, Post]
    secret: str

    def server_bind(self) -> None:
        """Without a look at what the host's name is, which takes seconds where no name server answers."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = HOST, self.server_address[1]

    def handle_error(self, request: socket.socket | tuple[bytes, socket.socket], client_address: Any) -> None:
        """Who has gone before the answer is no error of ours; anything else is a bug, which keeps its traceback."""
        if not isinstance(sys.exception(), (ConnectionError, TimeoutError)):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = PATIENCE
    server_version, sys_version = "sylpose", ""

    def do_GET(self) -> None:
        self._give(self._answer(self.server.gets, self._query))

    def do_POST(self) -> None:
        self._give(self._answer(self.server.posts, self._body))

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: the address is a secret."""

    def _answer(self, known: Mapping[str, Callable[[Any], Answer]], given: Callable[[], Any]) -> Answer:
        try:
            path = path_within(self.path, self.headers, self.server.secret, self.server.server_port)
        except PermissionError as error:
            return _refused(403, str(error))
        if path not in known:
            return _refused(404, "no such page")
        try:
            return known[path](given())
        except _Refused as refused:
            return refused.answer
        except ValueError as error:
            return _refused(400, str(error))

    def _query(self) -> dict[str, str]:
        return dict(parse_qsl(urlsplit(self.path).query, max_num_fields=10))

    def _body(self) -> bytes:
        said = self.headers.get("Content-Length", "")
        if not (said.isascii() and said.isdigit()) or "Transfer-Encoding" in self.headers:
            raise _Refused(_refused(411, "how long it is has to be said"))
        if len(said) > 9 or int(said) > MAX_BODY:
            raise _Refused(_refused(413, f"more than the {MAX_BODY} bytes that may be sent"))
        return self.rfile.read(int(said))

    def _give(self, answer: Answer) -> None:
        self.send_response(answer.status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", answer.kind)
        self.send_header("Content-Length", str(len(answer.body)))
        self.end_headers()
        self.wfile.write(answer.body)
        self.wfile.flush()
        if answer.then is not None:
            answer.then()


class _Refused(Exception):
    def __init__(self, answer: Answer) -> None:
        super().__init__()
        self.answer = answer


def new_secret() -> str:
    """Part of an address that nobody can guess."""
    return secrets.token_urlsafe(24)


def path_within(asked: str, headers: Headers, secret: str, port: int, *, by_any_name: bool = False) -> str:
    """The path below the secret of what was asked for, without its query.

    Args:
        asked: "/secret/path?query".
        headers: of the request.
        port: that the page listens at, on this computer.
        by_any_name: the page listens elsewhere too, where it has names that are not known here.

    Raises:
        PermissionError: asked for by another name than this computer's own, from a page of somebody else, or without the
            secret.
    """
    host, origin = headers.get("Host"), headers.get("Origin")
    if (not by_any_name and host not in (f"{HOST}:{port}", f"localhost:{port}")) or origin not in (
        None,
        f"http://{host}",
    ):
        raise PermissionError("asked for by another name than this computer's own")
    given, _, path = urlsplit(asked).path[1:].partition("/")
    if not hmac.compare_digest(given.encode(), secret.encode()):
        raise PermissionError("the address is not the one that was printed")
    return path


def open_browser(url: str) -> bool:
    """Opens a page in the user's browser; says whether there is one. None that would run in the terminal."""
    try:
        browser = webbrowser.get()
    except webbrowser.Error:
        return False
    return type(browser) is not webbrowser.GenericBrowser and browser.open(url)


def _refused(status: int, sentence: str) -> Answer:
    return as_json({"error": sentence}, status)
