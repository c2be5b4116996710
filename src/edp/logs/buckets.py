"""Logs and stores in buckets of S3, Google Cloud and Azure: listed, and copied to this machine, within bounded time.

Credentials are those that each service's own tools read from the environment; EDP takes none in an address.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any, TypeVar
from urllib.parse import urlsplit

from edp.errors import ConfigError, DataError, StorageError, brief
from edp.storage import make_folder, replacing
from edp.wording import typed

ADDRESS = re.compile(r"(s3|gs|az):/{1,2}([^/]+)(?:/(.*))?", re.DOTALL)
"""Pattern of a bucket address. A path object removes one of the two slashes."""
CONNECT_S, ANSWER_S, STEP_S = 10.0, 30.0, 120.0
"""Time limits to connect, for the answer to a request, and for a step (a listing, or part of an object) with its
retries."""
ATTEMPTS = 3
PIECE_BYTES = 8 * 2**20
MAX_OBJECTS = 1_000_000
HELP = {
    "s3": "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION, or a profile; AWS_ENDPOINT_URL for another server",
    "gs": "GOOGLE_APPLICATION_CREDENTIALS; STORAGE_EMULATOR_HOST for another server",
    "az": "AZURE_STORAGE_ACCOUNT and AZURE_STORAGE_KEY, or a login of az; AZURE_STORAGE_ENDPOINT for another server",
}
"""Where each service looks for credentials."""
Result = TypeVar("Result")


@dataclass(frozen=True)
class RemoteFile:
    """An object of a bucket: its address, bytes, and when it was written, in nanoseconds since 1970."""

    address: str
    size: int
    written_ns: int

    @property
    def name(self) -> str:
        """The last part of its key."""
        return self.address.rsplit("/", 1)[-1]


def bucket_address(path: str | Path) -> str:
    """Return the address ``SCHEME://BUCKET/KEY`` of a path; empty for a local path."""
    match = ADDRESS.fullmatch(str(path))
    return f"{match[1]}://{match[2]}/{match[3] or ''}".rstrip("/") if match else ""


class BucketReader:
    """Read access to one bucket.

    Args:
        address: address of any object in the bucket.

    Raises:
        ConfigError: an address that names no bucket, or holds credentials.
    """

    def __init__(self, address: str) -> None:
        match = ADDRESS.fullmatch(address)
        if match is None:
            raise ConfigError(f"'{address}' is no address of a bucket; write s3://BUCKET/KEY, gs:// or az:// likewise")
        self.scheme, self.bucket = match[1], match[2]
        if "@" in self.bucket or "?" in address:
            raise ConfigError(
                f"the address of bucket '{self.bucket.rsplit('@', 1)[-1]}' holds credentials or options; leave them "
                f"out and set them in the environment: {HELP[self.scheme]}"
            )
        self._files: Any = self._run_step(lambda: _file_system(self.scheme), address)

    def objects(self, address: str) -> list[RemoteFile]:
        """Return the objects below an address, or the object at it, sorted by name.

        Raises:
            DataError: there is none.
            StorageError: the bucket refuses, or does not answer.
        """
        from pyarrow.fs import FileSelector, FileType

        path = self._path(address)

        def listed() -> list[Any]:
            at = self._files.get_file_info(path)
            if at.type == FileType.File:
                return [at]
            return list(self._files.get_file_info(FileSelector(path, recursive=True, allow_not_found=True)))

        files = [entry for entry in self._run_step(listed, address) if entry.type == FileType.File]
        if not files:
            raise DataError(f"'{address}' does not exist: the bucket has no object of this name and none below it")
        if len(files) > MAX_OBJECTS:
            raise DataError(
                f"'{address}' has {len(files):,} objects; at most {MAX_OBJECTS:,} are listed: give a part of it"
            )
        objects = [
            RemoteFile(f"{self.scheme}://{entry.path}", int(entry.size), int(entry.mtime_ns or 0)) for entry in files
        ]
        return sorted(objects, key=lambda file: file.address)

    def read(self, address: str, most: int) -> bytes:
        """Return a whole object of at most `most` bytes."""
        return b"".join(self._pieces(address, most))

    def copy(self, file: RemoteFile, target: Path) -> str:
        """Copy an object to a new file, completely or not at all, and return the BLAKE2b digest of the received bytes.

        Raises:
            DataError: it is not there, or has not the bytes that were announced.
            StorageError: the bucket refuses or does not answer, or the disk is full.
        """
        digest, size = hashlib.blake2b(digest_size=16), 0
        with replacing(target) as temporary, temporary.open("wb") as stream:
            for piece in self._pieces(file.address, file.size):
                digest.update(piece)
                size += len(piece)
                stream.write(piece)
            if size != file.size:
                raise DataError(
                    f"'{file.address}' ended after {size:,} of {file.size:,} bytes; it was changed while it was read: "
                    "try again"
                )
        return digest.hexdigest()

    def _pieces(self, address: str, most: int) -> Iterator[bytes]:
        # As a stream: of a file, pyarrow asks Google's servers for all bytes, and holds the interpreter's lock,
        # so that no limit of time would count.
        stream: IO[bytes] = self._run_step(lambda: self._files.open_input_stream(self._path(address), None), address)
        came = 0
        while piece := self._run_step(lambda: stream.read(PIECE_BYTES), address):
            came += len(piece)
            if came > most:
                raise DataError(f"'{address}' has more than the {most:,} bytes expected; it was changed: list it again")
            yield piece

    def _path(self, address: str) -> str:
        match = ADDRESS.fullmatch(address)
        if match is None or match[2] != self.bucket:
            raise ConfigError(f"'{address}' does not lie in bucket '{self.bucket}'")
        return f"{self.bucket}/{match[3]}" if match[3] else self.bucket

    def _run_step(self, step: Callable[[], Result], address: str) -> Result:
        """Run a step with the time limit `STEP_S` and translate its errors."""
        results: list[Result] = []
        errors: list[BaseException] = []

        def work() -> None:
            try:
                results.append(step())
            except BaseException as error:  # handed on below, in the thread that waits
                errors.append(error)

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        thread.join(STEP_S)
        if results:
            return results[0]
        if not errors:
            raise StorageError(
                f"'{address}' did not answer within {typed(STEP_S)} s; see that the server can be reached from here, "
                "and "
                "try again: what was copied stays"
            )
        raise self._describe_error(errors[0], address) from errors[0]

    def _describe_error(self, error: BaseException, address: str) -> BaseException:
        if isinstance(error, FileNotFoundError):
            return DataError(f"'{address}' does not exist: the bucket has no object of this name")
        from pyarrow import ArrowException

        # Azure's refusals come as pyarrow's own errors.
        if not isinstance(error, OSError | ArrowException):
            return error
        text = brief(error, 300)
        if REFUSED.search(text.upper().replace(" ", "_")):
            return StorageError(f"'{address}': the bucket refuses to be read ({text}); set {HELP[self.scheme]}")
        return StorageError(f"'{address}' cannot be read: {text}; see that the server can be reached, and try again")


