"""Helpers that share the work: each thread and each process has its own."""

import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from panolog.renderer import _core, ops
from panolog.renderer.process import prepare

COUNT = 5 * 2**12 + 7  # pixels: six parts


def difference(threads: int) -> bytes:
    """The bytes of a loss and its gradient."""
    rendered, target = np.random.default_rng(0).standard_normal((2, COUNT)).astype(np.float32)
    valid, gradient = (rendered < 1).astype(np.uint8), np.empty(COUNT, np.float32)
    mean = _core.absolute_difference(rendered, target, valid, threads=threads, gradient=gradient)
    return gradient.tobytes() + repr(mean).encode()


def test_threads_that_compute_at_once_have_helpers_of_their_own() -> None:
    alone, found = difference(1), []
    callers = [threading.Thread(target=lambda: found.append(difference(2))) for _ in range(8)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert found == [alone] * 8


def test_a_fork_has_helpers_of_its_own() -> None:
    alone = difference(2)
    child = os.fork()
    if not child:
        os._exit(difference(2) != alone)
    assert os.waitpid(child, 0)[1] == 0


def test_helpers_do_not_hold_up_the_end_of_a_process() -> None:
    script = f"""
import numpy as np
from panolog.renderer import _core
ones = np.ones((3, {COUNT}), np.float32)
_core.absolute_difference(ones[0], ones[1], ones[2].astype(np.uint8), 4, ones[2])
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
