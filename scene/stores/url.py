"""URLs of object stores, checked: what they hold ends up in run.json, in logs and on pages."""

import re
from dataclasses import dataclass
from pathlib import PurePosixPath

from panolog.scene.errors import StoreError

# The protocols of fsspec that are supported -> the extra that has their package; "" where none is needed.
PROTOCOLS = {"s3": "s3", "gs": "gcs", "gcs": "gcs", "az": "azure", "abfs": "azure", "abfss": "azure"}
PROTOCOLS |= {"file": "", "memory": ""}
_CONTAINERS = ("az", "abfs", "abfss")  # write CONTAINER@ACCOUNT.dfs.core.windows.net
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://(.*)", re.DOTALL)


@dataclass(frozen=True)
class StoreUrl:
    """A place in a store. Made by `parse_url`."""

    protocol: str
    path: str  # bucket and key, without a slash at its end; of file:// with one at its beginning

    def __str__(self) -> str:
        return f"{self.protocol}://{self.path}"

    @property
    def name(self) -> str:
        """The last part of the path."""
        return PurePosixPath(self.path).name

    @property
    def account(self) -> str:
        """The account of CONTAINER@ACCOUNT.dfs.core.windows.net; "" if the URL names none."""
        host = self.path.partition("/")[0] if self.protocol in _CONTAINERS else ""
        return host.partition("@")[2].partition(".")[0]


def is_url(text: str) -> bool:
    """Whether a text is meant as a URL, of whatever protocol, and not as a path."""
    return _URL.fullmatch(text) is not None


def parse_url(text: str) -> StoreUrl:
    """A URL, checked. The message of an error never repeats what may be a secret.

    Raises StoreError if it is none, is of no supported store, has a user, a password, a query or a fragment,
    or its path has empty parts, `.`, `..` or characters that cannot be printed, or is relative (file://).
    """
    found = _URL.fullmatch(text)
    protocol, path = (found[1].lower(), found[2]) if found else ("", "")
    shown = f"{protocol}://…"
    if protocol not in PROTOCOLS:
        raise StoreError(f"{shown}: is no store that PanoLOG knows; write s3://, gs:// or az://")
    if any(mark in path for mark in "?#") or "::" in path:
        raise StoreError(f"{shown}: a query or a fragment may hold a secret; write the URL without it")
    user, at, _ = path.partition("/")[0].rpartition("@")
    if at and (":" in user or protocol not in _CONTAINERS):
        raise StoreError(
            f"{shown}: user and password do not belong into a URL; set them as the provider's tools expect"
            " them (environment, profile or role)"
        )
    if protocol == "file" and not path.startswith("/"):  # it would be another place from each folder
        raise StoreError(f"{shown}: its path does not begin at /; write file:///FOLDER, with three slashes")
    parts = path.rstrip("/").removeprefix("/" if protocol in ("file", "memory") else "").split("/")
    if not path.isprintable() or any(part in ("", ".", "..") for part in parts):
        raise StoreError(
            f"{shown}: a part of its path is empty, . or .., or cannot be printed; write BUCKET/PATH"
        )
    return StoreUrl(protocol, path.rstrip("/"))
