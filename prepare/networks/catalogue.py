"""What `panolog models` does: lists networks known to fit, and checks a user's file with a trial.

Nothing is downloaded: the table says where a user finds a file, under which licence, and its SHA-256.
"""

import resource
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import yaml

from panolog.prepare.networks.depth_maps import make_depth, plan_depth
from panolog.prepare.networks.manifest import ManifestPart, manifest_path, manifest_task
from panolog.prepare.networks.masks import MaskJob, make_masks
from panolog.prepare.networks.movers import MoverNetwork
from panolog.prepare.networks.network import Network, describe_ends
from panolog.prepare.panorama_files import PanoramaFile, list_panoramas
from panolog.prepare.provenance import read_layer
from panolog.scene.errors import ConfigError, RunError
from panolog.scene.files import sha256, write_bytes
from panolog.scene.read import DEPTHS
from panolog.synthetic.make import make_town

_TOWN = 512  # pixels of the trial's panoramas before they are enlarged
_ALL = 0.99  # of the sphere: more is no mask of people in a street without any
# The network, seconds for a panorama after a first one, and the share as CheckedNetwork has it.
Trial = tuple[Network, float, float]


class Known(ManifestPart):
    """A network of the table catalogue.yaml."""

    name: str  # of its file, without .onnx
    purpose: str
    licence: str
    page: str
    download: str  # which file, and where
    sha256: str | None  # of the file in hexadecimal; None where none is published
    bytes: int | None
    manifest: dict[str, Any] | None  # what belongs into the file next to it

    def lines(self) -> Iterator[str]:
        """The entry as text."""
        size = f" ({self.bytes / 1e6:.0f} MB)" if self.bytes else ""
        yield f"{self.name}: {self.purpose}"
        yield f"    licence   {self.licence}"
        yield f"    page      {self.page}"
        yield f"    download  {self.download}{size}"
        yield f"    SHA-256   {self.sha256 or 'not published'}"


@dataclass(frozen=True)
class CheckedNetwork:
    """A network that can be used, and what a trial on panoramas of a small town cost."""

    file: str
    sha256: str
    known: str | None  # its name in the table
    manifest: str  # its file
    task: str  # mask or depth
    inputs: list[str]
    outputs: list[str]
    device: str
    width: int  # of the panorama, in pixels
    seconds: float  # for one panorama, from its file to that of its layer
    memory: int  # bytes: the most that the process has had
    share: float  # of the sphere that is masked, or of the picture that has a depth

    def lines(self) -> Iterator[str]:
        """The check as text."""
        mask = self.task == "mask"
        listed = f"{self.known} of the list" if self.known else "not in the list of `panolog models`"
        yield f"{self.file}: {listed}, SHA-256 {self.sha256}"
        yield f"inputs: {', '.join(self.inputs)}"
        yield f"outputs: {', '.join(self.outputs)}"
        yield f"used by --{'mask' if mask else 'depth'}-model, as {self.manifest} says"
        did = "of the sphere is masked" if mask else "of the pixels have a depth"
        yield f"trial on a town without people, on {self.device}: {self.share:.1%} {did}"
        yield (
            f"{self.seconds:.2g} s for a panorama of {self.width} pixels,"
            f" {self.memory / 2**30:.1f} GiB of memory at most"
        )


@cache
def known_networks() -> tuple[Known, ...]:
    """The table."""
    content = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text())
    return tuple(Known.model_validate(entry) for entry in content)


def list_lines() -> Iterator[str]:
    """The table as text."""
    for entry in known_networks():
        yield from entry.lines()
        yield ""
    yield "PanoLOG downloads none of them: fetch the file yourself, then `panolog models FILE.onnx` checks it"
    yield "and writes its manifest. None of these was run by us; docs/depth-and-masks.md says how others fit."


