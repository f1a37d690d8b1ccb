"""Files of a finished model to save, made on request: `main` does that in the process of `making`."""

from collections import OrderedDict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

from fastapi.responses import Response

from panolog.orchestrator.runs.folder import open_below
from panolog.orchestrator.watch.dashboard.discovery import RunEntry
from panolog.orchestrator.watch.dashboard.models.model_process import Maker, Turns, reading
from panolog.orchestrator.watch.dashboard.responses import Download, file_name
from panolog.scene.errors import InputError

Kind = Literal["sog", "spz", "ply", "html"]
# By kind: what the name of the file ends with.
ENDINGS: dict[Kind, str] = {"sog": ".sog", "spz": ".spz", "ply": "-upright.ply", "html": ".html"}
_CACHED = 4  # files

_NICE = 10  # than this process: a large model takes minutes, and the run may train on this machine
_Made = tuple[str, Kind, int, int]  # the run, the kind, and which model of it


class Downloads:
    """The files that were made last, in a temporary folder."""

    def __init__(self) -> None:
        self._folder = TemporaryDirectory(prefix="panolog-downloads-")
        self._files: OrderedDict[_Made, Path] = OrderedDict()
        self._number = 0
        self._turns, self._maker = Turns("files"), Maker(_NICE)

    async def make(self, entry: RunEntry, kind: Kind) -> None:
        """Makes a file, unless it is there.

        Raises InputError if there is no model, it cannot be read, or too many requests wait; OSError.
        """
        made = _of(entry, kind)
        if made in self._files:
            return
        async with self._turns.take():
            if made in self._files:
                return
            self._number += 1
            path = Path(self._folder.name) / f"{self._number}{ENDINGS[kind]}"
            await self._maker.make(__name__, [str(entry.root), entry.path, kind, str(path)], "the file")
            self._files[made] = path
            while len(self._files) > _CACHED:
                self._files.popitem(last=False)[1].unlink()  # who is receiving it has it open

    def file(self, entry: RunEntry, kind: Kind) -> Response:
        """A file that was made. Raises InputError if there is none of the present model; OSError."""
        path = self._files.get(_of(entry, kind))
        if path is None:
            raise InputError("this file has not been made, or was removed: request it again")
        handle = open_below(path, path.parent)
        return Download(handle, "application/octet-stream", {}, f"{file_name(entry)}{ENDINGS[kind]}")

    async def close(self) -> None:
        """Removes all files."""
        await self._maker.close()
        self._folder.cleanup()


def _of(entry: RunEntry, kind: Kind) -> _Made:
    try:
        known = entry.folder.point_cloud.stat()
    except FileNotFoundError as error:
        raise InputError(f"{entry.name}: has no model yet") from error
    return entry.id, kind, known.st_mtime_ns, known.st_size


def main(root: str, run: str, kind: str, output: str) -> None:
    """Makes one file, of files that are really below the run alone. Raises InputError if it cannot."""
    from panolog.export.formats import ChosenModel, write_format  # noqa: PLC0415
    from panolog.export.site.write import MOST_IN_ONE  # noqa: PLC0415
    from panolog.orchestrator.watch.views.site import build  # noqa: PLC0415
    from panolog.orchestrator.watch.views.site.viewpoints import read_viewpoints  # noqa: PLC0415

    with reading(RunEntry(Path(root), run)) as (folder, locate):
        if kind == "html":
            build.write_file(build.site_of_run(folder, build.Wanted(most=MOST_IN_ONE), locate), Path(output))
            return
        place = build.place_of(folder, read_viewpoints(folder, None, None, locate), locate)
        one_file = kind != "spz"  # whose sky would be a second one
        model = ChosenModel(locate(folder.point_cloud), place, sky=one_file)
        write_format(kind, model, Path(output))
