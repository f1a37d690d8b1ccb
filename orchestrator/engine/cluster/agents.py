"""An agent on each node that works for the run: it reports what its node knows of its end, and stops tasks.

It is an actor without resources: Ray starts no task on a node that drains. An actor keeps a node from being
idle, so agents end when no task of the run has been on their node for a while, at once if it drains. On the
driver's own machine a thread of the driver does it.
"""

import time
from collections.abc import Mapping, Set
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import ray
from ray.exceptions import RayError

from panolog.orchestrator.engine.cluster.nodes import on_node
from panolog.orchestrator.engine.scheduling.leaving import LeaveNotice
from panolog.orchestrator.engine.scheduling.machine_end import Watch
from panolog.orchestrator.runs.records import Leaving
from panolog.workers import stopping

_UNUSED_S = 5.0  # for which a node has no task of the run before its agent ends
_ANSWER_S = 600.0  # after which an agent without news answers anyway


class Agent:
    """What runs on a node."""

    def __init__(self) -> None:
        self._watch = Watch()

    def next_notice(self, seen: Leaving | None) -> LeaveNotice | None:
        """The node's notice, once its kind is not the one that was seen."""
        return self._watch.wait(seen, _ANSWER_S)

    def stop(self, pid: int) -> None:
        """Requests a worker to save a checkpoint and end."""
        stopping.request(pid)


@dataclass
class _Known:
    actor: Any  # ray.actor.ActorHandle
    answer: Any  # ray.ObjectRef of the next notice
    notice: LeaveNotice | None = None
    noted: float = 0.0  # time.monotonic() of `notice`
    used: float = field(default_factory=time.monotonic)  # when a task of the run was last on its node

    def now(self) -> LeaveNotice | None:
        """The notice in force, with the seconds that are left now."""
        return self.notice and self.notice.after(time.monotonic() - self.noted)


class Agents:
    """The agents of all nodes, for the driver."""

    def __init__(self, home: str) -> None:
        """Args: home, Node.id of the driver's machine."""
        self._home = home
        self._watch = Watch()
        self._known: dict[str, _Known] = {}

    def start(self, id: str) -> None:
        """Makes sure that a node has its agent; returns before that is up."""
        if id == self._home or id in self._known:
            return
        actor = on_node(Agent, id, max_concurrency=4, max_restarts=-1, max_task_retries=-1).remote()
        self._known[id] = _Known(actor, actor.next_notice.remote(None))

    def stop(self, id: str, pid: int) -> None:
        """Requests a worker on a node to save a checkpoint and end.

        An agent that Ray restarts gets it again. Nothing waits for the result: where it never arrives,
        the task stops later or not at all.
        """
        if id == self._home:
            stopping.request(pid)
        elif id in self._known:
            self._known[id].actor.stop.remote(pid)

    def notices(self) -> dict[str, LeaveNotice]:
        """The leave notices that are in force, by Node.id."""
        waiting = {known.answer: known for known in self._known.values()}
        if waiting:
            ready, _ = ray.wait(list(waiting), num_returns=len(waiting), timeout=0)
            for answer in ready:
                _read(waiting[answer])
        found = {id: known.now() for id, known in self._known.items()} | {self._home: self._watch.notice()}
        return {id: notice for id, notice in found.items() if notice is not None}

    def review(self, alive: Set[str], draining: Mapping[str, LeaveNotice], busy: Set[str]) -> None:
        """Ends the agents that are not needed. Args: all by Node.id; busy, nodes with tasks of the run."""
        now = time.monotonic()
        for id, known in list(self._known.items()):
            known.used = now if id in busy else known.used
            over = id in draining or (not known.notice and now - known.used > _UNUSED_S)
            if (over and id not in busy) or id not in alive:
                ray.kill(known.actor)
                del self._known[id]

    def close(self) -> None:
        self._watch.close()
        for known in self._known.values():
            ray.kill(known.actor)
        self._known.clear()


def _read(known: _Known) -> None:
    """Takes an answer. The last notice of an agent that was killed stays in force; Ray restarts the agent."""
    with suppress(RayError):
        known.notice = ray.get(known.answer)
        known.noted = time.monotonic()
    known.answer = known.actor.next_notice.remote(known.notice.kind if known.notice else None)
