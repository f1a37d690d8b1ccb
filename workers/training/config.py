"""The settings of training, each with its unit and the source of its default.

Free of torch: `orchestrator.runs` reads these settings and must not import it. The settings of all parts of
training are therefore here and not next to their code; those of its tasks, which no model depends on, are in
`task_config`.

Iterations are stated for a run of 30,000 and scale with its real length (`schedule.Schedule`), except where a
field has "as they are". "3DGS" is Kerbl et al. 2023; "eq." and "app." are those of the PanoLOG paper.
"""

import math
from typing import Literal

from pydantic import Field, model_validator

from panolog.workers.capture.config import CaptureConfig
from panolog.workers.settings import Group
from panolog.workers.training.task_config import CacheConfig, CheckpointConfig, ImagesConfig, PreviewConfig


class LossConfig(Group):
    """The photometric part of eq. 6."""

    lambda_ssim: float = Field(default=0.2, ge=0, le=1, description="weight of D-SSIM, not L1; eq. 6, 3DGS")
    sphere: bool = Field(
        default=False,
        description="true = pixels count by their area on the sphere, as WS-PSNR measures them, in L1, D-SSIM"
        " and so in the gradients that densify; false = all alike, 3DGS",
    )


class DepthConfig(Group):
    """Depth supervision: alignment (eq. 4), loss (eq. 5) and its weight (app. C)."""

    w0: float = Field(
        default=0.5,
        ge=0,
        description="weight at the first iteration, 0 = no depth loss; app. C",
    )
    wT: float = Field(default=0.01, gt=0, description="weight at the last iteration; app. C")  # noqa: N815
    unit: Literal["world", "baseline"] = Field(
        default="world",
        description="unit of depths in the loss: that of the poses, as in eq. 5, or b̂ (eq. 8)",
    )
    sky: bool = Field(default=False, description="whether the sky is in the Ω of eq. 5, as infinitely far")
    points: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="part of the budget of Gaussians (`densify.growth`) that Stage I begins with: points that"
        " depth images agree on fill the gaps of the sparse cloud; 0 = that cloud alone, 3DGS",
    )
    kind: Literal["inverse", "depth"] = Field(
        default="inverse", description="radial inverse depth or radial depth in depth images; eq. 4: inverse"
    )


