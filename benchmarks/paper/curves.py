"""Pictures as SVG: quality over seconds, and overlap over τ; their ink is the page's text colour."""

from collections.abc import Callable, Sequence
from io import BytesIO

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.paper.results import Result, Results
from benchmarks.paper.tables import Overlap
from panolog.orchestrator.watch.views.block_colors import BLOCK_COLORS

_INK = "#22272e"
_SIZE = (5.4, 3.4)  # inches: as wide as a phone, so that its text is not reduced much there


def quality_curve(results: Results, scene: str) -> str | None:
    """The WS-PSNR of all runs of a scene whose states were evaluated; None if there are none."""
    runs = [result for result in results.all if result.scene == scene and result.curve and not result.same_as]
    if not runs:
        return None

    def draw(axes: Axes) -> None:
        for number, run in enumerate(runs):
            _run(axes, run, BLOCK_COLORS[number % len(BLOCK_COLORS)])
        axes.set_xlim(left=0)
        machines = {run.machine for run in runs}
        axes.set_xlabel("seconds since the first task began" + ", on several machines" * (len(machines) > 1))
        axes.set_ylabel("WS-PSNR, dB, held out")

    return svg(draw, f"{scene}: quality over seconds")


def _run(axes: Axes, run: Result, color: str) -> None:
    times = [point.seconds for point in run.curve]
    values = [point.ws_psnr for point in run.curve]
    axes.plot(times, values, color=color, lw=1.6, marker="o", ms=3, label=run.variant)
    coarse = [point for point in run.curve if point.stage == "coarse"]
    if coarse and coarse[-1] is not run.curve[-1]:
        end = coarse[-1]
        axes.plot([end.seconds], [end.ws_psnr], color=color, marker="D", ms=6, ls="")


def overlap_curve(found: Sequence[Overlap]) -> str | None:
    """Blocks per camera over τ, a line for each plan; None if there is no plan."""
    plans = list(dict.fromkeys((row.scene, row.variant) for row in found))
    if not plans:
        return None

    def draw(axes: Axes) -> None:
        for number, plan in enumerate(plans):
            rows = [row for row in found if (row.scene, row.variant) == plan]
            color = BLOCK_COLORS[number % len(BLOCK_COLORS)]
            taus, blocks = [row.tau for row in rows], [row.blocks for row in rows]
            axes.plot(taus, blocks, color=color, lw=1.6, marker="o", ms=3, label=", ".join(plan))
        axes.set_ylim(bottom=0.9)
        axes.set_xlabel("τ of eq. 11")
        axes.set_ylabel("blocks per camera")

    return svg(draw, "Overlap against τ")


def svg(draw: Callable[[Axes], None], title: str) -> str:
    """A picture with a transparent ground whose ink is `currentColor`."""
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": title, "font.size": 9}):
        figure = Figure(figsize=_SIZE, layout="constrained")
        axes = figure.add_subplot()
        draw(axes)
        axes.set_title(title, color=_INK, fontsize=10, loc="left")
        axes.grid(color=_INK, alpha=0.15, lw=0.5)
        axes.tick_params(colors=_INK)
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(_INK)
        axes.xaxis.label.set_color(_INK)
        axes.yaxis.label.set_color(_INK)
        legend = axes.legend(frameon=False, labelcolor=_INK, fontsize=8)
        legend.set_zorder(1)
        written = BytesIO()
        figure.savefig(written, format="svg", transparent=True, metadata={"Date": None})
    text = written.getvalue().decode()
    return text[text.index("<svg") :].replace(_INK, "currentColor")


def standalone(svg: str) -> str:
    """The same as a file of its own: on white, in dark ink."""
    head, tail = svg.split(">", 1)
    return f'{head} style="background:#fff;color:{_INK}">{tail}'
