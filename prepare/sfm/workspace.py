"""What a reconstruction keeps beside the scene that it makes, so that it goes on where it was stopped."""

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from panolog.prepare.panorama_files import PanoramaFile
from panolog.scene.files import write_bytes

StageProgress = Callable[[str, int, int], None]  # what is being done, how much of it is, of how much

_KEY = "key.json"


def no_progress(what: str, done: int, total: int) -> None:
    """The `StageProgress` of who does not want to know."""


@contextmanager
def silence_colmap() -> Iterator[None]:
    """COLMAP logs to stderr by itself, page after page: only what ends it is wanted."""
    import pycolmap  # noqa: PLC0415

    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, pycolmap.logging.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


@dataclass(frozen=True)
class Workspace:
    """A folder with a COLMAP database of `pictures`, which it calls by numbers.

    Lists of pairs separate names by blanks; numbers have none.
    """

    folder: Path
    pictures: tuple[PanoramaFile, ...]

    @property
    def database(self) -> Path:
        """COLMAP's database: features and matches."""
        return self.folder / "database.db"

    @property
    def words(self) -> Path:
        """The visual words of these pictures."""
        return self.folder / "words.bin"

    @property
    def images(self) -> Path:
        """Links to the pictures, by number."""
        return self.folder / "images"

    @property
    def models(self) -> Path:
        """Where mapping writes."""
        return self.folder / "models"

    @cached_property
    def numbers(self) -> list[str]:
        """What the database calls each picture."""
        return [f"{row:06d}{picture.path.suffix.lower()}" for row, picture in enumerate(self.pictures)]

    def ids(self) -> list[int]:
        """The database's id of each picture; they are in it once `find_features` has begun."""
        import pycolmap  # noqa: PLC0415

        with pycolmap.Database.open(self.database) as database:
            of_name = {image.name: image.image_id for image in database.read_all_images()}
        return [of_name[number] for number in self.numbers]

    def open(self, key: object) -> None:
        """Prepares the folder; what another `key` or other pictures left there is removed.

        Args: key, whatever features and matches depend on, as JSON.
        """
        files = [(picture.name, *file_state(picture.path)) for picture in self.pictures]
        digest = hashlib.sha256(json.dumps([key, files], default=str).encode()).hexdigest()
        note = self.folder / _KEY
        if note.is_file() and json.loads(note.read_text()) == digest:
            return
        for leftover in (self.images, self.models):
            shutil.rmtree(leftover, ignore_errors=True)
        for file in (self.database, self.words):
            file.unlink(missing_ok=True)
        self.images.mkdir(parents=True)
        for number, picture in zip(self.numbers, self.pictures, strict=True):
            (self.images / number).symlink_to(picture.path.resolve())
        write_bytes(note, json.dumps(digest).encode())


def file_state(path: Path) -> tuple[int, int]:
    """What tells one content of a file from another: its size and when it was written, in nanoseconds."""
    stat = path.stat()
    return stat.st_size, stat.st_mtime_ns
