"""The files that a reconstruction keeps next to the scene that it makes, so that it can be resumed."""

import hashlib
import json
import shutil
import signal
import threading
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

from panolog.prepare.panorama_files import PanoramaFile
from panolog.prepare.sfm.sketch import Sketcher
from panolog.scene.errors import SceneError
from panolog.scene.files import atomic_folder, sha256, write_bytes
from panolog.scene.image_files import read_info

_KEY = "key.json"
_WEBP = ".webp"

if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGTERM) is not None:
    # pycolmap's log replaces, below Python, what the process does at SIGTERM: it prints a trace and ends it.
    signal.signal(signal.SIGTERM, signal.getsignal(signal.SIGTERM))


@contextmanager
def silence_colmap() -> Iterator[None]:
    """Limits COLMAP's log on stderr to fatal errors."""
    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, pycolmap.logging.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level


@dataclass(frozen=True)
class Workspace:
    """A folder with a COLMAP database of `panoramas`.

    The panoramas are numbered in it, as COLMAP's lists of pairs separate names by blanks. COLMAP takes the
    size alone from their files; WebP, which it cannot read, is replaced by an empty picture.
    """

    folder: Path
    panoramas: tuple[PanoramaFile, ...]
    name: str = "database.db"
    sketcher: Sketcher | None = None  # shows the poses as they are found
    digest: bytes = b""  # of what `with_pairs` has written: COLMAP changes the file by opening it

    @property
    def database(self) -> Path:
        """COLMAP's database: features and matches."""
        return self.folder / self.name

    @property
    def images(self) -> Path:
        """The panoramas by number: links, or empty pictures of their size."""
        return self.folder / "images"

    @property
    def models(self) -> Path:
        """Where the mapper writes."""
        return self.folder / "models"

    @property
    def _found(self) -> Path:
        """What each step of the search for poses has found."""
        return self.folder / "found"

    @cached_property
    def numbers(self) -> list[str]:
        """The name of each panorama in the database."""
        suffixes = [panorama.path.suffix.lower() for panorama in self.panoramas]
        return [f"{row:06d}{'.png' if it == _WEBP else it}" for row, it in enumerate(suffixes)]

    def ids(self) -> list[int]:
        """The database's id of each panorama, once `find_features` has written them.

        Raises SceneError: COLMAP could not read one of the files.
        """
        with pycolmap.Database.open(self.database) as database:
            of_name = {image.name: image.image_id for image in database.read_all_images()}
        for number, panorama in zip(self.numbers, self.panoramas, strict=True):
            if number not in of_name:
                raise SceneError(f"{panorama.path}: COLMAP cannot read this image; save it as JPEG or PNG")
        return [of_name[number] for number in self.numbers]

    def open(self, key: object) -> None:
        """Prepares the folder and removes the results of another `key` or other panoramas.

        Args: key, all that features and matches depend on, as JSON.
        Raises: SceneError, a panorama in WebP is damaged.
        """
        files = [(panorama.name, *file_state(panorama.path)) for panorama in self.panoramas]
        digest = hashlib.sha256(json.dumps([key, files], default=str).encode()).hexdigest()
        note = self.folder / _KEY
        if note.is_file() and json.loads(note.read_text()) == digest:
            return
        for leftover in (self.images, self.models, self._found):
            shutil.rmtree(leftover, ignore_errors=True)
        self.database.unlink(missing_ok=True)
        self.images.mkdir(parents=True)
        for number, panorama in zip(self.numbers, self.panoramas, strict=True):
            if panorama.path.suffix.lower() == _WEBP:
                info = read_info(panorama.path)
                empty = np.zeros((info.height, info.width), np.uint8)
                write_bytes(self.images / number, bytes(cv2.imencode(".png", empty)[1]))
            else:
                (self.images / number).symlink_to(panorama.path.resolve())
        write_bytes(note, json.dumps(digest).encode())

    def clear_models(self) -> None:
        """Makes the folder where the mapper writes, empty."""
        shutil.rmtree(self.models, ignore_errors=True)
        self.models.mkdir(parents=True)

    def with_pairs(
        self, kept: Mapping[tuple[int, int], NDArray[np.int64]], name: str, given: Collection[int] = ()
    ) -> "Workspace":
        """A workspace whose database has these verified pairs alone.

        Args: kept, matches (M, 2) of the pairs, by the rows of their panoramas; name, of the new database in
            the folder; given, rows of panoramas whose features it has as well: it always has those of the
            pairs.
        """
        part = replace(self, name=name)
        part.database.unlink(missing_ok=True)
        ids = self.ids()
        used = {ids[row] for rows in (*kept, given) for row in rows}
        with pycolmap.Database.open(self.database) as all_, pycolmap.Database.open(part.database) as some:
            for camera in all_.read_all_cameras():
                some.write_camera(camera, True)
            for rig in all_.read_all_rigs():
                some.write_rig(rig, True)
            for frame in all_.read_all_frames():
                some.write_frame(frame, True)
            for image in all_.read_all_images():
                some.write_image(image, True)
                if image.image_id in used:
                    some.write_keypoints(image.image_id, all_.read_keypoints(image.image_id))
            for (one, other), matches in sorted(kept.items()):
                a, b = ids[one], ids[other]
                geometry = all_.read_two_view_geometry(a, b)
                geometry.inlier_matches = matches.astype(np.uint32)
                some.write_two_view_geometry(a, b, geometry)
        return replace(part, digest=sha256(part.database))

    def once(
        self, key: object, files: Iterable[Path], make: Callable[[], Sequence[pycolmap.Reconstruction]]
    ) -> list[pycolmap.Reconstruction]:
        """The reconstructions that `make` gives, kept in the folder: an interrupted job reads them.

        They are read the first time, too, so that what follows is the same with and without interruption.
        Args: key, with `files` and the database all that they depend on, as something whose `repr` says it.
        """
        digest = hashlib.sha256(repr((pycolmap.__version__, self.digest, key)).encode())
        for path in files:
            digest.update(sha256(path))
        kept = self._found / digest.hexdigest()
        if not kept.exists():
            models = make()
            kept.parent.mkdir(exist_ok=True)
            with atomic_folder(kept) as folder:
                for place, model in enumerate(models):
                    (folder / str(place)).mkdir()
                    model.write(folder / str(place))
        return [pycolmap.Reconstruction(kept / str(place)) for place in range(len(list(kept.iterdir())))]


def file_state(path: Path) -> tuple[int, int]:
    """The size of a file and when it was written, in nanoseconds: they change with its content."""
    stat = path.stat()
    return stat.st_size, stat.st_mtime_ns
