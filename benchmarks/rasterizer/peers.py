"""The rasterizer and gsplat's on the same Gaussians: pixels and (tile, splat) pairs per second.

    python -m benchmarks.rasterizer.peers [--width 2048] [--gaussians 1000000] [--json]
    python -m benchmarks.rasterizer.peers --model RUN/point_cloud.ply --scene SCENE

A panorama, against the six faces of a cube at 96 degrees, as fine in their middle as the panorama at its
equator: what a renderer of pinhole images needs to see as much. gsplat (pip install gsplat) compiles its
kernels with nvcc when it is first used, for some minutes.
"""

import math
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from benchmarks import report
from benchmarks.rasterizer.cases import Case, CaseSpec
from benchmarks.rasterizer.iteration import SH_DEGREE, TrainingStep
from panolog.orchestrator.runs.machines.machine import cores
from panolog.renderer import ops
from panolog.renderer.camera import Camera, Lens, facing, perspective
from panolog.renderer.process import choose_device, prepare
from panolog.renderer.render import to_bytes
from panolog.scene.errors import DeviceError
from panolog.scene.gaussians import Gaussians

FOV = 96.0  # degrees: faces overlap, so that footprints at their edges are whole in one of them
FACES = ((0, 0), (90, 0), (180, 0), (270, 0), (0, 90), (0, -90))  # yaw and pitch in degrees
HEAD = (
    *("rasterizer", "Gaussians", "images", "pixels", "pairs", "forward ms", "and backward ms"),
    *("Mpx/s", "Mpairs/s", "PSNR to ours"),
)
INSTALL = "pip install gsplat (it needs nvcc and ninja)"


@dataclass(frozen=True)
class Row:
    """A rasterizer on a model."""

    rasterizer: str
    gaussians: int
    images: int
    pixels: int  # of all images
    pairs: int  # of a splat and a tile of 16 x 16 pixels that it meets
    forward: float  # milliseconds, without what a backward pass needs
    whole: float  # milliseconds of forward and backward
    psnr: float | None = None  # dB: its images against ours, resampled

    def cells(self) -> tuple[object, ...]:
        """The row, in the order of HEAD; rates are those of the forward pass."""
        rates = self.pixels / self.forward / 1e3, self.pairs / self.forward / 1e3
        return (*list(asdict(self).values())[:-1], *rates, self.psnr)


def ours(case: Case, repeats: int) -> tuple[Row, Tensor]:
    """The panorama of a case, and its row."""
    step = TrainingStep(case, case.views[0])
    camera, model = case.views[0].camera, case.gaussians
    with torch.no_grad():
        color = step.forward()[1].color
        forward = step.milliseconds(step.forward, repeats)
    whole = step.milliseconds(step.rasterize, repeats)
    screen = model.means.new_zeros(len(model), 2)
    *_, starts = ops.rasterize(
        **model.tensors(),
        screen=screen,
        **vars(camera),
        sh_degree=SH_DEGREE,
        near=case.near,
        exact=model.exact,
        exterior=[],
    )
    pixels = camera.width * camera.height
    return Row("PanoLOG", len(model), 1, pixels, int(starts[-1]), forward, whole), color


def theirs(case: Case, repeats: int, panorama: Tensor) -> Row:
    """gsplat's row. Args: panorama, of `ours`. Raises DeviceError if gsplat cannot be used."""
    rasterization = load_gsplat()
    lens = face(case.views[0].camera.width)
    step = TrainingStep(case, case.views[0])  # for its clock
    given = arguments(case.gaussians, case.views[0].camera, lens)

    def forward() -> tuple[Tensor, dict[str, Any]]:
        colors, _, meta = rasterization(**given)
        return colors, meta

    def whole() -> None:
        colors, _ = forward()
        colors.backward(torch.ones_like(colors))  # type: ignore[no-untyped-call]

    with torch.no_grad():
        colors, meta = forward()
        took = step.milliseconds(forward, repeats)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        given[name].requires_grad_()
    both = step.milliseconds(whole, repeats)
    seen = np.concatenate([perspective(to_bytes(panorama), lens, facing(*turn)) for turn in FACES])
    likeness = cv2.PSNR(to_bytes(colors).reshape(seen.shape), seen)
    pixels = len(FACES) * lens.width * lens.height
    pairs = len(meta["flatten_ids"])
    return Row("gsplat", len(case.gaussians), len(FACES), pixels, pairs, took, both, likeness)


