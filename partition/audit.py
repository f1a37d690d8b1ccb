"""A summary of a plan in sentences, to check before the blocks are trained."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import csr_array

from panolog.partition.assignment import OVERLAP, overlap
from panolog.partition.plan import Plan

_UNEVEN = 2.0  # the largest block over the mean, from which on it is reported
_FEW = 0.05  # of all assignments: where gradients add fewer, the plan is nearly one by position
TAUS = (0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.05, 0.02, 0.01)  # thresholds that are tried, in order


def audit(plan: Plan, scores: ArrayLike | csr_array) -> list[str]:
    """One line each for size, overlap, imbalance, and blocks or cameras that take no part.

    Where gradients add less than 5 % of the assignments, one more line names the largest τ_grad at which a
    camera trains 1.5 blocks on average, the overlap that a run's estimate assumes, or as many as it can.

    Args: scores (K, B) that the plan was made of.
    """
    counts = plan.assignment.counts
    seen = (counts > 0) & (plan.gaussians > 0)
    return [
        f"{plan.grid.count} blocks ({plan.grid}): {int(seen.sum())} with training cameras, "
        f"{len(plan.rows)} cameras, {int(plan.gaussians.sum()):,} Gaussians",
        _overlap(plan),
        *_few_by_gradient(plan, scores),
        *_imbalance("Gaussians", plan.gaussians[plan.trained]),
        *_imbalance("cameras", counts[plan.trained]),
        *_unusual(plan),
    ]


def _overlap(plan: Plan) -> str:
    added = plan.assignment.added
    return (
        f"a camera trains {plan.assignment.overlap:.2f} blocks on average; "
        f"{added} assignment{'s' * (added != 1)} added by gradient score"
    )


def _few_by_gradient(plan: Plan, scores: ArrayLike | csr_array) -> list[str]:
    tau, cameras = plan.config.tau_grad, len(plan.rows)
    assigned = int(plan.assignment.assigned.nnz)
    share = plan.assignment.added / max(assigned, 1)
    if plan.grid.count == 1 or tau == 1.0 or share >= _FEW:  # 1 wants assignments by position only
        return []
    line = f"gradients add {100 * share:.0f} % of the assignments at partition.tau_grad={tau:g}"
    lower = [other for other in TAUS if other < tau]
    blocks = overlap(plan.camera_blocks, scores, lower)
    if not lower or blocks[-1] * cameras == assigned:
        return [f"{line}, and no more at lower values"]
    best = int(np.argmax(blocks >= min(OVERLAP, blocks[-1])))
    return [f"{line}; at {lower[best]:g} a camera would train {blocks[best]:.2f} blocks on average"]


def _imbalance(what: str, counts: NDArray[np.int64]) -> list[str]:
    if len(counts) < 2 or counts.max() < _UNEVEN * counts.mean():
        return []
    return [
        f"the blocks are uneven: {int(counts.min()):,} to {int(counts.max()):,} {what}, "
        f"the largest has {counts.max() / counts.mean():.1f} times the mean"
    ]


def _unusual(plan: Plan) -> list[str]:
    cameras = plan.assignment.counts
    lines = []
    idle = len(plan.rows) - int(np.count_nonzero(plan.assignment.assigned @ (plan.gaussians > 0)))
    if idle:
        lines.append(
            f"{idle} cameras train no block: their cells are empty, and no score assigned them elsewhere"
        )
    for block, (seen, count) in enumerate(zip(cameras, plan.gaussians, strict=True)):
        if count == 0:
            lines.append(
                f"block {block} has no Gaussians and is skipped; {int(seen)} cameras are assigned to it"
            )
        elif seen == 0:
            lines.append(
                f"block {block} has no camera: its {int(count):,} Gaussians stay as they were after Stage I"
            )
        elif plan.trained[block]:
            continue
        elif seen >= plan.config.min_cameras:
            share = f"partition.min_share={plan.config.min_share:g} of the mean"
            lines.append(
                f"block {block} has {int(count):,} Gaussians, not more than {share}: they stay as they were "
                "after Stage I"
            )
        else:
            lines.append(
                f"block {block} has {int(seen)} camera{'s' * int(seen != 1)}, fewer than "
                f"partition.min_cameras={plan.config.min_cameras}: "
                f"its {int(count):,} Gaussians stay as they were after Stage I"
            )
    return lines
