"""The plan of G²PS: which cell each block covers, which cameras train it, and why."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, field_validator

from panolog.partition import plan_json
from panolog.partition.assignment import Assignment, assign
from panolog.partition.bounds import Aabb, aabb, baseline
from panolog.partition.cells import Cell, Cells, Cut, Cuts, Grid, Layout
from panolog.partition.contraction import contract
from panolog.scene.errors import InputError


class PartitionConfig(BaseModel):
    """How G²PS bounds the scene and assigns cameras to blocks."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    rho_tri: float = Field(
        default=5.0,
        ge=0.0,
        description="Triangulation range factor: the AABB reaches this many median camera distances past the "
        "trajectory (eq. 7; the paper's value for all scenes).",
    )
    aspect: float = Field(
        default=0.0,
        ge=0.0,
        le=1.0,
        description="How long each axis of the AABB is at least, over the longest one: 0.5 keeps the storeys "
        "of a house along a level walk in one block; 0 = eq. 9 as it is.",
    )
    tau_grad: float = Field(
        default=0.8,
        ge=0.0,
        le=1.0,
        description="A camera also trains every block whose gradient score is more than this share of its "
        "best block's (eq. 11; the paper's value). 1 assigns by position only.",
    )
    cells: Layout = Field(
        default="cube",
        description="What the cells along an axis are equal parts of: cube = contracted space, as in the "
        "paper, whose outer cells hold no camera from four on; box = the AABB, its outer cells without end. "
        "Of grids only; a number of blocks, such as --blocks 8, is balanced.",
    )
    cuts: tuple[Cut, ...] = Field(
        default=(),
        description="Where balanced blocks meet: axis, contracted coordinate and number of blocks below, "
        "each followed by the cuts below and then by those above. Chosen at the start of a run.",
    )
    min_cameras: int = Field(
        default=3,
        ge=1,
        description="Cameras a block needs to be trained; with fewer it keeps its Stage I Gaussians. Two "
        "place a surface and only a third can contradict them: with fewer, training overfits.",
    )
    min_share: float = Field(
        default=0.01,
        ge=0.0,
        le=1.0,
        description="Gaussians a block needs to be trained, as a share of the mean of all blocks; with no "
        "more it keeps those of Stage I: a cell at the rim with a few dozen would take as long as any other.",
    )

    def box(self, centers: ArrayLike) -> Aabb:
        """The AABB (eq. 9) of training cameras at centers (K, 3), world units. Raises as `aabb`."""
        return aabb(centers, self.rho_tri, self.aspect)

    @field_validator("cuts")
    @classmethod
    def _separate(cls, cuts: tuple[Cut, ...]) -> tuple[Cut, ...]:
        return Cuts(cuts).cuts


