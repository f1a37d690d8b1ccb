"""Workers without Ray: each task in a process of its own on this machine.

Results are the same bytes as with Ray. A worker sends its messages through a pipe, whose end is also the end
of the task; an executor of one process transports the error of a task that fails.
"""

import os
import pickle
import signal
import socket
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import Pipe, get_context
from multiprocessing.connection import Connection, wait
from time import sleep
from traceback import format_exception

import torch

from panolog.orchestrator.resources.gpus import describe_gpus
from panolog.orchestrator.resources.machine import cores, memory, oom_kills
from panolog.orchestrator.resources.nodes import Node, Placement
from panolog.orchestrator.resources.pool import Ended, Failed, Hello, InProcess, Message
from panolog.orchestrator.resources.usage import with_usage
from panolog.orchestrator.run import log
from panolog.orchestrator.run.records import Failure
from panolog.renderer.process import prepare
from panolog.workers import stopping
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import TaskId


@dataclass
class _Task:
    messages: Connection
    executor: ProcessPoolExecutor
    end: Future[None]
    hello: Hello | None = None


class LocalPool(InProcess):
    """The tasks that run now. Made by `local_pool`."""

    def __init__(self) -> None:
        gpus = describe_gpus(torch.cuda.device_count())
        self._node = Node("local", socket.gethostname(), cores(), memory(), gpus)
        self._running: dict[TaskId, _Task] = {}

    def nodes(self) -> tuple[Node, ...]:
        """This machine."""
        return (self._node,)

    def start(self, placement: Placement, spec: TaskSpec) -> None:
        """Runs a spec in a new process."""
        receiver, sender = Pipe(duplex=False)
        executor = ProcessPoolExecutor(1, get_context("spawn"), _initialise, (placement, sender))
        end = executor.submit(_run, spec)
        sender.close()  # the worker has it: if the worker ends, so does the pipe
        self._running[spec.task] = _Task(receiver, executor, end)

    def stop(self, task: TaskId) -> None:
        """Requests a last checkpoint and the end of a task that has said Hello."""
        if (hello := self._running[task].hello) is not None:
            stopping.request(hello.pid)

    def cancel(self, task: TaskId) -> None:
        """Ends a task by force; nothing of it arrives any more."""
        running = self._running.pop(task)
        running.messages.close()
        for process in list(running.executor._processes.values()):
            process.kill()
        running.executor.shutdown(cancel_futures=True)

    def ready(self, seconds: float) -> list[TaskId]:
        """The tasks that have a message; waits at most `seconds` for the first."""
        if not self._running:
            sleep(seconds)
            return []
        ready = wait([task.messages for task in self._running.values()], seconds)
        return [task for task, running in self._running.items() if running.messages in ready]

    def close(self) -> None:
        """Ends what still runs: a worker whose pipe is closed exits with its next message."""
        for task in self._running.values():
            task.messages.close()
        for task in self._running.values():
            task.executor.shutdown(cancel_futures=True)
        self._running.clear()

    def take(self, task: TaskId) -> Message:
        """The next message of a task that is ready."""
        running = self._running[task]
        try:
            message: Message = pickle.loads(running.messages.recv_bytes())
        except (EOFError, OSError):
            message = _end_of(running)
            del self._running[task]
            running.executor.shutdown()
        if isinstance(message, Hello):
            running.hello = message
        return message


@contextmanager
def local_pool() -> Iterator[LocalPool]:
    """A pool for as long as the context lasts."""
    pool = LocalPool()
    try:
        yield pool
    finally:
        pool.close()


def _end_of(task: _Task) -> Ended | Failed:
    """The last message of a task whose pipe has ended."""
    error = task.end.exception()
    if error is None:
        return Ended()
    detail = "".join(format_exception(error))
    if not isinstance(error, BrokenProcessPool):
        return Failed.of(error, detail)
    if task.hello is not None and oom_kills() > task.hello.oom_kills:
        return Failed("out of memory: the system killed the worker", Failure.MEMORY, detail)
    return Failed("the worker process died: killed or crashed", Failure.LOST, detail)


class _Worker:
    """State of a worker process."""

    messages: Connection


def _initialise(placement: Placement, messages: Connection) -> None:
    """In the worker: Ctrl-C is the driver's, and CUDA sees the GPU of the placement alone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ["OMP_NUM_THREADS"] = str(placement.threads)
    if placement.gpu is not None:
        visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
        names = visible.split(",") if visible else [str(index) for index in range(placement.gpu + 1)]
        os.environ["CUDA_VISIBLE_DEVICES"] = placement.uuid or names[placement.gpu]
    log.configure()
    prepare(placement.threads)
    _Worker.messages = messages


def _run(spec: TaskSpec) -> None:
    """In the worker: sends the messages of a spec, and closes the pipe."""
    stopping.listen()
    try:
        _send(Hello(socket.gethostname(), os.getpid(), oom_kills()))
        for event in with_usage(spec.run()):
            _send(event)
    finally:
        with suppress(OSError):
            _Worker.messages.close()


def _send(message: Message) -> None:
    """Plain pickle: tensors as bytes, which outlive this process."""
    try:
        _Worker.messages.send_bytes(pickle.dumps(message))
    except BrokenPipeError:  # the driver has ended
        os._exit(1)
