"""A store with the faults that S3 has; URLs; the cache. tests/orchestrator/runs/storage has all providers."""

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from s3fs import S3FileSystem

from panolog.scene.errors import ConfigError, StoreError, StoreLostError
from panolog.scene.stores.cache import BOUND, FOLDER, Cache, Stored
from panolog.scene.stores.store import open_store
from panolog.scene.stores.url import is_url, parse_url
from tests.object_store import Fault, ObjectStore, object_store

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def server() -> Iterator[ObjectStore]:
    with object_store() as found:
        yield found


@pytest.fixture(autouse=True)
def credentials(server: ObjectStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Credentials lead to the server. Our code alone tries again what fails, not the provider's before."""
    server.faults.clear()
    server.down = False
    S3FileSystem.clear_instance_cache()  # those of the last test may lead to another server
    monkeypatch.setattr(S3FileSystem, "retries", 1)
    for name, value in (server.environment | {"AWS_MAX_ATTEMPTS": "1"}).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv(FOLDER, str(tmp_path / "cache"))


WRITING: tuple[Fault, ...] = ("throttled", "reset", "lost answer", "error")
READING: tuple[Fault, ...] = ("truncated", "throttled", "reset", "error")


def test_faults_are_tried_again_and_nothing_is_lost(server: ObjectStore) -> None:
    store = open_store(server.url("faults"))
    content = {f"{number}": os.urandom(50_000 + number) for number in range(4)}
    for (name, data), fault in zip(content.items(), WRITING, strict=True):
        server.faults.append(fault)
        store.write(name, data)
    listed = store.list()
    assert set(listed) == set(content)
    for (name, data), fault in zip(content.items(), READING, strict=True):
        server.faults.append(fault)
        assert store.read_whole(name, listed[name]) == data
    assert not server.faults


def test_a_store_that_stays_down_is_an_error_of_the_run(server: ObjectStore) -> None:
    store = open_store(server.url("down"), 0.5)
    server.down = True
    with pytest.raises(StoreLostError, match="the store fails"):
        store.read("a")


def test_a_server_that_cannot_be_reached_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """An endpoint with a wrong port took minutes, and the message had no address."""
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # nothing listens there
        port = closed.getsockname()[1]
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{port}")
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            monkeypatch.setenv(name, "x")
        with pytest.raises(
            StoreLostError, match=rf"127\.0\.0\.1:{port} cannot be reached; check the address of"
        ):
            open_store("s3://bucket/scene", patience=0.5).list()


@pytest.mark.parametrize(
    "text",
    [
        "s3://user:T0PSECRET@bucket/x",
        "s3://bucket/x?token=T0PSECRET",
        "s3://bucket/x#T0PSECRET",
        "s3://T0PSECRET@bucket/x",
        "az://name:T0PSECRET@account.dfs.core.windows.net/x",
        "https://T0PSECRET/x",
        "s3://bucket/../T0PSECRET",
        "s3://",
        "s3:///x",
        "s3://bucket//T0PSECRET",
    ],
)
def test_a_url_with_a_secret_is_refused_without_repeating_it(text: str) -> None:
    with pytest.raises(StoreError) as found:
        parse_url(text)
    assert "T0PSECRET" not in str(found.value)
    assert "\n" not in str(found.value)


def test_urls_are_told_from_paths() -> None:
    assert str(parse_url("s3://bucket/a/b/")) == "s3://bucket/a/b"
    assert (
        str(parse_url("abfs://box@account.dfs.core.windows.net/x"))
        == "abfs://box@account.dfs.core.windows.net/x"
    )
    assert parse_url("file:///tmp/x").path == "/tmp/x"
    with pytest.raises(StoreError, match="does not begin at /; write file:///FOLDER, with three slashes"):
        parse_url("file://tmp/x")
    assert is_url("s3://bucket/x")
    assert not is_url("runs/s3")


def objects(tmp_path: Path, count: int, size: int) -> list[Stored]:
    store = open_store(f"file://{tmp_path}/store")
    for number in range(count):
        store.write(f"{number}", bytes([number]) * size)
    return [Stored(str(store.url), name, version) for name, version in sorted(store.list().items())]


def test_the_cache_keeps_its_bound_and_removes_what_was_used_least_recently(tmp_path: Path) -> None:
    cache = Cache(tmp_path / "cache" / "objects", 2500)
    found = objects(tmp_path, 4, 1000)
    assert [cache.read(it)[:1] for it in found[:2]] == [b"\0", b"\1"]
    first = kept(cache)[0][0]
    os.utime(first, (1, 1))
    cache.read(found[0])  # used again
    times = dict(kept(cache))
    oldest = min(times, key=lambda path: times[path])
    cache.read(found[2])
    assert oldest not in dict(kept(cache))
    assert sum(path.stat().st_size for path, _ in kept(cache)) <= 2500
    assert [cache.read(it) for it in found] == [bytes([number]) * 1000 for number in range(4)]
    assert sum(path.stat().st_size for path, _ in kept(cache)) <= 2500


def kept(cache: Cache) -> list[tuple[Path, int]]:
    return [(path, path.stat().st_mtime_ns) for path in sorted(cache.folder.iterdir())]


def test_an_object_larger_than_the_cache_is_read_past_it(tmp_path: Path) -> None:
    cache = Cache(tmp_path / "cache" / "objects", 500)
    (stored,) = objects(tmp_path, 1, 1000)
    assert len(cache.read(stored)) == 1000
    assert kept(cache) == []


def test_what_the_cache_has_needs_no_store(tmp_path: Path) -> None:
    cache = Cache(tmp_path / "cache" / "objects", 5000)
    (stored,) = objects(tmp_path, 1, 1000)
    data = cache.read(stored)
    (tmp_path / "store" / "0").unlink()
    assert cache.read(stored) == data


def test_a_wrong_bound_is_one_line() -> None:
    with pytest.raises(ConfigError, match="write GiB"):
        Cache.of({BOUND: "much"})
