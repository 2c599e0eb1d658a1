"""Viser server (extra `viewer`) with access control: only clients with the secret address, as in `local_page`."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

from sylpose.browser.local_page import HOST, check_request_path, create_secret

__all__ = ["THEME", "VISER_MISSING", "Viewer", "serve_viewer"]

VISER_MISSING = "the 3D page needs viser 1.1 or newer: pip install 'sylpose[viewer]'"
# Starting a viser server patches websockets, so only one can be started at a time.
_START_LOCK = threading.Lock()

# The page contains no links to other sites.
THEME = {"control_width": "medium", "show_logo": False, "show_share_button": False}

Viewer = Any  # viser.ViserServer, which is optional


@contextmanager
def serve_viewer(host: str = HOST, port: int = 0) -> Iterator[tuple[Viewer, str]]:
    """Start a server; yield it and the address of its page, which contains the secret.

    Args:
        host: address to listen at; this computer only by default.
        port: 0 for any free port.

    Raises:
        ValueError: viser is not installed.
        OSError: naming host and port if it cannot listen there.
    """
    viser, websockets = _import_viser()
    serve = websockets.serve
    port = _find_free_port(host, port)
    secret = create_secret()

    def serve_with_access_check(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        def check_access(connection: Any, request: Any) -> Any:
            own_port = connection.local_address[1]
            try:
                path = check_request_path(request.path, request.headers, secret, own_port, any_host=host != HOST)
            except PermissionError as error:
                return connection.respond(HTTPStatus.FORBIDDEN, f"{error}\n")
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


def _find_free_port(host: str, port: int) -> int:
    """Return a port that can be listened at, since viser would try others endlessly."""
    try:
        with socket.create_server((host, port)) as test_socket:
            return int(test_socket.getsockname()[1])
    except (OSError, OverflowError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise OSError(f"--host {host} --port {port}: cannot listen there ({why.lower()})") from None
