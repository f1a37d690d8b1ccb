"""Stands in for `panolog run … --supervise`: works in steps, each saved, under the lock of its run folder.

python -S stand_in.py LOG run SCENE --output RUN … | resume RUN …
It imports nothing of PanoLOG, so that it starts at once. The scene "refused" is wrong input, "fragile" kills
its first attempt. A file RUN/wait holds it at its work, and RUN/stop is the request of a user to stop.
It writes its share of the machine to RUN/share.
"""

import fcntl
import json
import os
import signal
import struct
import sys
import time
from pathlib import Path

STEPS = 4
LOCK = struct.pack("hhqqi4x", fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)


def main(log: str, words: list[str]) -> int:
    resumed = words[0] == "resume"
    run = Path(words[1] if resumed else words[words.index("--output") + 1])
    scene = "" if resumed else words[1]

    def note(word: str) -> None:
        handle = os.open(log, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        os.write(handle, f"{word} {run.name} {os.getpid()}\n".encode())
        os.close(handle)

    if scene == "refused":
        print("panolog: refused: there is no such scene; give another one")
        return 2
    run.mkdir(exist_ok=True)
    lock = os.open(run / "lock", os.O_RDWR | os.O_CREAT)
    try:
        fcntl.fcntl(lock, fcntl.F_OFD_SETLK, LOCK)  # type: ignore[attr-defined,unused-ignore]
    except OSError:
        note("locked-out")
        return 2
    (run / "run.json").touch()
    share = {name: os.environ.get(name) for name in ("CUDA_VISIBLE_DEVICES", "PANOLOG_MEMORY")}
    (run / "share").write_text(json.dumps({**share, "cores": sorted(os.sched_getaffinity(0))}))
    stopping: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda number, _: stopping.append(number))
    note("resumes" if resumed else "begins")
    steps = run / "steps"
    done = steps.read_text().splitlines() if steps.exists() else []
    while len(done) < STEPS and not stopping and not (run / "stop").exists():
        if scene == "fragile":
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(0.02)  # its work
        if (run / "wait").exists():
            continue
        done.append(str(len(done) + 1))
        new = run / "steps.new"
        new.write_text("\n".join(done))
        new.replace(steps)
    note("done" if len(done) == STEPS else "stops")
    return 0 if len(done) == STEPS else 130


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], sys.argv[2:]))
