import os
import signal
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

from panolog.orchestrator.engine.driver import requests
from panolog.orchestrator.engine.driver.requests import Stop, interruptible, on_signals, uninterrupted
from tests.orchestrator.fakes import SetClock

ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    """None but the system's, also where this process began with some that are ignored."""
    before = [(number, signal.signal(number, signal.SIG_DFL)) for number in ENDS]
    yield
    for number, handler in before:
        signal.signal(number, handler)


@pytest.mark.parametrize("number", ENDS)
def test_the_first_signal_requests_and_the_second_interrupts(
    monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    monkeypatch.setattr(requests, "time", clock := SetClock())
    with on_signals() as stop:
        assert not stop.requested
        os.kill(os.getpid(), number)
        assert stop.requested
        clock.now += 0.9  # the supervisor passes on what the job system has sent to all processes
        os.kill(os.getpid(), number)
        clock.now += 0.2
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert [signal.getsignal(number) for number in ENDS] == [signal.SIG_DFL] * 3


def test_a_second_signal_does_not_interrupt_what_clears_up_after_the_first() -> None:
    cleared = False
    with pytest.raises(KeyboardInterrupt), interruptible():
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            os.kill(os.getpid(), signal.SIGINT)
            cleared = True
    assert cleared


class Lost:
    """What is interrupted while it is freed: Python prints the exception, and continues."""

    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_request_counts_whose_interrupt_is_lost() -> None:
    """A run that was requested to stop while it began trained to its end."""
    with interruptible():
        Lost()
        with on_signals() as stop:
            assert stop.requested
    with on_signals() as stop:
        assert not stop.requested


def test_an_import_is_whole_when_its_caller_is_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is imported a second time may crash, as torch does."""
    (tmp_path / "halfway.py").write_text(
        "import os, signal\nos.kill(os.getpid(), signal.SIGTERM)\nwhole = True\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(KeyboardInterrupt), interruptible():
        uninterrupted(import_module, "halfway")
    assert sys.modules.pop("halfway").whole


def test_what_can_be_thrown_away_is_interrupted_at_once() -> None:
    stop = Stop()
    with pytest.raises(KeyboardInterrupt), stop.at_once():
        stop.signal()
    begun = False
    with pytest.raises(KeyboardInterrupt), stop.at_once():
        begun = True
    assert not begun
    other = Stop()
    with other.at_once():
        pass
    other.signal()
    assert other.requested


def test_a_signal_that_is_ignored_stays_so() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with on_signals() as stop:
        os.kill(os.getpid(), signal.SIGINT)
        assert not stop.requested
    assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