class SkyConfig(Group):
    """The sky sphere (eq. 3)."""

    count: int = Field(default=100_000, ge=0, description="sky Gaussians, N_sky, 0 = no sky; app. A")
    pixels: int = Field(
        default=0,
        ge=0,
        description="pixels of a panorama for each sky Gaussian, at least: in small panoramas there are"
        " fewer than `count`, which then cost less and are seen more often; 0 = always `count`, the paper",
    )
    kappa: float = Field(default=10.0, gt=1, description="sky radius in radii of the sparse cloud; eq. 3")
    opacity: float = Field(
        default=0.5,
        gt=0,
        lt=1,
        description="initial opacity; with neighbours one sigma apart the sphere is closed from the start, so"
        " that scene Gaussians need not fill the sky",
    )
    size: float = Field(
        default=1.0, gt=0, description="sigma in distances of neighbours; with 1 the sky can be sharp"
    )
    sharp: bool = Field(
        default=False,
        description="whether Stage I trains scales too, from 0.7 to 1 of those at the start, so that"
        " clouds have edges (`optimizer.unit`), and nothing of what sky masks never show as sky: it would fit"
        " single views through what is not opaque yet; sec. 3.2.1 has colour, rotation and opacity of all",
    )
    views: int = Field(
        default=16, ge=1, description="training panoramas, evenly chosen, whose mean colours the sky"
    )

    def number(self, pixels: int) -> int:
        """The sky Gaussians of a run. Args: pixels of one of its panoramas."""
        return min(self.count, pixels // self.pixels) if self.pixels else self.count

    def sigma(self, number: int) -> float:
        """Sigma of `number` sky Gaussians at the start, in parts of their distance from the centre."""
        return self.size * math.sqrt(4 * math.pi / number)


class DensifyConfig(Group):
    """Clone, split and prune as in 3DGS. The sky takes no part."""

    start: int = Field(default=500, ge=0, description="iteration after which it begins; 3DGS")
    until: int = Field(default=15_000, ge=0, description="iteration before which it ends; 3DGS")
    every: int = Field(default=100, ge=1, description="iterations between two; 3DGS, app. A")
    every_floor: int = Field(
        default=25,
        ge=1,
        description="iterations as they are, least interval; new Gaussians need some Adam steps and the"
        " gradient mean some views before the next decision",
    )
    gradient: float = Field(
        default=2e-4,
        gt=0,
        description="mean screen gradient in units of half the image size that densifies; 3DGS, app. A",
    )
    split_gradient: float = Field(
        default=0.0,
        ge=0,
        description="the same of absolute gradients, sums over pixels without their signs, above which large"
        " Gaussians are split; AbsGS (Ye et al. 2024) has 4e-4; 0 = by `gradient`, 3DGS",
    )
    least_opacity: float = Field(
        default=0.0, ge=0, lt=1, description="opacity below which none are cloned or split; 0 = all may, 3DGS"
    )
    percent_dense: float = Field(
        default=0.01,
        gt=0,
        description="largest scale, in extents, that is cloned, above it is split; 3DGS",
    )
    prune_opacity: float = Field(
        default=0.005, ge=0, lt=1, description="opacity below which they are removed, o_min of eq. 12; 3DGS"
    )
    prune_scale: float = Field(default=0.1, ge=0, description="largest scale, in extents, 0 = any; 3DGS")
    max_gaussians: int = Field(
        default=0,
        ge=0,
        description="cap on scene Gaussians in one task, 0 = none; for machines with little memory: of more"
        " sparse points, Stage I starts with an even part",
    )
    measure: Literal["image", "angle"] = Field(
        default="image",
        description="unit of screen gradients: half images as 3DGS, which grow toward the poles of a"
        " panorama, or half turns on the sphere, equal wherever a Gaussian is seen",
    )
    views: Literal["all", "contribution"] = Field(
        default="all",
        description="the mean of gradients is over all views with the Gaussian in their image, as 3DGS,"
        " nearly every panorama; or weighed by its solid angle in them, without those that see nothing of it",
    )
    long_axis: bool = Field(
        default=False,
        description="divide a Gaussian along its longest axis alone, keeping its mass and its variance; 3DGS"
        " draws the parts at random from it, and shrinks all axes",
    )
    method: Literal["clone-split", "relocate"] = Field(
        default="clone-split",
        description="clone-split: all above `gradient`, as 3DGS; relocate: up to a budget, transparent ones"
        " move to live ones and opacities are not reset, as 3DGS-MCMC; the settings below are for it",
    )
    growth: float = Field(
        default=0.8,
        ge=0,
        description="the budget of a task that starts with n Gaussians and has p pixels of a panorama is"
        " n · (1 + growth · (0.85 + 0.5 ln(p / n))), that of clone-split (workers/growth_law.py);"
        " 0.8 gives a street about as many as clone-split",
    )
    long_runs: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="exponent p: in a Stage I of more than 1,500 iterations `growth` is multiplied by"
        " (iterations / 1,500)^p, of 30,000 at most: what trains longer can teach more of them; 0 = never",
    )
    filled: float = Field(
        default=0.5, gt=0, le=1, description="part of the densifications after which the budget is reached"
    )
    weight: Literal["opacity", "gradient"] = Field(
        default="opacity",
        description="what the Gaussians that are copied are drawn in proportion to; 3DGS-MCMC has opacity",
    )
    opacity_decay: float = Field(
        default=0.001,
        ge=0,
        lt=1,
        description="by how much opacities sink at each densification; Rota Bulò et al. 2024",
    )
    noise: float = Field(
        default=0.5,
        ge=0,
        description="standard deviation of the noise on positions of transparent Gaussians at each"
        " densification, in those of the Gaussian; sinks with the rate of positions",
    )


