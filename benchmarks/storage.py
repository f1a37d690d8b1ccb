"""What a run in an object store costs: requests of a round, and the rate at which files get out.

    python -m benchmarks.storage [--files 64] [--mib 4] [--rounds 5]

It starts moto's server on this machine (S3's protocol) and mirrors a run folder whose files all change before
each round. Rates are those of this machine and of moto, which is slow; the numbers of requests are those of
every store.
"""

import argparse
import os
import tempfile
import time
from collections import Counter
from contextlib import closing
from pathlib import Path

from panolog.orchestrator.run.folder import RunFolder
from panolog.orchestrator.run.records import Noticed, RunBegan
from panolog.orchestrator.run.store import Database
from panolog.orchestrator.storage.lease import take
from panolog.orchestrator.storage.mirror import Mirror
from panolog.scene.files import write_bytes
from panolog.scene.stores.store import open_store
from tests.object_store import object_store


def measure(root: Path, files: int, size: int, rounds: int) -> None:
    """Prints a line for each round. Args: size, bytes of each file."""
    folder = RunFolder(root)
    root.mkdir()
    write_bytes(folder.info, b"{}")
    with object_store() as server, closing(Database(folder.database)) as database:
        os.environ.update(server.environment)
        database.append([RunBegan("here", os.getpid(), False)])
        store = open_store(server.url("run"))
        lease = take(store, root, force=False)
        mirror = Mirror(folder, store, lease, None)
        for number in range(rounds):
            for file in range(files):
                write_bytes(root / f"model{file:03d}.ply", os.urandom(size))
            database.append([Noticed(None, f"round {number}")])
            before, began = Counter(server.requests), time.perf_counter()
            mirror.round()
            seconds = time.perf_counter() - began
            requests = ", ".join(f"{n} {method}" for method, n in sorted((server.requests - before).items()))
            rate = files * size / seconds / 1e6
            print(f"round {number}: {seconds:.1f} s, {rate:,.0f} MB/s; {requests}", flush=True)
        lease.release()


def main() -> None:
    """Runs the program."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--files", type=int, default=64)
    parser.add_argument("--mib", type=float, default=4)
    parser.add_argument("--rounds", type=int, default=5)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        measure(Path(folder) / "run", given.files, int(given.mib * 2**20), given.rounds)


if __name__ == "__main__":
    main()
