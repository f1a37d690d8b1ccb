"""Reconstructs a scene without Ray, installed or not: each task in a process of its own on this machine.

    python examples/run_without_ray.py SCENE RUN --set iterations=2000 --set width=512

`panolog status RUN`, `panolog stop RUN` and `panolog resume RUN` work on it as on every run.
"""

import argparse
from collections.abc import Sequence
from typing import Any

import panolog


def show(_: panolog.RunState, news: Sequence[Any]) -> None:
    """Prints what happens, except for progress."""
    for stored in news:
        name = type(stored.record).__name__
        if name not in ("Progressed", "PreviewSaved", "CheckpointSaved"):
            print(f"{stored.record.task or 'run'}: {name}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs to the end and prints the metrics."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scene", metavar="SCENE")
    parser.add_argument("run", metavar="RUN")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="a setting of a run")
    options = parser.parse_args(arguments)

    with panolog.local_pool() as pool:
        config = panolog.load_config(sets=options.set)
        state = panolog.run(options.scene, options.run, config, pool=pool, on_change=show)
    print(state.metrics)


if __name__ == "__main__":  # required: worker processes import this file
    main()