def load_gsplat() -> Callable[..., Any]:
    """gsplat's `rasterization`, its kernels compiled. Raises DeviceError if they cannot be used."""
    if not torch.cuda.is_available():
        raise DeviceError("gsplat needs a card: there is none that torch can use")
    major, minor = torch.cuda.get_device_capability()
    os.environ.setdefault("TORCH_CUDA_ARCH_LIST", f"{major}.{minor}")  # compiled for the present card alone
    os.environ.setdefault("MAX_JOBS", str(cores()))
    try:
        from gsplat import rasterization  # noqa: PLC0415  # optional
        from gsplat.cuda import _backend  # noqa: PLC0415  # compiles the kernels unless that is done
    except (ImportError, OSError, RuntimeError) as error:
        raise DeviceError(f"gsplat cannot be used ({str(error).splitlines()[0]}): {INSTALL}") from error
    if _backend._C is None:
        raise DeviceError(f"gsplat has no kernels, because there is no nvcc: {INSTALL}")
    made: Callable[..., Any] = rasterization
    return made


def face(width: int) -> Lens:
    """A face as fine in its middle as a panorama of this width is at its equator, in pixels per radian."""
    pixels = width / math.pi * math.tan(math.radians(FOV) / 2)
    return Lens(round(pixels), round(pixels), FOV)


def arguments(model: Gaussians, camera: Camera, lens: Lens) -> dict[str, Any]:
    """What gsplat's `rasterization` takes to render the faces around a camera, all in one call."""
    pose = torch.eye(4, dtype=torch.float64).repeat(len(FACES), 1, 1)
    for view, turn in zip(pose, FACES, strict=True):
        into = torch.from_numpy(facing(*turn)).T  # from the panorama's axes to those of the face
        view[:3, :3] = into @ camera.rotation.cpu().double()
        view[:3, 3] = into @ camera.translation.cpu().double()
    middle = torch.tensor([[lens.focal, 0, lens.width / 2], [0, lens.focal, lens.height / 2], [0, 0, 1]])
    device = model.means.device
    return {
        "means": model.means.detach(),
        "quats": model.quats.detach(),
        "scales": model.scales.detach().exp(),
        "opacities": model.opacities.detach().sigmoid(),
        "colors": torch.cat([model.sh0, model.shN], 1).detach(),
        "viewmats": pose.float().to(device),
        "Ks": middle.repeat(len(FACES), 1, 1).to(device),
        "width": lens.width,
        "height": lens.height,
        "sh_degree": SH_DEGREE,
        "packed": False,  # faster where most Gaussians are seen by some face
    }


def table(rows: Sequence[Row]) -> str:
    """In Markdown."""
    return report.markdown(HEAD, [row.cells() for row in rows])


def main() -> int:
    """The program; returns its exit code."""
    parser = report.parser("rasterizer.peers", __doc__)
    parser.add_argument("--width", type=int, default=2048, help="of the panorama, in pixels")
    parser.add_argument("--gaussians", type=int, default=1_000_000, help="of a random street")
    parser.add_argument("--model", metavar="PLY", help="a trained model; needs --scene")
    parser.add_argument("--scene", help="the scene that the model was trained on")
    parser.add_argument("--repeats", type=int, default=10)
    options = parser.parse_args()
    options.device = "cuda"
    if options.quick:
        options.width, options.gaussians, options.repeats = 256, 5_000, 1

    def work() -> report.Report:
        choose_device(options.device)
        prepare(cores())
        spec = CaseSpec(options.width, options.gaussians, options.model, options.scene, views=1)
        case = spec.make().to(options.device)
        our_row, panorama = ours(case, options.repeats)
        rows = [our_row, theirs(case, options.repeats, panorama)]
        return report.Report({"rows": [asdict(row) for row in rows]}, table(rows))

    return report.run("rasterizer.peers", options, work)


if __name__ == "__main__":
    sys.exit(main())
