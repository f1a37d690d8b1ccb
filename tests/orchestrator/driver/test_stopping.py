import os
import signal

import pytest

from panolog.orchestrator.driver.stopping import Stop, on_signals


def test_the_first_signal_asks_and_the_second_interrupts() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)
    with on_signals() as stop:
        assert not stop.requested
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.requested
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM)) == before


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
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with on_signals() as stop:
            os.kill(os.getpid(), signal.SIGINT)
            assert not stop.requested
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
