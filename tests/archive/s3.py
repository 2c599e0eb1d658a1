"""In-memory S3 server with the operations that archives need, for tests with real clients and processes."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from email.utils import formatdate
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape

Bucket = dict[str, bytes]


@contextmanager
def s3_server(bucket: Bucket) -> Iterator[str]:
    """Run a server with one bucket, "lab"; yield its address."""
    lock = threading.Lock()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_: object) -> None:
            pass

        def answer(self, code: int, content: bytes = b"", etag: str = "") -> None:
            self.send_response(code)
            self.send_header("Content-Length", str(len(content)))
            if etag:
                self.send_header("ETag", etag)
                self.send_header("Last-Modified", formatdate(usegmt=True))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(content)

        @property
        def key(self) -> str:
            return unquote(urlsplit(self.path).path).removeprefix("/lab").lstrip("/")

        def do_PUT(self) -> None:
            content = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            with lock:
                taken = self.headers.get("If-None-Match") == "*" and self.key in bucket
                if not taken:
                    bucket[self.key] = content
            self.answer(412 if taken else 200, b"", etag_of(content))

        def do_GET(self) -> None:
            arguments = {name: values[0] for name, values in parse_qs(urlsplit(self.path).query).items()}
            if "list-type" in arguments:
                self.answer(200, listing(dict(bucket), arguments.get("prefix", ""), arguments.get("delimiter", "")))
            elif self.key in bucket:
                self.answer(200, bucket[self.key], etag_of(bucket[self.key]))
            else:
                self.answer(404, b"<Error><Code>NoSuchKey</Code></Error>")

        do_HEAD = do_GET

        def do_DELETE(self) -> None:
            bucket.pop(self.key, None)
            self.answer(204)

        def do_POST(self) -> None:  # several at once
            body = self.rfile.read(int(self.headers["Content-Length"])).decode()
            keys = [part.partition("</Key>")[0] for part in body.split("<Key>")[1:]]
            for key in keys:
                bucket.pop(key, None)
            deleted = "".join(f"<Deleted><Key>{escape(key)}</Key></Deleted>" for key in keys)
            self.answer(200, f"<DeleteResult>{deleted}</DeleteResult>".encode())

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


def etag_of(content: bytes) -> str:
    return f'"{hashlib.md5(content).hexdigest()}"'


def listing(bucket: Bucket, prefix: str, delimiter: str) -> bytes:
    keys, folders = [], set()
    for key in sorted(key for key in bucket if key.startswith(prefix)):
        rest = key[len(prefix) :]
        if delimiter and delimiter in rest:
            folders.add(prefix + rest.partition(delimiter)[0] + delimiter)
        else:
            keys.append(key)
    entries = "".join(
        f"<Contents><Key>{escape(key)}</Key><LastModified>2026-01-01T00:00:00.000Z</LastModified>"
        f"<ETag>{escape(etag_of(bucket[key]))}</ETag><Size>{len(bucket[key])}</Size></Contents>"
        for key in keys
    )
    entries += "".join(f"<CommonPrefixes><Prefix>{escape(f)}</Prefix></CommonPrefixes>" for f in sorted(folders))
    return f"<ListBucketResult><IsTruncated>false</IsTruncated>{entries}</ListBucketResult>".encode()
