"""Local pages are served only to the user who started the command (SECURITY.md)."""

from __future__ import annotations

import http.client
import json
import socket
import webbrowser
from collections.abc import Iterator, Mapping
from urllib.parse import urlsplit

import pytest

from sylpose.browser.server import MAX_BODY, Response, json_response, open_browser, serve_page


def refuse(_: bytes) -> Response:
    raise ValueError("the box of cam_0 is not inside the image")


def fail_to_write(_: bytes) -> Response:
    raise PermissionError("boxes.toml: permission denied")


@pytest.fixture
def page() -> Iterator[str]:
    gets = {"": lambda _: Response(b"page", "text/html"), "asked": lambda query: json_response(dict(query))}
    posts = {"sent": lambda body: json_response({"bytes": len(body)}), "refused": refuse, "unwritable": fail_to_write}
    with serve_page(gets, posts) as page:
        yield page


def send_request(
    page: str,
    path: str = "",
    *,
    method: str = "GET",
    body: bytes | None = None,
    headers: Mapping[str, str] | None = None,
    full_path: str | None = None,
) -> tuple[int, bytes, Mapping[str, str]]:
    """Send a request and return status, body and headers; `full_path` replaces the path below the page's URL."""
    url = urlsplit(page)
    connection = http.client.HTTPConnection("127.0.0.1", url.port or 0, timeout=60)
    connection.request(method, url.path + path if full_path is None else full_path, body, dict(headers or {}))
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer.status, content, dict(answer.headers)


def test_requests_are_answered(page: str) -> None:
    status, body, headers = send_request(page)
    assert (status, body, headers["Content-Type"]) == (200, b"page", "text/html")
    assert "frame-ancestors 'none'" in headers["Content-Security-Policy"]
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert headers["Cache-Control"] == "no-store"
    assert json.loads(send_request(page, "asked?a=1&b=c%20d")[1]) == {"a": "1", "b": "c d"}
    assert json.loads(send_request(page, "sent", method="POST", body=b"12345")[1]) == {"bytes": 5}
    status, body, _ = send_request(page, "refused", method="POST", body=b"{}")
    assert (status, json.loads(body)) == (400, {"error": "the box of cam_0 is not inside the image"})
    status, body, _ = send_request(page, "unwritable", method="POST", body=b"{}")
    assert (status, json.loads(body)) == (400, {"error": "boxes.toml: permission denied"})


def test_page_listens_on_loopback_only(page: str) -> None:
    assert urlsplit(page).hostname == "127.0.0.1"
    with pytest.raises(OSError, match=r"refused|assign|unreachable"):  # another address of this computer
        socket.create_connection(("127.0.0.2", urlsplit(page).port or 0), timeout=60)


def test_requests_without_the_secret_are_rejected(page: str) -> None:
    secret = urlsplit(page).path.strip("/")
    assert len(secret) >= 32
    for path in ("/", "/asked", f"/{secret[:-1]}/", f"/{secret}x/", f"/{secret.swapcase()}/", "/%00/"):
        status, body, _ = send_request(page, full_path=path)
        assert status == 403, path
        assert secret.encode() not in body
        assert b"page" not in body
    assert send_request(page, full_path="/sent", method="POST", body=b"1")[0] == 403
    with serve_page({}, {}) as another:
        assert urlsplit(another).path.strip("/") != secret


def test_foreign_hosts_and_origins_are_rejected(page: str) -> None:
    port = urlsplit(page).port
    for host in ("evil.example", f"evil.example:{port}", "127.0.0.1", f"127.0.0.1:{port}.evil.example", ""):
        assert send_request(page, headers={"Host": host})[0] == 403, host
    assert send_request(page, headers={"Host": f"localhost:{port}"})[0] == 200
    for origin in ("http://evil.example", "null", f"https://127.0.0.1:{port}"):
        assert send_request(page, "sent", method="POST", body=b"1", headers={"Origin": origin})[0] == 403, origin
    assert (
        send_request(page, "sent", method="POST", body=b"1", headers={"Origin": f"http://127.0.0.1:{port}"})[0] == 200
    )


def test_other_paths_and_methods_are_rejected(page: str) -> None:
    for path in ("nothing", "../", "sent", "%2e%2e/etc/passwd", "asked/"):
        assert send_request(page, path)[0] == 404, path
    assert send_request(page, "asked", method="POST", body=b"1")[0] == 404
    for method in ("PUT", "DELETE", "OPTIONS", "HEAD", "TRACE"):
        assert send_request(page, method=method)[0] == 501, method


def test_request_size_is_limited(page: str) -> None:
    for length, status in ((str(MAX_BODY + 1), 413), ("9" * 30, 413), ("-1", 411), ("", 411), ("1e3", 411)):
        assert send_request(page, "sent", method="POST", headers={"Content-Length": length})[0] == status, length
    headers = {"Content-Length": "3", "Transfer-Encoding": "chunked"}
    assert send_request(page, "sent", method="POST", headers=headers)[0] == 411
    assert send_request(page, "asked?" + "&".join(f"k{k}=1" for k in range(50)))[0] == 400


def test_port_in_use_is_named(page: str) -> None:
    port = urlsplit(page).port or 0
    message = f"--port {port}: cannot listen there .*; 0 selects a free port"
    with pytest.raises(OSError, match=message), serve_page({}, {}, port):
        pass


def test_server_stops_with_its_context() -> None:
    with serve_page({}, {}) as page:
        port = urlsplit(page).port or 0
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), timeout=60)


def test_terminal_browsers_are_not_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []

    class Window(webbrowser.BackgroundBrowser):
        def open(self, url: str, new: int = 0, autoraise: bool = True) -> bool:  # noqa: ARG002
            shown.append(url)
            return True

    monkeypatch.setattr(webbrowser, "get", lambda: webbrowser.GenericBrowser("lynx"))
    assert not open_browser("http://127.0.0.1/a")
    monkeypatch.setattr(webbrowser, "get", lambda: Window("firefox"))
    assert open_browser("http://127.0.0.1/b")
    assert shown == ["http://127.0.0.1/b"]
