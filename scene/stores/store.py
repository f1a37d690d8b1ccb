"""One place in an object store: its objects by names relative to it, with retries.

What a store may fail with for a moment (throttling, 5xx, resets, truncated answers) is tried again with
growing pauses, after the provider's own library has done the same for up to 90 seconds. What needs the user
(no credentials, no access, no bucket) is a StoreError at once.
"""

import asyncio
import errno
import logging
import os
import random
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, TypeVar
from urllib.parse import urlsplit

from panolog.scene.errors import StoreError, StoreLostError, first_line
from panolog.scene.files import write_bytes
from panolog.scene.stores.url import PROTOCOLS, StoreUrl, parse_url

T = TypeVar("T")

PATIENCE_S = 300.0  # for which something is tried
_FIRST_S, _LONGEST_S = 0.5, 30.0  # pauses, each twice as long as the one before, half of it at random
_PACKAGES = {"s3": "s3fs", "gcs": "gcsfs", "azure": "adlfs"}
_LOGGERS = {"gcs": ("gcsfs",), "azure": ("azure", "adlfs")}
# gcsfs requests by gRPC of which kind a bucket is, unless this says false. Objects are alike in all kinds.
_GCS_KINDS = "GCSFS_EXPERIMENTAL_ZB_HNS_SUPPORT"


@dataclass(frozen=True)
class _Errors:
    """Errors of a provider's library, by what they mean; as "module:class", or as the classes."""

    absent: tuple[Any, ...] = ()  # there is no such object or bucket
    final: tuple[Any, ...] = ()  # only the user can cure it
    passing: tuple[Any, ...] = ()  # may be over in a moment, unless the answer refuses access

    def loaded(self) -> "_Errors":
        """The classes, with those that all file systems share."""
        absent, final, passing = (
            tuple(map(resolve_name, names)) for names in (self.absent, self.final, self.passing)
        )
        return _Errors(
            (FileNotFoundError, *absent),
            (PermissionError, *final),
            (OSError, asyncio.TimeoutError, *passing),
        )


_ERRORS = {
    "": _Errors(),
    "s3": _Errors(
        final=("botocore.exceptions:NoCredentialsError",),
        passing=(
            "botocore.exceptions:BotoCoreError",
            "botocore.exceptions:ClientError",
            "botocore.parsers:ResponseParserError",  # of an answer that is half there
            "aiohttp:ClientError",
        ),
    ),
    "gcs": _Errors(
        final=("google.auth.exceptions:DefaultCredentialsError", "builtins:ValueError"),  # "Bad Request"
        passing=(
            "google.auth.exceptions:GoogleAuthError",
            "gcsfs.retry:HttpError",
            "gcsfs.retry:ChecksumError",
            "aiohttp:ClientError",
        ),
    ),
    "azure": _Errors(
        absent=("azure.core.exceptions:ResourceNotFoundError",),
        final=("azure.core.exceptions:ClientAuthenticationError",),
        passing=("azure.core.exceptions:AzureError", "aiohttp:ClientError"),
    ),
}
_TAGS = ("ETag", "etag", "generation", "mtime", "created")
_TIMES = ("LastModified", "last_modified", "mtime", "updated", "created")


@dataclass(frozen=True)
class Version:
    """Identifies a version of an object."""

    size: int  # bytes
    tag: str  # entity tag, or the time of the last change where a store has none
    modified: float  # seconds since the epoch; 0 if the store does not say


