"""The process that makes pages and files: one for all requests, whatever they come to."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import psutil
import pytest

from panolog.orchestrator.watch.dashboard.models import model_process
from panolog.orchestrator.watch.dashboard.models.model_process import Maker
from panolog.scene.errors import InputError
from tests.orchestrator.watch.dashboard.models import trial

pytestmark = pytest.mark.system
Make = Callable[[str], Awaitable[float]]


def with_maker(work: Callable[[Make], Awaitable[None]], notes: Path) -> list[int]:
    """Does some work with a process that is ended afterwards. Returns the process of each request noted."""

    async def run() -> None:
        maker = Maker()
        try:
            await work(lambda kind: maker.make(trial.__name__, [kind, str(notes)], "the thing"))
        finally:
            await maker.close()

    asyncio.run(run())
    found = [int(line) for line in notes.read_text().splitlines()]
    assert not any(psutil.pid_exists(pid) for pid in found)
    return found


async def refused(made: Awaitable[float]) -> str:
    with pytest.raises(InputError) as caught:
        await made
    return str(caught.value)


def test_one_process_makes_all_and_another_one_after_it_has_died_or_hung(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is wrong is one line."""

    async def work(make: Make) -> None:
        assert 0 <= await make("print") < 60
        assert await refused(make("refuse")) == "a.ply: is no model"
        assert await refused(make("fail")) == "ValueError: one line"
        assert await refused(make("die")) == "the thing could not be made"
        assert await make("print") < 60
        monkeypatch.setattr(model_process, "_TIMEOUT_S", 1.0)
        assert await refused(make("hang")) == "the thing was not made within 1 seconds"
        monkeypatch.setattr(model_process, "_TIMEOUT_S", 300.0)
        await make("print")

    found = with_maker(work, tmp_path / "notes")
    assert [found.index(pid) for pid in found] == [0, 0, 0, 0, 4, 5]


def test_it_ends_when_nothing_was_wanted_for_a_while(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(model_process, "_IDLE_S", 0.2)

    async def work(make: Make) -> None:
        await make("print")
        first = int((tmp_path / "notes").read_text())
        while psutil.pid_exists(first) and psutil.Process(first).status() != psutil.STATUS_ZOMBIE:
            await asyncio.sleep(0.05)
        await make("print")

    assert len(set(with_maker(work, tmp_path / "notes"))) == 2
