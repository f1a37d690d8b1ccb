"""Hosts of their own on one machine: namespaces of network, mounts and processes, joined by a bridge."""

import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import psutil

_NAMESPACES = ("--mount", "--uts", "--pid", "--net")
# A host's first process: it hides a folder, takes the host's name, says that it is up, and stays.
_INIT = 'test -z "$1" || mount -t tmpfs none "$1" && hostname "$2" && echo up && exec sleep infinity'
_DIES_WITH_US = ("setpriv", "--pdeathsig", "KILL")  # so that a killed test leaves no process behind


class NoHostsError(RuntimeError):
    """This machine does not let us make namespaces; the message says why."""


class Hosts:
    """Hosts on a switch: 10.77.0.1, .2, … in the order of their names. `close` removes them."""

    def __init__(self, hidden: dict[str, Path | None]) -> None:
        """Makes them.

        Args: hidden, the hosts by name, each with a folder of this machine that looks empty there, if any.
        Raises NoHostsError if they cannot be made.
        """
        self._processes: list[subprocess.Popen[str]] = []
        self._pids: dict[str, int] = {}
        try:
            self._need()
            self._boot("switch", None)
            self._ip("switch", "link", "add", "bridge", "type", "bridge")
            self._ip("switch", "link", "set", "bridge", "up")
            for number, (name, folder) in enumerate(hidden.items(), 1):
                self._boot(name, folder)
                self._plug_in(name, f"10.77.0.{number}")
        except NoHostsError:
            self.close()
            raise

    def launch(self, host: str, *command: object, **options: Any) -> subprocess.Popen[str]:
        """Starts a command on a host, with the options of Popen; it ends with the host at the latest."""
        words = [*self._enter(host, *_NAMESPACES), *map(str, command)]
        self._processes.append(subprocess.Popen(words, text=True, **options))
        return self._processes[-1]

    def cable(self, host: str, state: str) -> list[str]:
        """The command that plugs a host's cable into the switch or pulls it: state "up" or "down"."""
        return [*self._enter("switch", "--net"), "ip", "link", "set", host, state]

    def close(self) -> None:
        """Switches all hosts off: the kernel ends all processes on them, then removes their network."""
        for pid in self._pids.values():
            os.kill(pid, 9)
        for process in self._processes:
            process.wait()

    def _enter(self, host: str, *namespaces: str) -> list[str]:
        return [*_DIES_WITH_US, "nsenter", "--target", str(self._pids[host]), *namespaces]

    def _ip(self, host: str, *words: str) -> None:
        command = [*self._enter(host, "--net"), "ip", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise NoHostsError(f"ip {' '.join(words)}: {done.stderr.strip()}")

    def _need(self) -> None:
        missing = [tool for tool in ("ip", "unshare", "nsenter", "setpriv") if shutil.which(tool) is None]
        if missing or os.geteuid():
            raise NoHostsError(
                "only root can make hosts" if os.geteuid() else f"{missing[0]} is not installed"
            )

    def _boot(self, name: str, hidden: Path | None) -> None:
        unshare = ("unshare", *_NAMESPACES, "--mount-proc", "--fork", "--kill-child")
        process = subprocess.Popen(
            [*_DIES_WITH_US, *unshare, "sh", "-c", _INIT, "sh", str(hidden or ""), name],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self._processes.append(process)
        assert process.stdout is not None
        if process.stdout.readline() != "up\n":
            raise NoHostsError(f"unshare: {process.communicate()[1].strip()}")
        (first,) = psutil.Process(process.pid).children()
        self._pids[name] = first.pid

    def _plug_in(self, host: str, address: str) -> None:
        peer = ("type", "veth", "peer", "name", "eth0", "netns", str(self._pids[host]))
        self._ip("switch", "link", "add", host, *peer)
        self._ip("switch", "link", "set", host, "master", "bridge", "up")
        self._ip(host, "address", "add", f"{address}/24", "dev", "eth0")
        for device in ("lo", "eth0"):
            self._ip(host, "link", "set", device, "up")
        self._ip(host, "route", "add", "default", "dev", "eth0")  # Ray takes the host's address from it