def check_network(model: Path, width: int, device: str, say: Callable[[str], None]) -> CheckedNetwork:
    """Checks a network, with a trial on panoramas of `width` pixels.

    A file of the table gets its manifest if there is none next to it, which `say` is called with.

    Raises ConfigError: it cannot be used; DeviceError: the device is not there.
    """
    if not model.is_file():
        raise ConfigError(f"{model}: there is no such model")
    found = sha256(model).hex()
    entry = next((it for it in known_networks() if it.sha256 == found), None)
    path = _manifest(model, entry, say)
    task = manifest_task(path)
    with TemporaryDirectory(prefix="panolog-models-") as folder:
        pictures = _town(Path(folder) / "town", width)
        try:
            network, seconds, share = (_mask if task == "mask" else _depth)(model, device, pictures)
        except RunError as error:
            raise ConfigError(str(error)) from error
    inputs, outputs = network.ends
    return CheckedNetwork(
        file=str(model),
        sha256=found,
        known=None if entry is None else entry.name,
        manifest=str(path),
        task=task,
        inputs=inputs,
        outputs=outputs,
        device=network.device,
        width=width,
        seconds=seconds,
        memory=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        share=share,
    )


def _manifest(model: Path, entry: Known | None, say: Callable[[str], None]) -> Path:
    """The manifest of a model, which is written if the table has it. Raises ConfigError without one."""
    try:
        return manifest_path(model)
    except ConfigError as error:
        if entry is None or entry.manifest is None:
            inputs, outputs = map(", ".join, describe_ends(model))
            raise ConfigError(f"{error}; the model has inputs {inputs}; outputs {outputs}") from error
    path = model.with_suffix(".yaml")
    write_bytes(path, yaml.safe_dump(entry.manifest, sort_keys=False).encode())
    say(f"{path}: written, as the SHA-256 is that of {entry.name}")
    return path


def _town(folder: Path, width: int) -> list[PanoramaFile]:
    """Two panoramas of a town."""
    make_town(folder, panoramas=2, width=_TOWN, points=10)
    pictures = list_panoramas(folder)
    for picture in pictures:
        small = cv2.imread(str(picture.path))
        assert small is not None
        large = cv2.resize(small, (width, width // 2), interpolation=cv2.INTER_LINEAR)
        write_bytes(picture.path, cv2.imencode(".png", large)[1].tobytes())
    return pictures


def _mask(model: Path, device: str, pictures: list[PanoramaFile]) -> Trial:
    movers = MoverNetwork(model, device)
    seconds, shares = _timed(lambda it: make_masks([it], MaskJob(movers=movers))[0].ignored, pictures)
    if min(shares) > _ALL:
        raise ConfigError(
            f"{model}: masks all of a town without people; look at `above`, `ignore` and the input's values"
        )
    return movers.network, seconds, sum(shares) / len(shares)


def _depth(model: Path, device: str, pictures: list[PanoramaFile]) -> Trial:
    for picture in pictures:
        picture.layer(DEPTHS).unlink()
    job = plan_depth(pictures, model, device)

    def estimated(picture: PanoramaFile) -> float:
        make_depth(replace(job, todo=(picture,)))
        return float((read_layer(picture.layer(DEPTHS)) > 0).mean())

    seconds, shares = _timed(estimated, pictures)
    if not any(shares):
        raise ConfigError(f"{model}: finds no depth in a town; look at `kind` and the input's values")
    return job.network, seconds, sum(shares) / len(shares)


def _timed(
    share_of: Callable[[PanoramaFile], float], pictures: list[PanoramaFile]
) -> tuple[float, list[float]]:
    """Seconds for the last panorama, and the share of each."""
    began, shares = 0.0, list[float]()
    for picture in pictures:
        began = time.monotonic()
        shares.append(share_of(picture))
    return time.monotonic() - began, shares


def networks_as_json() -> dict[str, Any]:
    """What `panolog models --json` prints."""
    return {"networks": [entry.model_dump() for entry in known_networks()]}
