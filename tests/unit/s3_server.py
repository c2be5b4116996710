"""The parts of S3's protocol that reading needs: HEAD, ranges of GET, and ListObjectsV2; a folder is the server."""

import threading
import time
from contextlib import contextmanager
from datetime import UTC, datetime
from email.utils import format_datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape


class S3Handler(BaseHTTPRequestHandler):
    """Answers by `mode` of the server; other protocols replace `respond` and `error`."""

    protocol_version = "HTTP/1.1"

    def log_message(self, *parts):
        pass

    def do_HEAD(self):
        self.answer(body=False)

    def do_GET(self):
        self.answer(body=True)

    def answer(self, body):
        server = self.server
        server.requests.append((self.command, self.path, self.headers.get("Range", "")))
        if server.mode == "hang":
            time.sleep(server.hang_s)
        if server.mode == "refuse":
            self.error(403, "AccessDenied", body)
            return
        self.respond(body)

    def respond(self, body):
        place = urlsplit(self.path)
        bucket, _, key = unquote(place.path).lstrip("/").partition("/")
        query = parse_qs(place.query, keep_blank_values=True)
        if not (self.server.folder / bucket).is_dir():
            self.error(404, "NoSuchBucket", body)
        elif not key:
            self.send(200, self.listing(bucket, query) if body else b"", "application/xml", body)
        elif not (self.server.folder / bucket / key).is_file():
            self.error(404, "NoSuchKey", body)
        else:
            self.content(self.server.folder / bucket / key, key, body)

    def content(self, path, key, body, extra=()):
        content, status, extra = path.read_bytes(), 200, dict(extra)
        if self.server.mode == "cut" and key.endswith(".f32"):
            content = content[:-4] + b"\0\0\0\0"
        asked = self.headers.get("Range") or self.headers.get("x-ms-range")
        if asked:
            first, last = asked.removeprefix("bytes=").split("-")
            stop = min(int(last) + 1, len(content)) if last else len(content)
            extra |= {"Content-Range": f"bytes {first}-{stop - 1}/{len(content)}"}
            content, status = content[int(first) : stop], 206
        extra = {"Last-Modified": format_datetime(written(path), usegmt=True), "ETag": '"0"'} | extra
        self.send(status, content, "application/octet-stream", body, extra)

    def below(self, top, prefix):
        """Keys that begin with a prefix, and their files."""
        files = ((path.relative_to(top).as_posix(), path) for path in sorted(top.rglob("*")) if path.is_file())
        return [(key, path) for key, path in files if key.startswith(prefix)]

    def listing(self, bucket, query):
        prefix = query.get("prefix", [""])[0]
        parts = []
        for key, path in self.below(self.server.folder / bucket, prefix):
            when = written(path).strftime("%Y-%m-%dT%H:%M:%S.000Z")
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

    def error(self, status, code, body):
        text = f'<?xml version="1.0"?><Error><Code>{code}</Code><Message>{code}</Message></Error>'.encode()
        self.send(status, text if body else b"", "application/xml", body)

    def send(self, status, content, kind, body, extra=()):
        self.send_response(status)
        for name, value in {"Content-Type": kind, "Content-Length": str(len(content)), **dict(extra)}.items():
            self.send_header(name, value)
        self.end_headers()
        if body:
            self.wfile.write(content)


def written(path):
    return datetime.fromtimestamp(int(path.stat().st_mtime), tz=UTC)


@contextmanager
def serving(folder, handler=S3Handler):
    """A server of the folders in a folder, each a bucket; its ``mode`` is ok, refuse, cut or hang."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    server.folder, server.mode, server.requests, server.hang_s = folder, "ok", [], 3.0
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
