"""viser's server (the extra `viewer`), which itself lets everybody in: here only who has the address, as of `local_page`."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

from sylpose.app.local_page import HOST, new_secret, path_within

__all__ = ["MISSING", "THEME", "Viewer", "viewer_server"]

MISSING = "the 3D page needs viser 1.1 or newer: pip install 'sylpose[viewer]'"
# viser takes its server from websockets while it starts: one at a time.
_STARTING = threading.Lock()

# Nothing on the page leads anywhere else.
THEME = {"control_width": "medium", "show_logo": False, "show_share_button": False}

Viewer = Any  # viser.ViserServer, which is optional


@contextmanager
def viewer_server(host: str = HOST, port: int = 0) -> Iterator[tuple[Viewer, str]]:
    """A server and the address of its page, the secret in it.

    Args:
        host: what it listens at; this computer alone by default.
        port: 0 for any that is free.

    Raises:
        ValueError: viser is not there.
        OSError: naming host and port, where it cannot listen.
    """
    viser, websockets = _loaded()
    serve = websockets.serve
    port = _free(host, port)
    secret = new_secret()

    def guarded(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        def asked(connection: Any, request: Any) -> Any:
            own_port = connection.local_address[1]
            try:
                path = path_within(request.path, request.headers, secret, own_port, by_any_name=host != HOST)
            except PermissionError as error:
                return connection.respond(HTTPStatus.FORBIDDEN, f"{error}\n")
            request.path = f"/{path}"
            return process_request(connection, request)

        return serve(handler, host, port, process_request=asked, **options)

    with _STARTING:
        websockets.serve = guarded
        try:
            server = viser.ViserServer(host, port, label="sylpose", verbose=False)
        finally:
            websockets.serve = serve
    try:
        if server.get_port() != port:  # it goes on to the next one
            raise OSError(f"--port {port}: cannot listen there (somebody else has taken it)")
        # Nothing in the page may ask for a tunnel to a server of viser's, through which everybody would get in.
        server.request_share_url = lambda *_, **__: None
        server.gui.configure_theme(**THEME)
        server.gui.main_panel.dock_right()  # beside the scene, not over it
        # All addresses of this computer have that one, too.
        named = HOST if host in ("0.0.0.0", "::", "") else f"[{host}]" if ":" in host else host
        yield server, f"http://{named}:{port}/{secret}/"
    finally:
        server.stop()


def _loaded() -> tuple[Any, Any]:
    """viser, and what it serves with."""
    try:
        import rich
        import viser
        import websockets.asyncio.server as websockets
    except ImportError:
        raise ValueError(MISSING) from None
    if tuple(map(int, viser.__version__.split(".")[:2])) < (1, 1):
        raise ValueError(MISSING)
    rich.reconfigure(quiet=True)  # it would say the address without the secret, which opens nothing
    return viser, websockets


def _free(host: str, port: int) -> int:
    """A port that can be listened at: viser would try others for ever."""
    try:
        with socket.create_server((host, port)) as tried:
            return int(tried.getsockname()[1])
    except (OSError, OverflowError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise OSError(f"--host {host} --port {port}: cannot listen there ({why.lower()})") from None
