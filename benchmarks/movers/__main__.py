"""A scene with passers-by, for trainings that compare: figures are drawn into panoramas of an empty place.

    python -m benchmarks.movers SCENE -o CROWD [--share 0.2]

Held-out panoramas have no figures.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks import report
from benchmarks.movers.paste import paste
from panolog.scene.read import read_scene


def main(arguments: Sequence[str] | None = None) -> int:
    """The program; returns its exit code."""
    parser = report.parser("movers", __doc__, quick=False)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="panoramas of an empty place")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder of the scene with figures")
    parser.add_argument("--share", type=float, default=0.2, help="of the training panoramas with figures")
    parser.add_argument("--seed", type=int, default=0, help="of the figures")
    options = parser.parse_args(arguments)

    def work() -> report.Report:
        covered = paste(read_scene(options.scene), options.output, options.share, options.seed)
        share = 100 * np.mean(list(covered.values()))
        text = f"figures in {len(covered)} panoramas, on {share:.1f} % of each"
        return report.Report({"covered": covered}, text)

    return report.run("movers", options, work)


if __name__ == "__main__":
    sys.exit(main())
