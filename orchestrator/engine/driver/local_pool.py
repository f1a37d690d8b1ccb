"""Workers without Ray: each task in a process of its own on this machine. Results are the same bytes.

A worker gets its spec when it has said Hello, and sends its messages through the same socket. Workers are
forked from a server process that has imported torch once and computes nothing.
"""

import os
import pickle
import signal
import socket
import struct
from collections.abc import Iterator, Set
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import Pipe, forkserver, get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from time import sleep
from traceback import format_exception

import torch

from panolog.orchestrator.engine.scheduling.large_messages import announced
from panolog.orchestrator.engine.scheduling.leaving import LeaveNotice
from panolog.orchestrator.engine.scheduling.machine_end import Watch
from panolog.orchestrator.engine.scheduling.pool import (
    NONE,
    Ended,
    Failed,
    Hello,
    InProcess,
    Message,
    guarded,
    on_its_card,
)
from panolog.orchestrator.runs import log
from panolog.orchestrator.runs.machines.gpus import describe_gpus
from panolog.orchestrator.runs.machines.machine import cores, instance_type, memory, oom_kills, share
from panolog.orchestrator.runs.machines.nodes import OWN, Node, Placement
from panolog.orchestrator.runs.machines.usage import with_usage
from panolog.orchestrator.runs.records import Failure
from panolog.renderer.process import prepare
from panolog.workers import stopping
from panolog.workers.specs import TaskSpec
from panolog.workers.tasks import TaskId
from panolog.workers.training import trainer

_STALL_S = 30  # in which more bytes of a message that has begun must arrive
_EXIT_S = 5.0  # in which a process must end after its last message
_FORKSERVER = get_context("forkserver")
_FORKSERVER.set_forkserver_preload([__name__, trainer.__name__])


@dataclass
class _Task:
    messages: Connection
    process: ForkServerProcess
    spec: TaskSpec
    hello: Hello | None = None


class LocalPool(InProcess):
    """The tasks that run now. Made by `local_pool`."""

    def __init__(self) -> None:
        self._node = own_node()
        self._watch = Watch()
        self._running: dict[TaskId, _Task] = {}
        forkserver.ensure_running()  # imports torch while the driver reads the scene

    def nodes(self) -> tuple[Node, ...]:
        return (self._node,)

    def notices(self) -> dict[str, LeaveNotice]:
        notice = self._watch.notice()
        return {self._node.id: notice} if notice else {}

    def start(self, placement: Placement, spec: TaskSpec) -> None:
        ours, theirs = Pipe()
        _limit_waits(ours)
        work = (placement, theirs, dict(os.environ))
        process = _FORKSERVER.Process(target=_work, args=work, daemon=True)
        process.start()
        theirs.close()  # the worker has it: if the worker ends, so does the pipe
        self._running[spec.task] = _Task(ours, process, spec)

    def stop(self, task: TaskId) -> None:
        if (hello := self._running[task].hello) is not None:
            stopping.request(hello.pid)

    def waiting(self, _task: TaskId) -> bool:
        """Every task has its process at once."""
        return False

    def cancel(self, task: TaskId) -> None:
        running = self._running.pop(task)
        running.messages.close()
        running.process.kill()
        running.process.join(_EXIT_S)  # one that the kernel holds for a dead disk stays

    def ready(self, seconds: float, ignored: Set[TaskId] = NONE) -> list[TaskId]:
        others = {task: running.messages for task, running in self._running.items() if task not in ignored}
        if not others:
            sleep(seconds)
            return []
        ready = wait(list(others.values()), seconds)
        return [task for task, messages in others.items() if messages in ready]

    def close(self) -> None:
        self._watch.close()
        for task in list(self._running):
            self.cancel(task)

    def take(self, task: TaskId) -> Message:
        running = self._running[task]
        try:
            message: Message = pickle.loads(running.messages.recv_bytes())
            if isinstance(message, Hello):
                running.hello = message
                running.messages.send_bytes(pickle.dumps(running.spec))
        except BlockingIOError:
            message = Failed(f"the worker stopped within a message for {_STALL_S} s", Failure.LOST)
        except (EOFError, OSError):
            message = _death_of(running)
        if isinstance(message, Ended | Failed):
            running.process.join(_EXIT_S)
            self.cancel(task)
        return message


def own_node() -> Node:
    """The machine of this process. Raises ConfigError if a variable that limits its memory is wrong."""
    gpus = describe_gpus(torch.cuda.device_count())
    return Node(OWN, socket.gethostname(), cores(), memory(), gpus, instance_type(), share=share())


@contextmanager
def local_pool() -> Iterator[LocalPool]:
    """A pool for as long as the context lasts."""
    pool = LocalPool()
    try:
        yield pool
    finally:
        pool.close()


def _limit_waits(pipe: Connection) -> None:
    """Reads and writes raise BlockingIOError when nothing moves for long (socket(7)); it is a socket."""
    seconds = struct.pack("ll", _STALL_S, 0)
    with socket.socket(fileno=os.dup(pipe.fileno())) as same:
        same.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, seconds)
        same.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, seconds)


def _death_of(task: _Task) -> Failed:
    if task.hello is not None and oom_kills() > task.hello.oom_kills:
        return Failed("out of memory: the system killed the worker", Failure.MEMORY)
    return Failed("the worker process died: killed or crashed", Failure.LOST)


def _work(placement: Placement, pipe: Connection, environment: dict[str, str]) -> None:
    """The worker process: receives a spec and sends its messages.

    Args: environment, of the driver now: the server that forks has that of the first task.
    """
    os.environ.clear()
    os.environ.update(environment)
    _initialise(placement)
    stopping.listen()
    _send(pipe, Hello(socket.gethostname(), os.getpid(), oom_kills()))
    with _Ending(pipe):
        spec: TaskSpec = pickle.loads(pipe.recv_bytes())
        for event in announced(with_usage(guarded(spec.task, on_its_card(spec, placement).run()))):
            _send(pipe, event)


@dataclass
class _Ending:
    """A context that sends how it has ended, whatever has been raised in it: the driver judges that."""

    pipe: Connection

    def __enter__(self) -> None:
        pass

    def __exit__(self, _: object, error: BaseException | None, __: object) -> bool:
        end = Ended() if error is None else Failed.of(error, "".join(format_exception(error)))
        _send(self.pipe, end)
        return True


def _initialise(placement: Placement) -> None:
    """Ctrl-C is the driver's, and CUDA sees the GPU of the placement alone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.environ["OMP_NUM_THREADS"] = str(placement.threads)
    if placement.gpu is not None:
        visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
        names = visible.split(",") if visible else [str(index) for index in range(placement.gpu + 1)]
        os.environ["CUDA_VISIBLE_DEVICES"] = placement.uuid or names[placement.gpu]
    log.configure()
    prepare(placement.threads)


def _send(pipe: Connection, message: Message) -> None:
    """Plain pickle: tensors as bytes, which outlive this process."""
    try:
        pipe.send_bytes(pickle.dumps(message))
    except ConnectionError:  # the driver has ended
        os._exit(1)
