"""The parts of Google's (JSON) and Azure's (blob) protocols that reading needs; a folder is the server, as for S3."""

import json
from email.utils import format_datetime
from urllib.parse import parse_qs, unquote, urlsplit
from xml.sax.saxutils import escape

from s3_server import S3Handler, written

ACCOUNT = "devaccount"
FACTS = {
    "x-ms-server-encrypted": "true",
    "x-ms-request-id": "1",
    "x-ms-version": "2026-10-06",
    "x-ms-lease-status": "unlocked",
    "x-ms-has-immutability-policy": "false",
    "x-ms-has-legal-hold": "false",
    "x-ms-default-encryption-scope": "$account-encryption-key",
    "x-ms-deny-encryption-scope-override": "false",
}
"""What Azure's client wants in every answer, or ends the process."""


class GoogleHandler(S3Handler):
    """``/storage/v1/b/BUCKET/o``: listings and facts as JSON, content with ``alt=media``."""

    def respond(self, body):
        place, query = urlsplit(self.path), parse_qs(urlsplit(self.path).query)
        parts = place.path.removeprefix("/download").split("/", 6)[4:]  # BUCKET, "o", and where one is meant, KEY
        bucket, key = unquote(parts[0]), unquote(parts[2]) if len(parts) > 2 else ""
        top = self.server.folder / bucket
        if key:
            path = top / key
            if not path.is_file():
                self.error(404, "Not Found", body)
            elif query.get("alt") == ["media"]:
                self.content(path, key, body)
            else:
                self.plain(self.facts(bucket, key, path), body)
        elif not top.is_dir():
            self.error(404, "Not Found", body)
        else:
            files = self.below(top, query.get("prefix", [""])[0])
            self.plain({"kind": "storage#objects", "items": [self.facts(bucket, *file) for file in files]}, body)

    def facts(self, bucket, key, path):
        when = written(path).strftime("%Y-%m-%dT%H:%M:%SZ")
        return {
            "kind": "storage#object",
            "bucket": bucket,
            "name": key,
            "size": str(path.stat().st_size),
            "generation": "1",
            "metageneration": "1",
            "timeCreated": when,
            "updated": when,
        }

    def plain(self, facts, body):
        self.send(200, json.dumps(facts).encode(), "application/json", body)

    def error(self, status, code, body):
        self.send(status, json.dumps({"error": {"code": status, "message": code}}).encode(), "application/json", body)


class AzureHandler(S3Handler):
    """``/ACCOUNT/CONTAINER/KEY`` without a hierarchy of folders, as Azure's own emulator serves it."""

    def respond(self, body):
        place, query = urlsplit(self.path), parse_qs(urlsplit(self.path).query)
        bucket, _, key = unquote(place.path).removeprefix(f"/{ACCOUNT}/").partition("/")
        top = self.server.folder / bucket
        if query.get("action") == ["getAccessControl"]:
            self.error(400, "HierarchicalNamespaceNotEnabled", body)
        elif not top.is_dir():
            self.error(404, "ContainerNotFound", body)
        elif query.get("comp") == ["list"]:
            self.send(200, self.listing(bucket, top, query.get("prefix", [""])[0]), "application/xml", body)
        elif not key:
            self.send(200, b"", "application/xml", body, self.dates(top))
        elif not (top / key).is_file():
            self.error(404, "BlobNotFound", body)
        else:
            extra = {**self.dates(top / key), "x-ms-blob-type": "BlockBlob"}
            self.content(top / key, key, body, extra)

    def dates(self, path):
        when = format_datetime(written(path), usegmt=True)
        return {
            "Last-Modified": when,
            "ETag": '"0x1"',
            "x-ms-creation-time": when,
            "x-ms-lease-state": "available",
            **FACTS,
        }

    def listing(self, bucket, top, prefix):
        """As with the delimiter ``/``: what lies deeper is named by its folder alone."""
        blobs, folders = [], {}
        for key, path in self.below(top, prefix):
            inner, slash, _ = key.removeprefix(prefix).partition("/")
            if slash:
                folders[f"{prefix}{inner}/"] = None
                continue
            when, size = format_datetime(written(path), usegmt=True), path.stat().st_size
            blobs.append(
                f"<Blob><Name>{escape(key)}</Name><Properties><Creation-Time>{when}</Creation-Time>"
                f"<Last-Modified>{when}</Last-Modified><Etag>0x1</Etag><Content-Length>{size}</Content-Length>"
                f"<BlobType>BlockBlob</BlobType></Properties></Blob>"
            )
        blobs += [f"<BlobPrefix><Name>{escape(name)}</Name></BlobPrefix>" for name in folders]
        return (
            f'<?xml version="1.0" encoding="utf-8"?><EnumerationResults ContainerName="{bucket}">'
            f"<Prefix>{escape(prefix)}</Prefix><Blobs>{''.join(blobs)}</Blobs><NextMarker /></EnumerationResults>"
        ).encode()

    def error(self, status, code, body):
        text = f'<?xml version="1.0"?><Error><Code>{code}</Code><Message>{code}</Message></Error>'.encode()
        # Without a body there is none to parse.
        kind = "application/xml" if body else "application/octet-stream"
        self.send(status, text if body else b"", kind, body, {"x-ms-error-code": code})
