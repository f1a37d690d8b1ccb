"""What the recipe must show, each as measured: met or missed, with the numbers."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import fmean

from benchmarks.paper.results import Point, Results
from benchmarks.paper.tables import Table

STREET = "street"
_OTHERS = ("paper", "authors")  # recipes that panolog is compared with
KINDS: Mapping[str, tuple[float, float]] = {  # dB that blocks must gain over as many iterations, over as long
    STREET: (0.2, 0.5),
    "flat": (0.0, 0.0),
    "flight": (0.2, 0.7),
}


@dataclass(frozen=True)
class Goal:
    """One claim."""

    name: str
    wanted: str
    measured: str
    met: bool


def goals(results: Results, kinds: Mapping[str, str]) -> list[Goal]:
    """Those for which there are results. Args: kinds, of KINDS by scene, where it is not a street."""
    by_scene = [*_blocks(results, kinds), *_memory(results), *_g2ps(results)]
    return [*_recipes(results), *_sooner(results), *_lasting(results), *by_scene]


def table(found: Sequence[Goal]) -> Table:
    """All goals."""
    rows = tuple((goal.name, goal.wanted, goal.measured, "met" if goal.met else "missed") for goal in found)
    return Table("What it must show", ("claim", "wanted", "measured", ""), rows)


def _recipes(results: Results) -> Iterator[Goal]:
    """Whether panolog is better than the other recipes, at equal iterations and at equal wall-clock."""
    least = {"ws_psnr": 1.5, "psnr": 1.2}  # dB on average over the paper's recipe
    yield from _better(results, "panolog-time", "paper", "equal wall-clock", least)
    yield from _better(results, "panolog", "paper", "equal iterations", least)
    yield from _better(results, "panolog", "authors", "equal iterations", {})
    for other in _OTHERS:
        yield from _better(results, "panolog-stage1", f"{other}-stage1", "equal iterations", {})


def _better(
    results: Results, variant: str, base: str, how: str, least: Mapping[str, float]
) -> Iterator[Goal]:
    """One variant against another. Args: least, what a metric must gain on average, where 0 is not enough."""
    name = f"{variant} against {base}, {how}"
    for metric, label in _NAMES.items():
        gains = _gains(results, variant, base, metric)
        if not gains:
            continue
        mean, worst, wanted = fmean(gains.values()), min(gains.values()), least.get(metric, 0.0)
        unit, digits = ("", 4) if metric == "ssim" else (" dB", 2)
        each = ", ".join(f"{scene} {gain:+.{digits}f}" for scene, gain in gains.items())
        yield Goal(
            f"{name}: {label}",
            f"mean {f'at least {wanted:+g}{unit}' if wanted else 'above 0'}, on no scene worse",
            f"mean {mean:+.{digits}f}{unit}: {each}",
            (mean >= wanted if wanted else mean > 0) and worst >= 0,
        )
    pairs = [
        (scene, a.gaussians, b.gaussians)
        for scene in results.scenes
        if (a := results.first(scene, variant)) and (b := results.first(scene, base))
    ]
    if pairs:
        yield Goal(
            f"{name}: Gaussians",
            "no more on any scene",
            ", ".join(f"{scene} {a:,} against {b:,}" for scene, a, b in pairs),
            all(a <= b for _, a, b in pairs),
        )


_NAMES = {"ws_psnr": "WS-PSNR", "psnr": "PSNR", "ssim": "SSIM"}


def _gains(results: Results, variant: str, base: str, metric: str = "ws_psnr") -> dict[str, float]:
    """By scene, mean over seeds."""
    found = {scene: results.gain(scene, variant, base, metric) for scene in results.scenes}
    return {scene: gain.mean for scene, gain in found.items() if gain is not None}


def _sooner(results: Results) -> Iterator[Goal]:
    """Whether panolog takes a third of the time in which each of the others reaches its final quality."""
    for scene in results.scenes:
        for other in _OTHERS:
            for base, names in (
                (other, ("panolog-time", "panolog")),
                (f"{other}-stage1", ("panolog-stage1",)),
            ):
                yield from _sooner_than(results, scene, base, names)


def _sooner_than(results: Results, scene: str, base: str, names: Sequence[str]) -> Iterator[Goal]:
    """Whether a variant reaches the final quality of `base` in a third of its time, on the same machine."""
    slower = results.first(scene, base)
    found = filter(None, (results.first(scene, name) for name in names))
    curves = [run for run in found if run.curve and slower and run.machine == slower.machine]
    if slower is None or (final := slower.metric("ws_psnr")) is None or not curves:
        return
    times = [(when, run) for run in curves if (when := reached(run.curve, final)) is not None]
    measured, met = "not reached", False
    if times:
        when, run = min(times, key=lambda pair: pair[0])
        share = when / slower.total
        which = f" ({run.variant})" if len(names) > 1 else ""
        measured = f"{when:.0f} s of {slower.total:.0f} s, {100 * share:.0f} %{which}"
        met = share <= 1 / 3
    yield Goal(
        f"{scene}: {names[-1]} reaches the final WS-PSNR of {base} ({final:.2f} dB)",
        "in at most a third of its time",
        measured,
        met,
    )


def _lasting(results: Results) -> Iterator[Goal]:
    """Whether longer training is never worse."""
    for scene in results.scenes:
        run = results.first(scene, "panolog-stage1")
        if run is not None and run.curve:
            most, last = max(point.ws_psnr for point in run.curve), run.curve[-1].ws_psnr
            yield Goal(
                f"{scene}: Stage I of panolog at its end",
                "at its best",
                f"{last:.2f} dB, at most {most:.2f} dB before",
                last >= most,
            )


def reached(curve: Sequence[Point], level: float) -> float | None:
    """Seconds after which a curve is at a level for the first time, between its points linearly."""
    if curve and curve[0].ws_psnr >= level:
        return curve[0].seconds
    for a, b in pairwise(curve):
        if a.ws_psnr < level <= b.ws_psnr:
            return a.seconds + (b.seconds - a.seconds) * (level - a.ws_psnr) / (b.ws_psnr - a.ws_psnr)
    return None


def _blocks(results: Results, kinds: Mapping[str, str]) -> Iterator[Goal]:
    for scene in results.scenes:
        longer, in_time = KINDS[kinds.get(scene, STREET)]
        for count in (2, 4):
            for base, least, what in (
                ("panolog-stage1", 0.0, "its own Stage I"),
                (f"stage1-all-{count}", longer, "Stage I for as many iterations in all"),
                (f"stage1-time-{count}", in_time, "Stage I for as long, with a worker for each block"),
            ):
                gain = results.gain(scene, f"blocks-{count}", base)
                if gain is not None:
                    yield Goal(
                        f"{scene}: {count} blocks against {what}",
                        f"at least {least:+g} dB",
                        f"{gain.signed} dB",
                        gain.mean >= least,
                    )


def _memory(results: Results) -> Iterator[Goal]:
    for scene in results.scenes:
        gains = {count: results.gain(scene, f"memory-{count}", "memory-1") for count in (2, 4, 8)}
        found = {count: gain for count, gain in gains.items() if gain is not None}
        if found:
            yield Goal(
                f"{scene}: blocks against one model, with one budget of memory for every task",
                "at least +1.5 dB with one of the numbers of blocks",
                ", ".join(f"{count} blocks {gain.signed} dB" for count, gain in found.items()),
                max(gain.mean for gain in found.values()) >= 1.5,
            )


def _g2ps(results: Results) -> Iterator[Goal]:
    for scene in results.scenes:
        for name in ("panolog", "panolog-tau-0.8"):
            gain, run = results.gain(scene, name, "panolog-position"), results.first(scene, name)
            if gain is not None and run is not None:
                overlap = "–" if run.overlap is None else f"{run.overlap:.2f}"
                yield Goal(
                    f"{scene}: {name} against cameras by position",
                    "sign and size over seeds",
                    f"{gain.signed} dB, {overlap} blocks per camera",
                    gain.mean > (gain.deviation or 0.0),
                )
