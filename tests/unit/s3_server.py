"""The parts of S3's protocol that reading needs: HEAD, ranges of GET, and ListObjectsV2; a folder is the server."""

import threading
import time
from contextlib import contextmanager
from datetime import UTC, datetime
from email.utils import format_datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *parts):
        pass

    def do_HEAD(self):
        self._answer(body=False)

    def do_GET(self):
        self._answer(body=True)

    def _answer(self, body):
        server = self.server
        server.requests.append((self.command, self.path, self.headers.get("Range", "")))
        if server.mode == "hang":
            time.sleep(server.hang_s)
        if server.mode == "refuse":
            self._error(403, "AccessDenied", body)
            return
        place = urlsplit(self.path)
        bucket, _, key = unquote(place.path).lstrip("/").partition("/")
        query = parse_qs(place.query, keep_blank_values=True)
        if not (server.folder / bucket).is_dir():
            self._error(404, "NoSuchBucket", body)
        elif not key:
            self._send(200, self._listing(bucket, query) if body else b"", "application/xml", body)
        else:
            self._object(server.folder / bucket / key, key, body)

    def _object(self, path, key, body):
        if not path.is_file():
            self._error(404, "NoSuchKey", body)
            return
        content, status, extra = path.read_bytes(), 200, {}
        if self.server.mode == "cut" and key.endswith(".f32"):
            content = content[:-4] + b"\0\0\0\0"
        asked = self.headers.get("Range")
        if asked:
            first, last = asked.removeprefix("bytes=").split("-")
            stop = min(int(last) + 1, len(content))
            extra = {"Content-Range": f"bytes {first}-{stop - 1}/{len(content)}"}
            content, status = content[int(first) : stop], 206
        extra |= {"Last-Modified": format_datetime(_written(path), usegmt=True), "ETag": '"0"'}
        self._send(status, content, "application/octet-stream", body, extra)

    def _listing(self, bucket, query):
        top = self.server.folder / bucket
        prefix = query.get("prefix", [""])[0]
        parts = []
        for path in sorted(path for path in top.rglob("*") if path.is_file()):
            key = path.relative_to(top).as_posix()
            if key.startswith(prefix):
                when = _written(path).strftime("%Y-%m-%dT%H:%M:%S.000Z")
                size = path.stat().st_size
                parts.append(
                    f"<Contents><Key>{escape(key)}</Key><LastModified>{when}</LastModified><ETag>&quot;0&quot;</ETag>"
                    f"<Size>{size}</Size><StorageClass>STANDARD</StorageClass></Contents>"
                )
        most = int(query.get("max-keys", ["1000"])[0])
        return (
            '<?xml version="1.0" encoding="UTF-8"?><ListBucketResult '
            f'xmlns="http://s3.amazonaws.com/doc/2006-03-01/"><Name>{bucket}</Name><Prefix>{escape(prefix)}</Prefix>'
            f"<KeyCount>{len(parts[:most])}</KeyCount><MaxKeys>{most}</MaxKeys><IsTruncated>false</IsTruncated>"
            f"{''.join(parts[:most])}</ListBucketResult>"
        ).encode()

    def _error(self, status, code, body):
        text = f'<?xml version="1.0"?><Error><Code>{code}</Code><Message>{code}</Message></Error>'.encode()
        self._send(status, text if body else b"", "application/xml", body)

    def _send(self, status, content, kind, body, extra=()):
        self.send_response(status)
        for name, value in {"Content-Type": kind, "Content-Length": str(len(content)), **dict(extra)}.items():
            self.send_header(name, value)
        self.end_headers()
        if body:
            self.wfile.write(content)


def _written(path):
    return datetime.fromtimestamp(int(path.stat().st_mtime), tz=UTC)


@contextmanager
def serving(folder):
    """A server of the folders in a folder, each a bucket; its ``mode`` is ok, refuse, cut or hang."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
    server.daemon_threads = True
    server.folder, server.mode, server.requests, server.hang_s = folder, "ok", [], 3.0
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