class Store:
    """What is below a URL. Its methods may be called by several threads.

    All raise StoreError for what only the user can change, StoreLostError if the store has failed for longer
    than its patience.
    """

    def __init__(self, url: StoreUrl, patience: float = PATIENCE_S) -> None:
        """Opens it, without a request to the store. Args: patience, seconds.

        Raises StoreError without its package or an account of the provider.
        """
        self.url = url
        self._patience = patience
        self._errors, self._files = _opened(url)

    def list(self, prefix: str = "") -> dict[str, Version]:
        """All objects whose names begin with a folder's, "" for all; none if there is no such folder."""
        base = self.url.path
        top = f"{base}/{prefix}".rstrip("/")

        def find() -> dict[str, Version]:
            found = self._files.find(top, detail=True)
            if not isinstance(found, dict):  # adlfs, of a name that is an object
                return {}
            root = self._files._strip_protocol(base).rstrip("/") + "/"
            return {
                name.removeprefix(root): _version(info)
                for name, info in found.items()
                if info.get("type") == "file" and not name.endswith("/") and name.startswith(root)
            }

        return self._try(prefix, find, missing=dict[str, Version]())

    def version(self, name: str) -> Version | None:
        """The version of an object now; None if there is none."""
        return self._try(name, lambda: _version(self._files.info(self._key(name))), missing=None)

    def read(self, name: str, start: int = 0, end: int | None = None) -> bytes | None:
        """The bytes of an object from `start` to before `end`; None if there is none."""

        def cat() -> bytes:
            data: bytes = self._files.cat_file(self._key(name), start=start or None, end=end)
            return data

        return self._try(name, cat, missing=None)

    def read_whole(self, name: str, version: Version) -> bytes:
        """The bytes of a version of an object. Raises StoreError if it is another one by now, or gone."""

        def cat() -> bytes:
            data: bytes = self._files.cat_file(self._key(name))
            self._require(name, version, len(data))
            return data

        return self._try(name, cat)

    def get(self, name: str, path: Path, version: Version | None = None) -> None:
        """Writes an object to a file, not atomically. Raises as `read_whole`; OSError if the disk is full."""

        def fetch() -> None:
            with path.open("r+b" if path.exists() else "wb") as file:
                file.truncate(0)
            self._files.get_file(self._key(name), str(path))
            if version is not None:
                self._require(name, version, path.stat().st_size)

        self._try(name, fetch)

    def put(self, path: Path, name: str) -> None:
        """Stores a file, which must not change meanwhile, as an object."""
        self._try(name, lambda: self._files.put_file(str(path), self._made(name)))

    def write(self, name: str, data: bytes, *, new: bool = False) -> bool:
        """Stores bytes. Args: new, only if there is no such object. Returns whether that was so."""

        def pipe() -> bool:
            if not new and self.url.protocol == "file":  # a reader finds it whole, as in a store
                write_bytes(Path(self._made(name)), data)
                return True
            self._files.pipe_file(self._made(name), data, mode="create" if new else "overwrite")
            return True

        try:
            return self._try(name, pipe)
        except FileExistsError:
            return False

    def copy(self, name: str, other: str) -> None:
        """Stores an object under another name too, within the store."""
        self._try(name, lambda: self._files.cp_file(self._key(name), self._made(other)))
        if PROTOCOLS[self.url.protocol] == "azure":  # it may answer before it has copied
            self._try(other, lambda: self._require_copied(name, other))

    def remove(self, name: str) -> None:
        """Removes an object, if there is one."""
        self._try(name, lambda: self._files.rm_file(self._key(name)), missing=None)

    def _key(self, name: str) -> str:
        return f"{self.url.path}/{name}"

    def _made(self, name: str) -> str:
        """The key of an object to be stored. A file system, unlike a store, needs its folder."""
        if not PROTOCOLS[self.url.protocol]:
            self._files.makedirs(self._key(name).rpartition("/")[0], exist_ok=True)
        return self._key(name)

    def _require(self, name: str, version: Version, size: int) -> None:
        """Checks what has just been read. Raises OSError if it is truncated, StoreError if it has changed.

        The version is requested after the bytes: where it is still the old one, they are its bytes.
        """
        now = _version(self._files.info(self._key(name)))
        if (now.size, now.tag) != (version.size, version.tag):
            raise StoreError(
                f"{self.url}/{name}: has changed in the store since it was listed; put back what it was and"
                " resume"
            )
        if size != version.size:
            raise ConnectionError(f"{size:,} of {version.size:,} bytes have arrived")

    def _require_copied(self, name: str, other: str) -> None:
        """Raises ConnectionError while a copy has not all bytes yet: it is empty until then."""
        wanted, found = (int(self._files.info(self._key(it))["size"] or 0) for it in (name, other))
        if found != wanted:
            raise ConnectionError(f"{found:,} of {wanted:,} bytes are copied")

    def _try(self, name: str, call: Callable[[], T], **missing: Any) -> T:
        """Calls until it succeeds. Args: missing, what is returned if there is no such object."""
        end, pause, where = time.monotonic() + self._patience, _FIRST_S, f"{self.url}/{name}".rstrip("/")
        while True:
            try:
                return call()
            except (FileExistsError, StoreError):
                raise
            except self._errors.absent as error:
                if "missing" in missing:
                    value: T = missing["missing"]
                    return value
                raise StoreError(f"{where}: there is no such object; check the URL") from error
            except self._errors.final as error:
                raise _no_access(where, error) from error
            except self._errors.passing as error:
                if _own_disk(error):
                    raise
                if _refuses(error):
                    raise _no_access(where, error) from error
                if time.monotonic() + pause > end:
                    raise StoreLostError(f"{where}: the store fails ({_reason(error)})") from error
                time.sleep(pause * random.uniform(0.5, 1.0))
                pause = min(2 * pause, _LONGEST_S)