class ResetConfig(Group):
    """The opacity reset; in Stage II it bounds a block softly (app. D)."""

    every: int = Field(
        default=3_000, ge=1, description="iterations between two, while densifying; 3DGS, app. A"
    )
    every_floor: int = Field(
        default=300,
        ge=1,
        description="iterations as they are, least interval; at the rate of 0.05 an opacity needs about 100"
        " steps from 0.01 back to 0.5, and as long again to settle",
    )
    recovery: int = Field(
        default=0,
        ge=0,
        description="iterations as they are after a reset without densification and pruning; 3DGS has 100"
        " until the next one, shorter runs only `densify.every_floor`",
    )
    quiet: float = Field(
        default=0.3,
        ge=0,
        le=1,
        description="fraction of the run at its end without resets, in which opacities recover",
    )
    opacity: float = Field(
        default=0.01,
        gt=0,
        lt=1,
        description="ceiling that a reset sets, o_reset of sec. 3.2; what is not above it at the end is"
        " removed; 3DGS, app. D",
    )
    unrisen: Literal["removed", "kept"] = Field(
        default="removed", description="what is not above `opacity` at the end; app. D removes it"
    )


class OptimizerConfig(Group):
    """Adam's learning rates per iteration, constant except for positions and, where set, opacities."""

    position: float = Field(default=1.6e-4, ge=0, description="first rate of means, in `unit`; 3DGS, app. A")
    position_final: float = Field(default=1.6e-6, gt=0, description="last rate of means, in `unit`; 3DGS")
    unit: Literal["extent", "distance"] = Field(
        default="extent",
        description="the extent of the task's cameras, as in 3DGS, or a Gaussian's distance from the nearest"
        " of them: then a step is as many pixels in a street as in a city, near as well as far",
    )
    least_pixels: float = Field(
        default=0.0,
        ge=0,
        le=2,
        description="least scale of a scene Gaussian along each axis, in pixels of training at its"
        " distance (`unit`): what is thinner is a needle for who comes closer; 0 = none, 3DGS",
    )
    largest: float = Field(
        default=0.0,
        ge=0,
        description="largest scale of a scene Gaussian along each axis, as a part of its distance (`unit`):"
        " what is larger lies over the whole sky of a panorama and shifts its colours; 0 = none",
    )
    sh0: float = Field(default=2.5e-3, ge=0, description="rate of SH of degree 0; 3DGS, app. A")
    shN: float = Field(  # noqa: N815
        default=1.25e-4, ge=0, description="rate of SH of degrees 1 to 3, a twentieth of sh0; 3DGS"
    )
    opacity: float = Field(default=0.05, ge=0, description="first rate of logit opacities; 3DGS")
    opacity_final: float | None = Field(
        default=None, gt=0, description="last rate of logit opacities; none = as the first one, 3DGS"
    )
    scale: float = Field(default=5e-3, ge=0, description="rate of log scales; 3DGS")
    rotation: float = Field(default=1e-3, ge=0, description="rate of quaternions; 3DGS")
    short_runs: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="exponent p: in a run of fewer than 30,000 iterations the rates of shapes are multiplied"
        " by (30,000 / iterations)^p, those of colours by its root and those of positions by its square, with"
        " 0.5 so that they come as far in all; 0 = as they are, 3DGS",
    )
    average: float = Field(default=0.0, ge=0, lt=1, description="part of a run, its last, that is averaged")


