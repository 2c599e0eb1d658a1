"""Servers of pages for the user who started the command, reachable only under a secret URL.

Other users of the computer and other pages in the same browser lack the secret. Requests by a foreign host name that
resolves to this computer (DNS rebinding) are refused. `serve_page` serves own handlers, `serve_viewer` viser's 3D page
(extra `viewer`).
"""

from __future__ import annotations

import hmac
import os
import secrets
import socket
import sys
import threading
import webbrowser
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import msgspec

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
VISER_MISSING = "the 3D page needs viser 1.1 or newer: pip install 'sylpose[viewer]'"
# The 3D page contains no links to other sites.
THEME = {"control_width": "medium", "show_logo": False, "show_share_button": False}
# Starting a viser server patches websockets, so only one can be started at a time.
_START_LOCK = threading.Lock()


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


GetHandler = Callable[[Mapping[str, str]], Response]
PostHandler = Callable[[bytes], Response]


@contextmanager
def serve_page(gets: Mapping[str, GetHandler], posts: Mapping[str, PostHandler], port: int = 0) -> Iterator[str]:
    """Serve a page on this computer from background threads; yield its URL, which contains the secret.

    A `ValueError` or `OSError` of a handler becomes `{"error": message}` with a status of 400 or more.

    Args:
        gets: GET handlers by path, called with the query's values; "" is the page itself.
        posts: POST handlers by path, called with the request body.
        port: port to listen at; 0 for any free one.

    Raises:
        OSError: the port is in use; the message names it.
    """
    try:
        server = _Server((HOST, port), _Handler)
    except (OSError, OverflowError) as error:
        raise _listen_error(f"--port {port}", error, "; 0 selects a free port") from None
    server.gets, server.posts, server.secret = gets, posts, secrets.token_urlsafe(24)
    threading.Thread(target=server.serve_forever, args=(0.1,), daemon=True).start()
    try:
        yield f"http://{HOST}:{server.server_address[1]}/{server.secret}/"
    finally:
        server.shutdown()
        server.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    # On POSIX this allows reusing a port at once; on Windows it would let two programs share it.
    allow_reuse_address = os.name != "nt"
    gets: Mapping[str, GetHandler]
    posts: Mapping[str, PostHandler]
    secret: str

    def server_bind(self) -> None:
        """Bind without resolving the host name, which takes seconds if no name server responds."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = HOST, self.server_address[1]

    def handle_error(self, request: socket.socket | tuple[bytes, socket.socket], client_address: Any) -> None:
        """Ignore clients that disconnected early; print the traceback of any other error, which is a bug."""
        if not isinstance(sys.exception(), (ConnectionError, TimeoutError)):
            super().handle_error(request, client_address)


class _Refusal(ValueError):
    """Refusal of a request, with its HTTP status."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status


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
            path = _check_request(self.path, self.headers, self.server.secret, self.server.server_port)
            if path not in handlers:
                raise _Refusal(404, "no such page")
            return handlers[path](read_input())
        except (ValueError, OSError) as error:
            return json_response({"error": str(error)}, error.status if isinstance(error, _Refusal) else 400)

    def _parse_query(self) -> dict[str, str]:
        return dict(parse_qsl(urlsplit(self.path).query, max_num_fields=10))

    def _read_body(self) -> bytes:
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()) or "Transfer-Encoding" in self.headers:
            raise _Refusal(411, "a Content-Length is required")
        if len(length) > 9 or int(length) > MAX_BODY:
            raise _Refusal(413, f"longer than the allowed {MAX_BODY} bytes")
        return self.rfile.read(int(length))

    def _send(self, response: Response) -> None:
        self.send_response(response.status)
        size = str(len(response.body))
        for name, value in {**_HEADERS, "Content-Type": response.media_type, "Content-Length": size}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(response.body)
        self.wfile.flush()
        if response.on_sent is not None:
            response.on_sent()


