"""A cable to a host of its own: what it lets through."""

import socket
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

from benchmarks.chaos.cable import Cable, laid

ECHO = """
import socket
server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
server.bind(("0.0.0.0", 5555))
print("up", flush=True)
while True:
    data, sender = server.recvfrom(100)
    server.sendto(data, sender)
"""


def echo(cable: Cable, patience: float = 60.0) -> float | None:
    """Seconds until an answer, or None if none came."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as client:
        client.settimeout(patience)
        began = time.monotonic()
        client.sendto(b"data", (cable.far, 5555))
        try:
            client.recvfrom(100)
        except TimeoutError:
            return None
        return time.monotonic() - began


@pytest.mark.nightly
def test_packets_are_delayed_and_lost_to_a_host_that_sees_an_empty_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with laid(tmp_path) as cable:
        if cable is None:
            pytest.skip("a cable needs root and /dev/net/tun")
        assert subprocess.run([*cable.enter, "ls", tmp_path], capture_output=True, check=True).stdout == b""
        with subprocess.Popen([*cable.enter, sys.executable, "-c", ECHO], stdout=subprocess.PIPE) as server:
            assert server.stdout is not None
            server.stdout.readline()
            cable.disturb(0.0, 0.1)
            assert (echo(cable) or 0) >= 0.2  # there and back
            cable.disturb(1.0, 0.0)
            assert echo(cable, 0.2) is None
            cable.disturb(0.0, 0.0)
            assert echo(cable) is not None
            server.kill()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