@dataclass(frozen=True, eq=False)
class Plan:
    """The decisions of G²PS for K training cameras and B blocks. Their scores have a file of their own."""

    config: PartitionConfig
    grid: Cells
    baseline: float  # b̂ of eq. 8, world units
    aabb: Aabb
    rows: tuple[int, ...]  # K rows of Scene.panoramas
    names: tuple[str, ...]  # K names of panoramas
    centers: NDArray[np.float64]  # (K, 3) world units
    assignment: Assignment  # which cameras train which blocks, and why (eq. 11)
    gaussians: NDArray[np.int64]  # (B,) scene Gaussians of Stage I in each block

    def __post_init__(self) -> None:
        count, blocks = len(self.rows), self.grid.count
        if len(self.names) != count or self.centers.shape != (count, 3):
            raise ValueError(f"{count} rows need as many names and centres")
        shape = self.assignment.gradient.shape
        if shape != (count, blocks) or self.gaussians.shape != (blocks,):
            raise ValueError(f"{count} cameras and {blocks} blocks do not fit scores of shape {shape}")

    @property
    def camera_blocks(self) -> NDArray[np.int64]:
        """(K,) the block that each camera is in."""
        return self.assignment.camera_blocks

    @cached_property
    def trained(self) -> NDArray[np.bool_]:
        """(B,) which blocks are trained: those with enough cameras and Gaussians; others keep Stage I's."""
        enough: NDArray[np.bool_] = self.assignment.counts >= self.config.min_cameras
        enough &= self.gaussians > self.config.min_share * self.gaussians.mean()
        return enough

    @cached_property
    def tree(self) -> "scipy.spatial.cKDTree":
        """The camera centers as a tree, which finds those that are near a place."""
        return scipy.spatial.cKDTree(self.centers)

    def cameras(self, block: int) -> tuple[int, ...]:
        """The rows of Scene.panoramas that train a block, in the order of `rows`."""
        return tuple(self.rows[k] for k in self.assignment.cameras_of(block))

    def compared(self, block: int, scores: NDArray[np.float64], count: int) -> tuple[int, ...]:
        """The rows of cameras on which a block can be compared with Stage I, those with high scores first.

        Of those that train it and of others that see it equally many, at most `count` of each.

        Args: scores (K,) of eq. 10 for this block.
        """
        training = self.assignment.cameras_of(block)
        others = np.setdiff1d(np.flatnonzero(scores), training)
        most = min(count, len(training), len(others))
        best = (part[np.argsort(-scores[part], kind="stable")][:most] for part in (training, others))
        return tuple(self.rows[k] for part in best for k in part)

    def cell(self, block: int) -> Cell:
        """The part of space that belongs to a block. Raises ValueError if there is no such block."""
        return Cell(self.aabb, self.grid, block)

    def to_json(self) -> dict[str, Any]:
        """The content of plan.json: plain values, readable without this program (`plan_json.PlanFile`)."""
        return plan_json.PlanFile(
            **self.config.model_dump(exclude={"cells", "cuts"}),
            grid=self.grid.shape if isinstance(self.grid, Grid) else None,
            cells=self.grid.layout if isinstance(self.grid, Grid) else self.config.cells,
            cuts=self.grid.cuts if isinstance(self.grid, Cuts) else (),
            baseline=self.baseline,
            aabb=plan_json.Box(lower=self.aabb.lower.tolist(), upper=self.aabb.upper.tolist()),
            blocks=[self._block_json(block) for block in range(self.grid.count)],
            cameras=[self.camera_json(k) for k in range(len(self.rows))],
        ).model_dump(mode="json")

    def _block_json(self, block: int) -> plan_json.Block:
        lower, upper = self.grid.bounds(block)
        return plan_json.Block(
            block=block,
            contracted=plan_json.Box(lower=lower.tolist(), upper=upper.tolist()),
            gaussians=int(self.gaussians[block]),
            cameras=list(self.cameras(block)),
        )

    def camera_json(self, k: int) -> plan_json.PlanCamera:
        """The entry of the k-th camera in plan.json."""
        return plan_json.PlanCamera(
            row=self.rows[k],
            name=self.names[k],
            center=self.centers[k].tolist(),
            block=int(self.camera_blocks[k]),
            assigned=self.reasons(k),
        )

    def reasons(self, k: int) -> dict[int, plan_json.Reason]:
        """Why the k-th camera trains which blocks."""
        own, gradient = int(self.camera_blocks[k]), set(self.assignment.by_gradient(k).tolist())
        blocks: list[int] = self.assignment.blocks_of(k).tolist()
        return {b: plan_json.reason(geometric=b == own, gradient=b in gradient) for b in blocks}

    @staticmethod
    def from_json(data: object) -> "Plan":
        """The plan that `to_json` described. Derived values in the file must agree with the rest.

        Raises InputError if a value is missing, unknown, of the wrong kind, or contradicts another.
        """
        file = plan_json.parse(data)
        with plan_json.contradictions():
            plan = Plan._of_file(file)
            again = plan.to_json()
        for key, value in file.model_dump(mode="json", exclude={"version"}).items():
            if value != again[key]:
                raise InputError(f"plan.json contradicts itself in {key!r}; make the plan again")
        return plan

    @staticmethod
    def _of_file(file: plan_json.PlanFile) -> "Plan":
        grid = Grid(file.grid, file.cells) if file.grid else Cuts(file.cuts)
        box = Aabb(np.array(file.aabb.lower), np.array(file.aabb.upper))
        centers = np.array([camera.center for camera in file.cameras], np.float64).reshape(-1, 3)
        pairs = [
            (k, block)
            for k, camera in enumerate(file.cameras)
            for block, why in camera.assigned.items()
            if why != "geometry"
        ]
        places = np.array(pairs, np.int64).reshape(-1, 2).T
        gradient = scipy.sparse.csr_array(
            (np.ones(len(pairs), np.bool_), tuple(places)), shape=(len(centers), grid.count)
        )
        return Plan(
            config=PartitionConfig(**{name: getattr(file, name) for name in PartitionConfig.model_fields}),
            grid=grid,
            baseline=file.baseline,
            aabb=box,
            rows=tuple(camera.row for camera in file.cameras),
            names=tuple(camera.name for camera in file.cameras),
            centers=centers,
            assignment=Assignment(grid.block_of(contract(centers, box)), gradient),
            gaussians=np.array([block.gaussians for block in file.blocks], np.int64),
        )


def read_plan(path: Path) -> Plan:
    """The plan in a plan.json. Raises InputError as `Plan.from_json`, OSError if the file cannot be read."""
    try:
        data = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON: {error}") from error
    try:
        return Plan.from_json(data)
    except InputError as error:
        raise InputError(f"{path.parent}/{error}") from error


def make_plan(
    centers: ArrayLike,
    means: ArrayLike,
    scores: "ArrayLike | scipy.sparse.csr_array",
    grid: Cells,
    config: PartitionConfig,
    *,
    rows: Sequence[int],
    names: Sequence[str],
) -> Plan:
    """Bounds, cells and assignment in one (eqs. 7-9 and 11).

    Args: centers (K, 3) training camera centres and means (N, 3) scene Gaussians without sky, world units;
    scores (K, B) of eq. 10 for the blocks of `grid` over `config.box(centers)`, may be sparse; rows (K,) of
    Scene.panoramas and names (K,) of the cameras.
    Raises InputError as `aabb`, ValueError on shapes that disagree or values that are not finite.
    """
    points = np.asarray(centers, np.float64)
    box = config.box(points)
    return Plan(
        config=config,
        grid=grid,
        baseline=baseline(points),
        aabb=box,
        rows=tuple(int(row) for row in rows),
        names=tuple(names),
        centers=points,
        assignment=assign(grid.block_of(contract(points, box)), scores, config.tau_grad),
        gaussians=np.bincount(grid.block_of(contract(means, box)), minlength=grid.count),
    )
