"""Real runs with limits: does each end with a model that was measured, and near its limit?

    python -m benchmarks.money.limits [--iterations 5000] [--parts 0.8]
    python -m benchmarks.money.limits --quick

The town of the demo is reconstructed in two blocks, once without a limit, then with limits of cost and of
time that are parts of what that took. The machine costs one unit per second: both limits are seconds. What is
kept for the end is some seconds at least, so runs of less than a minute end earlier. A run passes that ends
as `limited`, with a model that was measured, and at most 5 % from its limit.
"""

import json
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks import report
from benchmarks.runs import panolog
from panolog.synthetic.make import make_town

_PRICES = 'currency = "units"\n[[machine]]\nname = "this machine"\nhost = "*"\nprice = 3600\n'
_GOAL = 0.05


@dataclass(frozen=True)
class Row:
    """A run."""

    limit: str  # "cost" or "time"
    allowed: float | None  # seconds; None = the run without a limit
    used: float
    status: str
    iterations: int  # of both blocks
    gaussians: int | None  # of the merged model
    psnr: float | None

    @property
    def excess(self) -> float | None:
        """Part of the limit that was used beyond it; negative if less was."""
        return None if self.allowed is None else self.used / self.allowed - 1

    @property
    def passes(self) -> bool:
        """Whether it has ended as it should."""
        if self.excess is None:
            return True
        return self.status == "limited" and self.psnr is not None and abs(self.excess) <= _GOAL


def measure(folder: Path, iterations: int, parts: Sequence[float]) -> Iterator[Row]:
    """The run without a limit, and those with limits."""
    town, prices = folder / "town", folder / "prices.toml"
    make_town(town, panoramas=20, width=256, points=2000)
    prices.write_text(_PRICES)
    settings = ["--blocks", "2x1x1", "--iterations", str(iterations), "--width", "256", "--device", "cpu"]
    settings += ["--prices", str(prices), "--set", "checkpoint.every=50"]
    panolog("run", str(town), "-o", str(folder / "whole"), *settings)
    whole = _row(folder / "whole", "", None)
    yield whole
    for limit, option in (("cost", "--max-cost"), ("time", "--deadline")):
        for part in parts:
            allowed = round(part * whole.used)  # without what precedes the first task, which counts for time
            root = folder / f"{limit}-{part:g}"
            value = str(allowed) if limit == "cost" else f"{allowed}s"
            panolog("run", str(town), "-o", str(root), *settings, option, value)
            yield _row(root, limit, allowed)


def _row(root: Path, limit: str, allowed: float | None) -> Row:
    status = json.loads(panolog("status", str(root), "--json"))
    blocks = [task for task in status["tasks"] if task["name"].startswith("block/")]
    return Row(
        limit=limit,
        allowed=allowed,
        used=status["seconds"] if limit == "time" else status["money"]["used"]["cost"],
        status=status["status"],
        iterations=sum(task["iteration"] or 0 for task in blocks),
        gaussians=(status["model"] or {}).get("gaussians"),
        psnr=(status["metrics"] or {}).get("psnr"),
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("money.limits", __doc__)
    parser.add_argument("--iterations", type=int, default=5000, help="of Stage I and of each block (5000)")
    parser.add_argument("--parts", default="0.8", help="of the whole run (0.8)")
    options = parser.parse_args(arguments)

    def work() -> report.Report:
        parts = [float(part) for part in options.parts.split(",")]
        if options.quick:
            options.iterations, parts = 600, [0.8]
        with tempfile.TemporaryDirectory(prefix="limits-") as folder:
            rows = list(measure(Path(folder), options.iterations, parts))
        head = (
            "limit",
            "seconds",
            "used",
            "beyond it",
            "status",
            "iterations",
            "Gaussians",
            "PSNR dB",
        )
        cells = [
            (
                *(row.limit or "none", row.allowed, row.used),
                "" if row.excess is None else f"{row.excess:+.1%}",
                *(row.status, row.iterations, row.gaussians, row.psnr),
            )
            for row in rows
        ]
        passed = all(row.passes for row in rows)
        return report.Report({"rows": [asdict(row) for row in rows]}, report.markdown(head, cells), passed)

    return report.run("money.limits", options, work)


if __name__ == "__main__":
    sys.exit(main())
