"""Announces that this machine leaves its Ray cluster: for what ends machines without a metadata service.

Ray can only drain the node, which nothing takes back; its command line does so, since the Python interface is
not public. The raylet of a node that drains ends once nothing runs there any more.
"""

import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass

import psutil

from panolog.scene.errors import ClusterError

_DRAIN_S = 20.0  # in which Ray must take the request


@dataclass(frozen=True)
class Raylet:
    """Ray's process of a node."""

    process: psutil.Process
    node: str  # Node.id
    address: str  # of the cluster, HOST:PORT


def leave(seconds: int, node: str = "") -> bool:
    """Drains this machine's node, and waits until its tasks have saved and moved.

    Args: seconds until the machine ends; node, how the Node.id begins where several nodes are on one machine.
    Returns whether Ray has ended here in that time. Raises ClusterError if there is not one node to drain, or
    if Ray does not take the request.
    """
    end = time.monotonic() + seconds
    found = [raylet for raylet in raylets() if raylet.node.startswith(node)]
    if len(found) != 1:
        ids = ", ".join(raylet.node[:8] for raylet in found)
        what = f"{len(found)} nodes of Ray: {ids}; choose one with --node" if found else "no node of Ray"
        raise ClusterError(f"this machine has {what}")
    raylet = found[0]
    command = [sys.executable, "-m", "ray.scripts.scripts", "drain-node", "--address", raylet.address]
    command += ["--node-id", raylet.node, "--reason", "DRAIN_NODE_REASON_PREEMPTION"]
    command += ["--reason-message", "the machine leaves", "--deadline-remaining-seconds", str(seconds)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=_DRAIN_S)
    except subprocess.TimeoutExpired as error:
        raise ClusterError(f"{raylet.address}: Ray does not answer") from error
    if done.returncode:
        why = (done.stderr.strip().splitlines() or ["no reason is known"])[-1]
        raise ClusterError(f"{raylet.address}: Ray does not drain the node: {why}")
    gone, _ = psutil.wait_procs([raylet.process], timeout=max(0.0, end - time.monotonic()))
    return bool(gone)


def raylets() -> list[Raylet]:
    """The raylets of this machine, or of this container."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error):  # it has just ended, or is another user's
            if process.name() == "raylet":
                words = process.cmdline()
                node, address = _value(words, "--node_id="), _value(words, "--gcs-address=")
                found += [Raylet(process, node, address)] if node and address else []
    return found


def _value(words: list[str], option: str) -> str:
    """The value of an option, also where it stands in a longer word; "" if it is not there."""
    texts = (word.partition(option)[2] for word in words if option in word)
    return next((text.split()[0] for text in texts if text.strip()), "")