def _check_request(target: str, headers: Any, secret: str, port: int, *, any_host: bool = False) -> str:
    """Check a request's host, origin and secret, and return its path below the secret without the query.

    Args:
        target: request target, "/secret/path?query".
        headers: headers of the request, by `get`.
        secret: secret of the page.
        port: port at which the page listens on this computer.
        any_host: accept any host name, for a page that also listens on other network interfaces.

    Raises:
        _Refusal: a host name that is not this computer's, a request from another page, or a wrong secret.
    """
    host, origin = headers.get("Host"), headers.get("Origin")
    is_host = any_host or host in (f"{HOST}:{port}", f"localhost:{port}")
    if not is_host or origin not in (None, f"http://{host}"):
        raise _Refusal(403, "requested by a host name other than this computer's")
    token, _, path = urlsplit(target).path[1:].partition("/")
    if not hmac.compare_digest(token.encode(), secret.encode()):
        raise _Refusal(403, "the address is not the one that was printed")
    return path


def _listen_error(options: str, error: OSError | OverflowError, remedy: str = "") -> OSError:
    reason = getattr(error, "strerror", None) or str(error)
    return OSError(f"{options}: cannot listen there ({reason.lower()}){remedy}")


def open_browser(url: str) -> bool:
    """Open a page in the user's browser, unless it is a terminal browser; return whether that succeeded."""
    try:
        browser = webbrowser.get()
    except webbrowser.Error:
        return False
    return type(browser) is not webbrowser.GenericBrowser and browser.open(url)


@contextmanager
def serve_viewer(host: str = HOST, port: int = 0) -> Iterator[tuple[Any, str]]:
    """Start a viser server; yield it and the address of its page, which contains the secret.

    Args:
        host: address to listen at; this computer only by default.
        port: 0 for any free port.

    Raises:
        ValueError: viser is not installed.
        OSError: naming host and port if it cannot listen there.
    """
    viser, websockets = _import_viser()
    serve, secret = websockets.serve, secrets.token_urlsafe(24)
    try:  # viser would try other ports endlessly
        with socket.create_server((host, port)) as test_socket:
            port = int(test_socket.getsockname()[1])
    except (OSError, OverflowError) as error:
        raise _listen_error(f"--host {host} --port {port}", error) from None

    def serve_with_access_check(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        def check_access(connection: Any, request: Any) -> Any:
            own_port = connection.local_address[1]
            try:
                path = _check_request(request.path, request.headers, secret, own_port, any_host=host != HOST)
            except _Refusal as refusal:
                return connection.respond(HTTPStatus(refusal.status), f"{refusal}\n")
            request.path = f"/{path}"
            return process_request(connection, request)

        return serve(handler, host, port, process_request=check_access, **options)

    with _START_LOCK:
        websockets.serve = serve_with_access_check
        try:
            server = viser.ViserServer(host, port, label="sylpose", verbose=False)
        finally:
            websockets.serve = serve
    try:
        if server.get_port() != port:  # viser tries the next ports
            raise OSError(f"--port {port}: cannot listen there (another process uses it)")
        # Disable the page's requests for a tunnel to viser's server, which would give access to everyone.
        server.request_share_url = lambda *_, **__: None
        server.gui.configure_theme(**THEME)
        server.gui.main_panel.dock_right()  # next to the scene, not over it
        # A server that listens at all addresses is reachable at this one, too.
        shown_host = HOST if host in ("0.0.0.0", "::", "") else f"[{host}]" if ":" in host else host
        yield server, f"http://{shown_host}:{port}/{secret}/"
    finally:
        server.stop()


def _import_viser() -> tuple[Any, Any]:
    """Import viser and the websockets module that it uses."""
    try:
        import rich
        import viser
        import websockets.asyncio.server as websockets
    except ImportError:
        raise ValueError(VISER_MISSING) from None
    if tuple(map(int, viser.__version__.split(".")[:2])) < (1, 1):
        raise ValueError(VISER_MISSING)
    rich.reconfigure(quiet=True)  # it would print the address without the secret, which is useless
    return viser, websockets
