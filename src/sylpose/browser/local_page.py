"""Local web page for the user who started the command, served on this computer under a secret URL.

Other users of the computer and other pages in the same browser lack the secret. Requests by a foreign host name that
resolves to this computer (DNS rebinding) are refused.
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
    "GetHandler",
    "LocalPage",
    "PostHandler",
    "Response",
    "check_request_path",
    "create_secret",
    "json_response",
    "open_browser",
]

HOST = "127.0.0.1"
# Largest request body in bytes (choice: a hundred objects in a hundred cameras).
MAX_BODY = 2**20
# Seconds that a connection may take to send its request (choice).
REQUEST_TIMEOUT = 10.0
# Load nothing from other origins, and forbid embedding in other pages.
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
class Response:
    """Response to an HTTP request.

    Attributes:
        body: content.
        media_type: media type of the content.
        status: HTTP status code.
        on_sent: function to call once the response is sent.
    """

    body: bytes
    media_type: str
    status: int = 200
    on_sent: Callable[[], None] | None = None


def json_response(value: object, status: int = 200, on_sent: Callable[[], None] | None = None) -> Response:
    """Return a response with a value as JSON."""
    return Response(msgspec.json.encode(value), "application/json", status, on_sent)


class Headers(Protocol):
    """Headers of a request."""

    def get(self, name: str, /) -> str | None: ...


GetHandler = Callable[[Mapping[str, str]], Response]
PostHandler = Callable[[bytes], Response]


class LocalPage:
    """Context manager that serves a page from background threads.

    A `ValueError` of a handler becomes `{"error": message}` with status 400.

    Args:
        gets: GET handlers by path, called with the query's values; "" is the page itself.
        posts: POST handlers by path, called with the request body.
        port: port to listen at; 0 for any free one.

    Attributes:
        url: URL of the page, including the secret.

    Raises:
        OSError: the port is in use; the message names it.
    """

    def __init__(self, gets: Mapping[str, GetHandler], posts: Mapping[str, PostHandler], port: int = 0) -> None:
        secret = create_secret()
        try:
            self._server = _Server((HOST, port), _Handler)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise OSError(f"--port {port}: cannot listen there ({reason.lower()}); 0 selects a free port") from None
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
    # On POSIX this allows reusing a port at once; on Windows it would let two programs share it.
    allow_reuse_address = os.name != "nt"
    gets: dict[str, GetHandler]
    posts: dict[str, PostHandler]
    secret: str

    def server_bind(self) -> None:
        """Bind without resolving the host name, which takes seconds if no name server responds."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = HOST, self.server_address[1]

    def handle_error(self, request: socket.socket | tuple[bytes, socket.socket], client_address: Any) -> None:
        """Ignore clients that disconnected early; print the traceback of any other error, which is a bug."""
        if not isinstance(sys.exception(), (ConnectionError, TimeoutError)):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    timeout = REQUEST_TIMEOUT
    server_version, sys_version = "sylpose", ""

    def do_GET(self) -> None:
        self._send(self._respond(self.server.gets, self._parse_query))

    def do_POST(self) -> None:
        self._send(self._respond(self.server.posts, self._read_body))

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing: the address is secret."""

    def _respond(self, handlers: Mapping[str, Callable[[Any], Response]], read_input: Callable[[], Any]) -> Response:
        try:
            path = check_request_path(self.path, self.headers, self.server.secret, self.server.server_port)
        except PermissionError as error:
            return _error_response(403, str(error))
        if path not in handlers:
            return _error_response(404, "no such page")
        try:
            return handlers[path](read_input())
        except _RequestError as refused:
            return refused.response
        except ValueError as error:
            return _error_response(400, str(error))

    def _parse_query(self) -> dict[str, str]:
        return dict(parse_qsl(urlsplit(self.path).query, max_num_fields=10))

    def _read_body(self) -> bytes:
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()) or "Transfer-Encoding" in self.headers:
            raise _RequestError(_error_response(411, "a Content-Length is required"))
        if len(length) > 9 or int(length) > MAX_BODY:
            raise _RequestError(_error_response(413, f"longer than the allowed {MAX_BODY} bytes"))
        return self.rfile.read(int(length))

    def _send(self, response: Response) -> None:
        self.send_response(response.status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", response.media_type)
        self.send_header("Content-Length", str(len(response.body)))
        self.end_headers()
        self.wfile.write(response.body)
        self.wfile.flush()
        if response.on_sent is not None:
            response.on_sent()


class _RequestError(Exception):
    def __init__(self, response: Response) -> None:
        super().__init__()
        self.response = response


def create_secret() -> str:
    """Create an unguessable part of a URL."""
    return secrets.token_urlsafe(24)


def check_request_path(target: str, headers: Headers, secret: str, port: int, *, any_host: bool = False) -> str:
    """Check a request's host, origin and secret, and return its path below the secret without the query.

    Args:
        target: request target, "/secret/path?query".
        headers: headers of the request.
        secret: secret of the page.
        port: port at which the page listens on this computer.
        any_host: accept any host name, for a page that also listens on other network interfaces.

    Raises:
        PermissionError: a host name that is not this computer's, a request from another page, or a wrong secret.
    """
    host, origin = headers.get("Host"), headers.get("Origin")
    if (not any_host and host not in (f"{HOST}:{port}", f"localhost:{port}")) or origin not in (
        None,
        f"http://{host}",
    ):
        raise PermissionError("requested by a host name other than this computer's")
    token, _, path = urlsplit(target).path[1:].partition("/")
    if not hmac.compare_digest(token.encode(), secret.encode()):
        raise PermissionError("the address is not the one that was printed")
    return path


def open_browser(url: str) -> bool:
    """Open a page in the user's browser, unless it is a terminal browser; return whether that succeeded."""
    try:
        browser = webbrowser.get()
    except webbrowser.Error:
        return False
    return type(browser) is not webbrowser.GenericBrowser and browser.open(url)


def _error_response(status: int, message: str) -> Response:
    return json_response({"error": message}, status)
