"""What `panolog scene depth` tells at its end."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from panolog.prepare.networks.depth_maps import DepthJob
from panolog.prepare.networks.depth_report import MapAlignment, summary
from panolog.prepare.networks.inverse_depth import NEAREST


@dataclass(frozen=True)
class DepthReport:
    """The maps of a scene, and how they fit it."""

    made: int  # panoramas by this call
    kept: int  # made by the same network before
    given: int  # made by somebody else
    device: str
    metres: float | None  # in a world unit, as a metric network sees it
    rows: tuple[MapAlignment, ...]

    def as_json(self) -> dict[str, Any]:
        """As `--json` prints it."""
        return {
            "made": self.made,
            "kept": self.kept,
            "given": self.given,
            "device": self.device,
            "metres_per_unit": self.metres,
            **summary(list(self.rows)),
            "images": [row.as_json() for row in self.rows],
        }

    def lines(self) -> Iterator[str]:
        """The same for people."""
        yield from (row.line() for row in self.rows)
        numbers = summary(list(self.rows))
        yield f"{self.made} maps made, {self.kept} kept, {self.given} given"
        yield f"{numbers['aligned']} of {numbers['maps']} fit the sparse points"
        if numbers["aligned"]:
            yield f"median scale {numbers['scale']:.5g}, residual {numbers['residual']:.3f}"
        if self.metres is not None:
            yield f"the network sees one world unit as {self.metres:.4g} m"


def report(job: DepthJob, rows: list[MapAlignment]) -> DepthReport:
    """Puts a finished job and its table together."""
    scale = summary(rows)["scale"]
    metric = job.manifest.depth.factor is not None and not job.given and scale is not None
    metres = scale * NEAREST if metric else None
    return DepthReport(len(job.todo), job.done, job.given, job.network.device, metres, tuple(rows))
