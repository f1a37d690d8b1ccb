"""What a network expects and what its outputs mean: the file M.yaml (or M.json) next to M.onnx.

Networks differ, and a wrong guess would not be noticed; so all that matters is written down, and a key that
is missing, misspelt or contradicts another is refused.
"""

import json
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, PositiveFloat, ValidationError, model_validator

from panolog.prepare.networks.square_views import Tiles
from panolog.scene.errors import ConfigError, in_one_line, wrong_value

MAX_BYTES = 65_536  # of a manifest
MAX_DEPTH = 8  # of its nesting
MAX_HEIGHT = 4_096  # rows of the input; each takes hundreds of bytes per column in the network
MAX_TILED = 8_192  # columns of a panorama that views are as fine as; maps of these take 40 bytes per pixel
Three = tuple[float, float, float]
Kind = TypeVar("Kind", bound=BaseModel)


class ManifestPart(BaseModel):
    """A part of the manifest: unknown keys and infinite numbers are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Input(ManifestPart):
    """The image that the network takes: value = (byte / divisor - mean) / std, channel by channel."""

    name: str | None = Field(
        default=None, min_length=1, description="of the network's input; none = it has only one"
    )
    width: int = Field(
        ge=8, le=4 * MAX_HEIGHT, description="columns; 2 * height, with wrap more, with tiles height"
    )
    height: int = Field(ge=4, le=MAX_HEIGHT, description="rows")
    layout: Literal["NCHW", "NHWC"] = Field(description="order of the axes: batch, channel, height, width")
    channels: Literal["RGB", "BGR"] = Field(description="order of the channels")
    divisor: PositiveFloat = Field(description="what bytes are divided by: 255, or 1")
    mean: Three = Field(default=(0, 0, 0), description="subtracted then, in the order of `channels`")
    std: tuple[PositiveFloat, PositiveFloat, PositiveFloat] = Field(
        default=(1, 1, 1), description="divided by at last, in the order of `channels`"
    )
    seam: Literal["turn", "wrap", "tiles", "none"] = Field(
        default="turn",
        description="turn = estimate twice, the second time turned by 180 degrees, and blend, at twice the"
        " cost; wrap = give it more columns, which repeat the other side, and blend those; tiles = give it"
        " square perspective views that cover the sphere; none = the network itself knows that a panorama is"
        " round",
    )
    wrap: int = Field(default=0, ge=0, description="repeated columns on each side, with seam: wrap")
    fov: float | None = Field(
        default=None, ge=40, le=120, description="degrees that each view shows across, with seam: tiles"
    )

    @model_validator(mode="after")
    def _fits(self) -> "Input":
        if (self.seam == "wrap") != (self.wrap > 0):
            raise ValueError("wrap is the number of repeated columns, above 0 with seam: wrap and only there")
        if (self.seam == "tiles") != (self.fov is not None):
            raise ValueError("fov is the angle of a view in degrees, given with seam: tiles and only there")
        if self.fov is not None:
            if self.width != self.height:
                raise ValueError(f"with seam: tiles, width must be height = {self.height}, not {self.width}")
            if (wide := Tiles(self.width, self.fov).width) > MAX_TILED:
                raise ValueError(
                    f"views are as fine as a panorama of {wide} columns, more than {MAX_TILED}; raise the fov"
                )
            return self
        if self.width != 2 * self.height + 2 * self.wrap:
            raise ValueError(
                f"width must be 2 * height + 2 * wrap = {2 * self.height + 2 * self.wrap}, not {self.width}"
            )
        if self.wrap > self.height:
            raise ValueError(f"wrap is at most a half turn, {self.height} columns, not {self.wrap}")
        return self


class Depth(ManifestPart):
    """The output of distance."""

    output: str = Field(min_length=1, description="name of the output")
    kind: Literal["depth", "inverse"] = Field(description="depth, or inverse depth (disparity)")
    distance: Literal["radial", "cube", "cylinder"] = Field(
        description="radial = along the ray; cube = z of the cube's face that the ray meets, the faces facing"
        " the camera's axes; cylinder = z of the upright face that faces the ray, the horizontal distance"
    )
    factor: PositiveFloat | None = Field(
        default=None,
        description="metres per unit of depth, or of what inverse depth is the inverse of; none = depth is"
        " known up to scale, or up to scale and offset",
    )


class Threshold(ManifestPart):
    """An output that is compared with a threshold."""

    output: str = Field(min_length=1, description="name of the output: one channel")
    threshold: float = Field(description="between the two sides, in the output's own unit")


class Sky(Threshold):
    """Where the sky is."""

    above: Literal["sky", "foreground"] = Field(description="what values above the threshold are")


class Confidence(Threshold):
    """The confidence of the network. Pixels on its unsure side become holes."""

    above: Literal["sure", "unsure"] = Field(description="what values above the threshold are")


class Ignore(Threshold):
    """What is to be masked."""

    above: Literal["ignore", "keep"] = Field(description="what values above the threshold are")


class Classes(ManifestPart):
    """A segmentation: scores of each class on the channel axis, the greatest wins; or just the winners."""

    output: str = Field(
        min_length=1, description="name of the output: a channel for each class, or one with the index of it"
    )
    ignore: tuple[Annotated[int, Field(ge=0, lt=65_536)], ...] = Field(
        min_length=1, description="indices of the classes to be masked: people, cars, ..."
    )


class DepthManifest(ManifestPart):
    """A depth estimator."""

    task: Literal["depth"]
    input: Input
    depth: Depth
    sky: Sky | None = None
    confidence: Confidence | None = None

    @model_validator(mode="after")
    def _whole(self) -> "DepthManifest":
        if self.input.seam == "tiles":
            raise ValueError("seam: tiles is for masks; depth is estimated of whole panoramas")
        return self


class MaskManifest(ManifestPart):
    """A network that finds what moves: by classes or by one threshold."""

    task: Literal["mask"]
    input: Input
    classes: Classes | None = None
    ignore: Ignore | None = None

    @model_validator(mode="after")
    def _one(self) -> "MaskManifest":
        if (self.classes is None) == (self.ignore is None):
            raise ValueError("give either classes or ignore")
        return self

    @property
    def head(self) -> Classes | Ignore:
        """The one that is given."""
        found = self.classes or self.ignore
        assert found is not None  # see `_one`
        return found


def manifest_path(model: Path) -> Path:
    """The manifest next to a model: M.yaml, M.yml or M.json.

    Raises ConfigError: there is no such model, or no manifest next to it.
    """
    if not model.is_file():
        raise ConfigError(f"{model}: there is no such model")
    candidates = [model.with_suffix(suffix) for suffix in (".yaml", ".yml", ".json")]
    for path in candidates:
        if path.is_file():
            return path
    raise ConfigError(
        f"{model}: there is no manifest {candidates[0].name} next to it, which says what the model expects "
        "and means; docs/depth-and-masks.md shows one, and `panolog models` writes those that it knows"
    )


def read_manifest(path: Path, kind: type[Kind]) -> Kind:
    """The manifest of a depth estimator or of a network that masks.

    Raises ConfigError: anything is wrong; the message names the field.
    """
    try:
        return kind.model_validate(_read(path))
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"])) or "manifest"
        if first["type"] == "extra_forbidden":
            raise ConfigError(f"{path}: there is no field {field}") from error
        raise ConfigError(f"{path}: {field}: {wrong_value(first)}") from error


def manifest_task(path: Path) -> Literal["mask", "depth"]:
    """What a manifest is for. Raises ConfigError: it cannot be read, or is for nothing that there is."""
    tree = _read(path)
    task = tree.get("task") if isinstance(tree, dict) else None
    if task not in {"mask", "depth"}:
        raise ConfigError(f"{path}: task: must be mask or depth")
    return "mask" if task == "mask" else "depth"


def _read(path: Path) -> Any:
    with path.open("rb") as file:
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise ConfigError(f"{path}: more than {MAX_BYTES} bytes, so it is not a manifest")
    try:
        text = data.decode()
        if path.suffix == ".json":
            return json.loads(text)
        _check_yaml(path, text)
        return yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: cannot be read: {in_one_line(error)}") from error


def _check_yaml(path: Path, text: str) -> None:
    """Refuses aliases, which can unfold to more than any memory holds, and deep nests, which take hours."""
    depth = 0
    for event in yaml.parse(text):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH or isinstance(event, yaml.AliasEvent):
            raise ConfigError(f"{path}: a manifest has neither YAML aliases nor more than {MAX_DEPTH} levels")
