"""A store through S3's protocol, with the faults that S3 has; URLs; the cache."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from panolog.scene.errors import ConfigError, StoreError, StoreLostError
from panolog.scene.stores.cache import BOUND, FOLDER, Cache, Stored
from panolog.scene.stores.store import open_store
from panolog.scene.stores.url import is_url, parse_url
from tests.object_store import ObjectStore, object_store

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def server() -> Iterator[ObjectStore]:
    with object_store() as found:
        yield found


@pytest.fixture(autouse=True)
def credentials(server: ObjectStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    server.faults.clear()
    server.down = False
    for name, value in server.environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv(FOLDER, str(tmp_path / "cache"))


def test_objects_are_stored_listed_read_and_removed(server: ObjectStore, tmp_path: Path) -> None:
    store = open_store(server.url("basic"))
    assert store.list() == {}
    assert store.version("a") is None
    file = tmp_path / "file"
    file.write_bytes(b"0123456789")
    store.put(file, "folder/a")
    store.write("b", b"other")
    found = store.list()
    assert set(found) == {"folder/a", "b"}
    assert found["folder/a"] == store.version("folder/a")
    assert store.list("folder") == {"folder/a": found["folder/a"]}
    assert (store.read("folder/a"), store.read("folder/a", 2, 5)) == (b"0123456789", b"234")
    store.copy("folder/a", "c")
    store.get("c", tmp_path / "copy", store.version("c"))
    assert (tmp_path / "copy").read_bytes() == b"0123456789"
    store.remove("b")
    store.remove("b")
    assert store.read("b") is None


def test_of_two_that_make_an_object_one_is_refused(server: ObjectStore) -> None:
    store = open_store(server.url("exclusive"))
    assert store.write("lease", b"one", new=True)
    assert not store.write("lease", b"two", new=True)
    assert store.read("lease") == b"one"


def test_faults_are_tried_again_and_nothing_is_lost(server: ObjectStore, tmp_path: Path) -> None:
    store = open_store(server.url("faults"))
    content = {f"{number}": os.urandom(50_000 + number) for number in range(4)}
    server.faults += ["throttled", "reset", "lost answer", "error"] * 2
    for name, data in content.items():
        store.write(name, data)
    server.faults += ["truncated", "throttled", "slow", "reset", "error"] * 2
    listed = store.list()
    assert set(listed) == set(content)
    for name, data in content.items():
        assert store.read_whole(name, listed[name]) == data
    assert not server.faults
    assert all(server.injected[kind] for kind in ("throttled", "reset", "lost answer", "error", "truncated"))


def test_a_changed_object_is_noticed(server: ObjectStore) -> None:
    store = open_store(server.url("changes"))
    store.write("a", b"before")
    version = store.version("a")
    assert version is not None
    store.write("a", b"after!")  # of the same size
    with pytest.raises(StoreError, match="has changed in the store"):
        store.read_whole("a", version)
    store.remove("a")
    with pytest.raises(StoreError, match="there is no such object"):
        store.read_whole("a", version)


def test_a_store_that_stays_down_is_an_error_of_the_run(server: ObjectStore) -> None:
    store = open_store(server.url("down"), 0.5)
    server.down = True
    with pytest.raises(StoreLostError, match="the store fails"):
        store.read("a")


def test_a_missing_bucket_and_missing_access_are_the_users(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(StoreError, match="there is no such object"):
        open_store("s3://no-such-bucket/x").write("a", b"")


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