REFUSED = re.compile(
    # Numbers stand alone: a port or a key may hold their digits.
    r"ACCESS_?DENIED|PERMISSION_DENIED|FORBIDDEN|(?<![0-9A-Z:])40[13](?![0-9])|UNAUTHORIZED|AUTHORIZATION|"
    r"AUTHENTICATION|INVALID_?ACCESS_?KEY|SIGNATURE|CREDENTIALS"
)
"""Pattern of service error codes that refuse access."""


def _file_system(scheme: str, environment: Mapping[str, str] = os.environ) -> Any:
    """Return the pyarrow file system of a scheme. Pyarrow is imported when a bucket is read."""
    from pyarrow import fs

    if scheme == "s3":
        endpoint = environment.get("AWS_ENDPOINT_URL_S3") or environment.get("AWS_ENDPOINT_URL")
        url = urlsplit(endpoint) if endpoint else None
        server = {"endpoint_override": url.netloc, "scheme": url.scheme} if url else {}
        region = environment.get("AWS_REGION") or environment.get("AWS_DEFAULT_REGION")
        return fs.S3FileSystem(
            connect_timeout=CONNECT_S,
            request_timeout=ANSWER_S,
            retry_strategy=fs.AwsStandardS3RetryStrategy(max_attempts=ATTEMPTS),
            **({"region": region} if region else {}),
            **server,
        )
    if scheme == "gs":
        host = environment.get("STORAGE_EMULATOR_HOST", "")
        url = urlsplit(host if "://" in host else f"http://{host}") if host else None
        server = {"endpoint_override": url.netloc, "scheme": url.scheme} if url else {}
        return fs.GcsFileSystem(anonymous=url is not None, retry_time_limit=timedelta(seconds=ANSWER_S), **server)
    account, endpoint = environment.get("AZURE_STORAGE_ACCOUNT"), environment.get("AZURE_STORAGE_ENDPOINT")
    if not account:
        raise ConfigError(f"az:// needs the name of the storage account: set {HELP['az']}")
    url = urlsplit(endpoint) if endpoint else None
    server = (
        {
            f"{service}_{part}": value
            for service in ("blob_storage", "dfs_storage")
            for part, value in (("authority", url.netloc), ("scheme", url.scheme))
        }
        if url
        else {}
    )
    return fs.AzureFileSystem(account, account_key=environment.get("AZURE_STORAGE_KEY"), **server)


@contextmanager
def copied(file: RemoteFile) -> Iterator[Path]:
    """Yield an object as a local temporary file under its own name.

    Raises:
        EdpError: see `BucketReader.copy`.
    """
    with TemporaryDirectory(prefix="edp_") as folder:
        check_room(Path(folder), file.size, file.address)
        # A key may hold anything: its last part alone names the file, and a folder of our own holds it.
        # Without leading dots: '..' is a key like any other, and no name of a file.
        target = Path(folder) / (re.sub(r"[^\w.+-]", "_", file.name)[-120:].lstrip(".") or "log")
        BucketReader(file.address).copy(file, target)
        yield target


def cache_folder() -> Path:
    """Return the folder for copies of stores: ``stores`` in EDP_CACHE, or in the user's cache folder."""
    chosen = os.environ.get("EDP_CACHE")
    base = Path(chosen) if chosen else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "edp"
    return make_folder(base / "stores")


def check_room(folder: Path, size: int, address: str) -> None:
    """Refuse a copy that the disk has no room for, before it is begun."""
    free = shutil.disk_usage(folder).free
    if size > free:
        raise StorageError(
            f"'{address}' has {typed(size / 1e9, 3)} GB, the disk of '{folder}' {typed(free / 1e9, 3)} GB left; "
            "free space, or "
            "choose another disk (EDP_CACHE for stores, TMPDIR for logs)"
        )
