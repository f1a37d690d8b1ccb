"""Helpers that share the work: each thread and each process has its own."""

import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from panolog.renderer import _core, ops
from panolog.renderer.process import prepare

COUNT = 5 * 2**15 + 7  # values of Adam: six parts


def adam(threads: int) -> bytes:
    """The bytes after one step."""
    values = np.random.default_rng(0).standard_normal((4, COUNT)).astype(np.float32)
    parameter, gradient, first, second = values
    second **= 2
    arrays = (parameter, gradient, first, second)
    assert not _core.adam(*arrays, COUNT, lr=0.1, beta1=0.9, beta2=0.999, eps=1e-15, step=3, threads=threads)
    return values.tobytes()


def test_threads_that_compute_at_once_have_helpers_of_their_own() -> None:
    alone, found = adam(1), []
    callers = [threading.Thread(target=lambda: found.append(adam(2))) for _ in range(8)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert found == [alone] * 8


def test_a_fork_has_helpers_of_its_own() -> None:
    alone = adam(2)
    child = os.fork()
    if not child:
        os._exit(adam(2) != alone)
    assert os.waitpid(child, 0)[1] == 0


def test_helpers_do_not_hold_up_the_end_of_a_process() -> None:
    script = f"""
import numpy as np
from panolog.renderer import _core
_core.adam(*np.ones((4, {COUNT}), np.float32), {COUNT}, 0.1, 0.9, 0.999, 1e-15, 3, 4)
"""
    subprocess.run([sys.executable, "-c", script], check=True, timeout=300)


def test_a_worker_has_one_thread_of_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[int] = []
    monkeypatch.setattr("torch.set_num_threads", called.append)
    try:
        prepare(3)
        assert (ops.threads(), called) == (3, [1])
    finally:
        ops.use_threads(None)
