"""A host of its own for a node, at the end of a cable that loses and delays packets.

The host is a namespace of networks and mounts; the cable is a process that passes Ethernet frames between two
TAP devices. Linux has the queueing discipline netem for that, but not every kernel has netem. It needs root.
"""

import ctypes
import fcntl
import heapq
import os
import select
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random

_TUNSETIFF, _TAP_WITHOUT_HEADER = 0x400454CA, 0x1002  # linux/if_tun.h: TUNSETIFF, IFF_TAP | IFF_NO_PI
_CLONE_NEWNET, _CLONE_NEWNS = 0x40000000, 0x00020000  # sched.h
_FRAME = 65_536  # bytes, at most
_LIBC = ctypes.CDLL(None, use_errno=True)


class Cable:
    """A host and the cable to it. `near` is our address, `far` that of the host."""

    def __init__(self, process: subprocess.Popen[str], near: str, far: str) -> None:
        self.near, self.far = near, far
        self._process = process

    @property
    def enter(self) -> tuple[str, ...]:
        """The beginning of a command that runs on the host."""
        return "nsenter", f"--target={self._process.pid}", "--net", "--mount"

    def disturb(self, loss: float, delay: float) -> None:
        """From now on the cable loses so many of its packets, and delays the others by so many seconds."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(f"{loss} {delay}\n")
        self._process.stdin.flush()
        self._process.stdout.readline()


@contextmanager
def laid(hidden: Path) -> Iterator[Cable | None]:
    """A cable for as long as the context lasts; None where it cannot be made.

    Args: hidden, a folder that looks empty on the host.
    """
    subnet = f"10.78.{os.getpid() % 256}"
    near, far = f"{subnet}.1", f"{subnet}.2"
    command = [sys.executable, "-m", __name__, near, far, str(hidden.resolve())]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield Cable(process, near, far) if process.stdout.readline() == "laid\n" else None
        process.stdin.close() if process.stdin is not None else None


def _lay(near: str, far: str, hidden: str) -> tuple[int, int]:
    """Both ends of the cable, the far one on a new host, which becomes that of this process."""
    name = f"chaos{os.getpid()}"
    ours = _tap(name, near)
    if _LIBC.unshare(_CLONE_NEWNET | _CLONE_NEWNS):
        raise OSError(ctypes.get_errno(), "unshare")
    _call("mount", "--make-rprivate", "/")
    _call("mount", "-t", "tmpfs", "none", hidden)
    _call("ip", "link", "set", "lo", "up")
    theirs = _tap(name, far)
    _call("ip", "route", "add", "default", "dev", name)  # Ray takes the host's address from it
    return ours, theirs


def _tap(name: str, address: str) -> int:
    tap = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tap, _TUNSETIFF, struct.pack("16sH22x", name.encode(), _TAP_WITHOUT_HEADER))
    _call("ip", "address", "add", f"{address}/24", "dev", name)
    _call("ip", "link", "set", name, "up")
    return tap


def _call(*command: str) -> None:
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def _pass_frames(ends: tuple[int, int]) -> None:
    """Until stdin ends. A line there says which share of the frames is lost, and by how much others wait."""
    loss, delay, random, order = 0.0, 0.0, Random(0), 0
    under_way: list[tuple[float, int, int, bytes]] = []  # when due, order, to which end, frame
    while True:
        timeout = max(0.0, under_way[0][0] - time.monotonic()) if under_way else None
        readable, _, _ = select.select([*ends, sys.stdin], [], [], timeout)
        if sys.stdin in readable:
            line = sys.stdin.readline()
            if not line:
                return
            loss, delay = map(float, line.split())
            print("done", flush=True)
        now = time.monotonic()
        for end in ends:
            if end in readable:
                frame, order = os.read(end, _FRAME), order + 1
                if random.random() >= loss:
                    heapq.heappush(under_way, (now + delay, order, ends[1 - ends.index(end)], frame))
        while under_way and under_way[0][0] <= now:
            *_, to, frame = heapq.heappop(under_way)
            os.write(to, frame)


if __name__ == "__main__":
    try:
        both = _lay(*sys.argv[1:])
    except (OSError, subprocess.CalledProcessError) as error:
        sys.exit(f"no cable: {error}")
    print("laid", flush=True)
    _pass_frames(both)