def open_store(url: str | StoreUrl, patience: float = PATIENCE_S) -> Store:
    """The store below a URL. Raises StoreError as `parse_url` and `Store`."""
    return Store(parse_url(url) if isinstance(url, str) else url, patience)


def require_package(url: StoreUrl) -> None:
    """Raises StoreError if the package of a store is not installed; imports nothing."""
    package = _PACKAGES.get(PROTOCOLS[url.protocol])
    if package and find_spec(package) is None:
        raise StoreError(f"{url}: needs the package {package}; install it: pip install {package}")


def _opened(url: StoreUrl) -> tuple[_Errors, Any]:
    """What a store's file system may raise, and the file system.

    Raises StoreError without its package or an account, StoreLostError if the account cannot be looked up.
    """
    require_package(url)
    import fsspec  # noqa: PLC0415  # only runs in stores need it

    extra = PROTOCOLS[url.protocol]
    if extra == "gcs":
        os.environ.setdefault(_GCS_KINDS, "false")
    for log in map(logging.getLogger, _LOGGERS.get(extra, ())):
        if not log.handlers:  # without one, Python would print what `_try` reports
            log.addHandler(logging.NullHandler())
    errors = _ERRORS[extra].loaded()
    try:
        files, _ = fsspec.url_to_fs(str(url), **({"use_listings_cache": False} if extra else {}))
    except (ValueError, *errors.final) as error:
        raise _no_access(str(url), error) from error
    except errors.passing as error:
        raise StoreLostError(f"{url}: the store fails ({_reason(error)})") from error
    account = url.account
    if account and account != files.service_client.account_name:
        raise StoreError(
            f"{url}: the environment's credentials are of the account {files.service_client.account_name};"
            f" set those of {account}"
        )
    return errors, files


def _no_access(where: str, error: Exception) -> StoreError:
    return StoreError(
        f"{where}: no access ({_reason(error)}); set the provider's credentials, by its"
        " environment variables, a profile or the role of the machine"
    )


def _refuses(error: Exception) -> bool:
    """Whether an answer refuses access, by an error that its library has for other things too."""
    return _status(error) in (401, 403) or str(error).startswith("Forbidden")  # gcsfs, as an OSError


def _status(error: BaseException) -> int:
    """The status of an answer by HTTP; 0 if the error is of no answer."""
    found = (str(getattr(error, name, "")) for name in ("status_code", "status", "code"))
    return next((int(text) for text in found if text.isdecimal()), 0)


def _version(info: Mapping[str, Any]) -> Version:
    """From what a file system of fsspec says of an object."""
    tag = next((info[key] for key in _TAGS if info.get(key) is not None), "")
    when = next((info[key] for key in _TIMES if info.get(key) is not None), 0.0)
    if isinstance(when, str):
        when = datetime.fromisoformat(when.replace("Z", "+00:00"))
    modified = when.timestamp() if isinstance(when, datetime) else float(when)
    return Version(int(info["size"] or 0), str(tag).strip('"'), modified)


def _own_disk(error: Exception) -> bool:
    """Whether an error is of this machine's disk: trying again would not help."""
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


def _address(error: BaseException | None) -> str | None:
    """The server that a connection could not be made to, by the errors of botocore and aiohttp."""
    while error is not None:
        url = urlsplit(str(getattr(error, "kwargs", {}).get("endpoint_url", "")))
        host, port = url.hostname or getattr(error, "host", None), url.port or getattr(error, "port", None)
        if host:
            return f"{host}:{port}" if port else str(host)
        error = error.__cause__ or error.__context__
    return None


def _reason(error: BaseException) -> str:
    """An error in few words. Texts of the providers' libraries may quote requests, which are left out."""
    if (address := _address(error)) is not None:
        return f"{address} cannot be reached; check the address of the store (its endpoint) and the network"
    text = first_line(str(error))
    if text and "://" not in text and len(text) <= 120:
        return text
    status = _status(error)
    return f"{type(error).__name__}, status {status}" if status else type(error).__name__
