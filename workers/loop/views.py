"""What a training loop begins with: the first model of a scene, and its panoramas in a random order."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from torch import Tensor

from panolog.renderer.camera import Camera
from panolog.renderer.process import choose_device
from panolog.scene.errors import ConfigError
from panolog.scene.gaussians import Gaussians
from panolog.scene.images import PanoramaCache, View, load_view
from panolog.scene.model import Scene
from panolog.workers.training.config import DepthConfig, SkyConfig, TrainConfig
from panolog.workers.training.initialise import first_model, points_of
from panolog.workers.training.loss import DepthTargets
from panolog.workers.training.schedule import epoch
from panolog.workers.training.surfaces import NO_POINTS

_AHEAD = 4  # views that decode in the background
_MEMORY = 4 << 30  # bytes of decoded panoramas


@dataclass(frozen=True, eq=False)
class TrainingView:
    """A panorama to train on; its tensors are on one device, those of the camera on the CPU."""

    name: str  # of the panorama
    row: int  # of `Scene.panoramas`
    camera: Camera
    image: Tensor  # (H, W, 3) uint8 RGB
    mask: Tensor | None  # (H, W) bool, True where a pixel counts; None: everywhere
    depth: tuple[Tensor, Tensor] | None  # `inverse_depth_loss`'s target and where it is valid, (H, W) each


def initial_gaussians(scene: Scene, *, sky: int = 0, width: int | None = None) -> Gaussians:
    """The model before training: one Gaussian for each sparse point (3DGS), then a sky (eq. 3).

    Args:
        scene: the scene; its training views bound the sizes and colour the sky.
        sky: Gaussians on a distant sphere, which are the last ones.
        width: pixels of the panoramas that colour the sky; those of the scene if None.

    Returns:
        The Gaussians, on the CPU.

    Raises:
        SceneError: a panorama cannot be decoded.

    >>> import panolog
    >>> gaussians = panolog.initial_gaussians(panolog.read_scene(SCENE), sky=100)
    >>> len(gaussians), gaussians.sky, sorted(gaussians.tensors())
    (150, 100, ['means', 'opacities', 'quats', 'scales', 'sh0', 'shN'])
    """
    width = width or scene.width
    config, chosen = TrainConfig(sky=SkyConfig(count=sky)), points_of(scene, scene.train)
    begin = scene, config, chosen, NO_POINTS, scene.train, width * (width // 2)
    return first_model(*begin, lambda row: load_view(scene.panoramas[row], row, width))[0]


def known_rows(scene: Scene, rows: Sequence[int], name: str) -> tuple[int, ...]:
    """Rows of `scene.panoramas` that a caller has given, checked. Args: name, of the argument.

    Raises ConfigError if they are none, or one is of no panorama.
    """
    count, chosen = len(scene.panoramas), tuple(rows)
    if not chosen:
        raise ConfigError(f"{name}: are none; name rows of scene.panoramas, 0 to {count - 1}")
    if wrong := [row for row in chosen if not 0 <= row < count]:
        raise ConfigError(f"{name}: there is no row {wrong[0]} of scene.panoramas, only 0 to {count - 1}")
    return chosen


def load_views(
    scene: Scene,
    width: int,
    iterations: int,
    *,
    rows: Sequence[int] | None = None,
    depth: bool = False,
    seed: int = 0,
    device: str = "cpu",
) -> Iterator[TrainingView]:
    """A view for each iteration: all of them in a random order, then again in another one.

    The next views decode in the background; up to 4 GiB of decoded ones are kept.

    Args:
        scene: the scene.
        width: pixels, even and at most the scene's; the height is half of it.
        iterations: how many views.
        rows: of `scene.panoramas`; those to train on (`scene.train`) if None.
        depth: whether the views have depth, aligned to the sparse points (eq. 4), where the scene has maps.
        seed: of the order.
        device: of the tensors, "cpu" or "cuda".

    Raises:
        ConfigError: the width is not possible, or there are no rows, or not these.
        DeviceError: there is no such device.
        SceneError: a panorama cannot be decoded.

    >>> import panolog
    >>> scene = panolog.read_scene(SCENE)
    >>> for view in panolog.load_views(scene, width=32, iterations=2):
    ...     print(view.image.shape, view.camera.width, view.mask)
    torch.Size([16, 32, 3]) 32 None
    torch.Size([16, 32, 3]) 32 None
    """
    chosen = known_rows(scene, scene.train if rows is None else rows, "rows")
    targets = DepthTargets(scene, DepthConfig(), seed)
    with PanoramaCache(scene, chosen, width, _MEMORY, device=choose_device(device)) as cache:
        for iteration in range(iterations):
            ahead = range(iteration, min(iteration + cache.ahead(_AHEAD), iterations))
            order = [epoch(seed, "coarse", chosen, at // len(chosen))[at % len(chosen)] for at in ahead]
            cache.prefetch(order)
            yield _training_view(scene, cache.get(order[0]), width, targets if depth else None)


def _training_view(scene: Scene, view: View, width: int, targets: DepthTargets | None) -> TrainingView:
    panorama = scene.panoramas[view.row]
    target = None if targets is None else targets.target(view)
    camera = Camera.at(panorama, width)
    return TrainingView(panorama.name, view.row, camera, view.image, view.mask, target)