class Stage2Config(Group):
    """How the training of a block differs from Stage I, from whose model it starts."""

    position: float = Field(
        default=1.0,
        ge=0.01,
        le=1,
        description="first rate of means over `optimizer.position`; it decays to the same last one, which is"
        " 0.01 of it by default; 1 = from the top again, the paper",
    )
    rate: float = Field(
        default=1.0,
        gt=0,
        le=1,
        description="factor of all rates but that of means, whose Adam starts without statistics; 1 = those"
        " of Stage I, the paper",
    )
    scale: float = Field(
        default=1.0, gt=0, le=1, description="factor of the rate of scales, besides `rate`; 1 = as the paper"
    )
    exterior: Literal["full", "frozen", "baked"] = Field(
        default="full",
        description="what lies outside of a block's cell, which is not kept: full = it trains and densifies,"
        " the paper; frozen = it stays as Stage I left it; baked = so does what each camera sees of it",
    )
    detail: float = Field(
        default=0.0,
        ge=0,
        le=100,
        description="pixels that its cameras may see as one Gaussian of a frozen or baked exterior; 0 = none",
    )
    growth: float = Field(
        default=1.0,
        ge=0,
        le=10,
        description="factor of `densify.growth`: what a block adds to its cell; 1 = Stage I's",
    )
    opacity_decay: float = Field(
        default=1.0,
        ge=0,
        le=1,
        description="factor of `densify.opacity_decay`: with 0 a block keeps what only other panoramas see",
    )
    compare: int = Field(
        default=0,
        ge=0,
        le=8,
        description="panoramas of a block, and as many of others that see its cell, on which it is at last"
        " compared with Stage I; if it is worse, its cell keeps Stage I; 0 = never, the paper",
    )

    @property
    def reduces(self) -> bool:  # whether tasks get levels of detail of what they do not train
        return self.detail > 0 and self.exterior != "full"


class SHConfig(Group):
    """Spherical harmonics: in Stage I the degree grows, Stage II starts with all of them."""

    degree: int = Field(default=3, ge=0, le=3, description="highest degree used; 3DGS")
    every: int = Field(default=1_000, ge=1, description="iterations until the degree grows by one; 3DGS")
    near: float = Field(
        default=0.0,
        ge=0,
        description="distance, in camera baselines (eq. 8), under which degrees 1 to 3 of a Gaussian learn in"
        " proportion to its distance: what is near is seen from directions far apart, and not between; in"
        " shorter runs by `optimizer.short_runs` less, so that they come as far in all; 0 = all alike, 3DGS",
    )


class TrainConfig(CaptureConfig):
    """All settings that the training of Stage I and Stage II depends on."""

    near: float = Field(
        default=0.05,
        ge=0,
        description="nearest radial distance rendered, in camera baselines (eq. 8); relative, no metres",
    )
    projection: Literal["affine", "exact"] = Field(
        default="affine", description="an affine splat (eq. 2), or along each pixel's ray (csrc/rays.h)"
    )
    initial_opacity: float = Field(default=0.1, gt=0, lt=1, description="of what sparse points become; 3DGS")
    loss: LossConfig = LossConfig()
    depth: DepthConfig = DepthConfig()
    sky: SkyConfig = SkyConfig()
    densify: DensifyConfig = DensifyConfig()
    reset: ResetConfig = ResetConfig()
    optimizer: OptimizerConfig = OptimizerConfig()
    stage2: Stage2Config = Stage2Config()
    sh: SHConfig = SHConfig()
    checkpoint: CheckpointConfig = CheckpointConfig()
    preview: PreviewConfig = PreviewConfig()
    cache: CacheConfig = CacheConfig()
    images: ImagesConfig = ImagesConfig()

    @model_validator(mode="after")
    def _measurable(self) -> "TrainConfig":
        if self.projection == "exact" and self.densify.split_gradient > 0:
            raise ValueError(
                "densify.split_gradient is of affine splats: set it to 0, or projection to affine"
            )
        rates, sky = self.optimizer, self.sky
        needs = {"optimizer.least_pixels": rates.least_pixels, "optimizer.largest": rates.largest}
        for name, value in (needs | {"sky.sharp": sky.sharp}).items():
            if value and rates.unit != "distance":
                raise ValueError(f"{name} needs distances: set it to 0, or optimizer.unit to distance")
        return self
