"""`panolog clean`: removes what of runs is superseded, under the lock of each, and says so in its history."""

import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from panolog.orchestrator.runs import lock
from panolog.orchestrator.runs.database import Database
from panolog.orchestrator.runs.folder import RunFolder, removed_models, write_json
from panolog.orchestrator.runs.records import Noticed
from panolog.orchestrator.runs.retention.survey import Kind, Removal, Survey, Wanted, survey
from panolog.orchestrator.runs.units import DURATION, gib, seconds_of
from panolog.scene.errors import ConfigError, PanologError, RunLockedError, in_one_line


@dataclass(frozen=True)
class Cleaned:
    """What was removed of some runs, or would be."""

    runs: tuple[Survey, ...]
    dry: bool

    @property
    def failed(self) -> bool:
        """Whether some run could not be read or written."""
        return any(run.failed for run in self.runs)

    def as_json(self) -> dict[str, Any]:
        return {
            "dry_run": self.dry,
            "bytes": self._total,
            "runs": [
                {
                    "run": str(run.root),
                    "bytes": sum(run.sizes.values()),
                    "files": len(run.removals),
                    "kinds": {str(kind): size for kind, size in run.sizes.items()},
                    "skipped": run.skipped or None,
                }
                for run in self.runs
            ],
        }

    def lines(self) -> Iterator[str]:
        for run in self.runs:
            kinds = ", ".join(f"{kind} {gib(size)}" for kind, size in run.sizes.items())
            yield f"{run.root}: " + (
                f"left as it is: {run.skipped}" if run.skipped else kinds or "nothing to remove"
            )
        if any(run.removals for run in self.runs):
            yield f"{'would remove' if self.dry else 'removed'} {gib(self._total)} ({self._total:,} bytes)"

    @property
    def _total(self) -> int:
        return sum(size for run in self.runs for size in run.sizes.values())


def age(text: str) -> float:
    """Seconds of an age such as 12h, 30d or 8w. Raises ConfigError for anything else."""
    found = seconds_of(text)
    if found is None:
        raise ConfigError(f"--older-than {text}: write {DURATION}")
    return found


def clean(roots: Sequence[Path], wanted: Wanted, *, dry: bool) -> Cleaned:
    """Removes what is wanted of each of these runs; one that cannot be read or written is left as it is.

    Args: dry, only say what would be removed; writes nothing.
    """
    return Cleaned(tuple(_of_run(root, wanted, dry=dry) for root in roots), dry)


def _of_run(root: Path, wanted: Wanted, *, dry: bool) -> Survey:
    try:
        found = survey(root, wanted, time.time())
        if dry or found.skipped or not found.removals:
            return found
        with lock.hold(RunFolder(root).lock):
            found = survey(root, wanted, time.time(), ours=True)  # it may have gone on before
            if notice := remove_all(RunFolder(root), found.removals):
                with closing(Database(RunFolder(root).database)) as database:
                    database.append([notice])
        return found
    except RunLockedError:
        return Survey(root, skipped="a driver is at work on it")
    except (PanologError, OSError) as error:
        return Survey(root, skipped=in_one_line(error), failed=True)


def remove_all(folder: RunFolder, removals: Sequence[Removal]) -> Noticed | None:
    """Removes what was found of a run, whose lock the caller has. Returns what its history should say.

    Models are named in RUN/retention.json before they are removed, so that a reader of a model that is
    missing knows why. Raises OSError if that is impossible.
    """
    models = [it for it in removals if it.kind == Kind.MODELS]
    if models:
        names = {str(it.task) for it in models}
        write_json(folder.retention, {"removed_models": sorted(names | removed_models(folder))})
    for removal in removals:
        assert isinstance(removal.path, Path)  # `stores` removes what is in a store
        if removal.path.is_dir() and not removal.path.is_symlink():
            shutil.rmtree(removal.path)
        else:
            removal.path.unlink(missing_ok=True)
    if not models:
        return None
    size = gib(sum(it.size for it in models))
    return Noticed(
        None, f"the models of the parts were removed, {size}: the merged model has their Gaussians"
    )
