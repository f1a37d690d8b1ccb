"""docs/scale.md, from what the parts have found: the tables of `page.md.j2`."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jinja2

from benchmarks import report
from benchmarks.scale.cities import NAMES, City, growth
from benchmarks.scale.laws import Calibrated, Law
from benchmarks.scale.merging import MergeRow, exponent
from benchmarks.scale.models import LevelsRow
from benchmarks.scale.plans import PlanSize
from panolog.orchestrator.engine.estimates.suggestions import DETAIL

TEMPLATE = Path(__file__).with_name("page.md.j2")
_GIB, _FAR = 2**30, (160_000_000, 1_000_000_000)
_LEVELS = (10_000_000, 40_000_000, 160_000_000, 1_000_000_000)


def page(found: dict[str, Any], measured_on: str, folder: str) -> str:
    """The page, of the parts that there are. Args: folder of the pictures, from the page."""
    tables: dict[str, Any] = {"measured_on": measured_on, "folder": folder, "detail": DETAIL}
    if "cities" in found:
        tables["size"] = found["cities"]["size"]
        tables["cities"] = cities([City.parse(row) for row in found["cities"]["cities"]])
    if "laws" in found:
        tables["calibrations"] = _calibrated([Calibrated(**row) for row in found["calibrations"]])
        tables["laws"] = laws([Law(**row) for row in found["laws"]])
    if "driver" in found:
        tables["driver"] = driver(found["driver"])
    if "plans" in found:
        tables["plans"] = plans([PlanSize(**row) for row in found["plans"]])
    if "merge" in found:
        tables["merge"] = merges([MergeRow(**row) for row in found["merge"]])
    if "levels" in found:
        rows = [LevelsRow(**row) for row in found["levels"]]
        tables |= {"levels": levels(rows), "each": _more(*rows[-2:])}
    written: str = jinja2.Template(TEMPLATE.read_text()).render(tables)
    return written.rstrip("\n") + "\n"


def _calibrated(rows: Sequence[Calibrated]) -> str:
    head = ("calibrated at", "Gaussians", "ms of an iteration", "Gaussians", "ms", "peak MiB", "threads")
    return report.markdown(
        head,
        [
            (
                f"{row.width}×{row.width // 2}",
                row.gaussians[0],
                1e3 * row.seconds[0],
                row.gaussians[1],
                1e3 * row.seconds[1],
                round(row.host / 2**20),
                row.threads,
            )
            for row in rows
        ],
    )


def cities(found: Sequence[City]) -> str:
    """Of their largest tasks."""
    head = ("panoramas", "task", "number", "Gaussians", "peak MiB", "ms of an iteration")
    cells = [
        (city.panoramas, NAMES[stage], task.count, task.gaussians, task.memory / 2**20, 1e3 * task.seconds)
        for city in found
        for stage, task in city.stages.items()
    ]
    ratios = [(f"{NAMES[stage]}", *growth(found, stage)) for stage in found[0].stages]
    grown = report.markdown(("the largest city to the smallest", "memory, ×", "time, ×"), ratios)
    return f"{report.markdown(head, cells)}\n\n{grown}"


def laws(rows: Sequence[Law]) -> str:
    """Of cities."""
    head = (
        *("panoramas", "blocks", "width", "Gaussians", "Stage I GiB", "on a GPU", "hours"),
        *("score GiB", "minutes", "block: Gaussians", "GiB", "on a GPU", "hours"),
    )
    return report.markdown(
        head,
        [
            (
                *(
                    row.panoramas,
                    row.blocks,
                    row.width,
                    row.gaussians,
                    row.coarse / _GIB,
                    row.coarse_gpu / _GIB,
                ),
                *(row.coarse_seconds / 3600, row.score / _GIB, row.score_seconds / 60, row.block_gaussians),
                *(row.block / _GIB, row.block_gpu / _GIB, row.block_seconds / 3600),
            )
            for row in rows
        ],
    )


def driver(measured: dict[str, Any]) -> str:
    """Of both drivers."""
    load, first, resumed = measured["load"], measured["first"], measured["resumed"]
    decision = measured["decision"]
    messages = first["messages"] + resumed["messages"]
    cpu = first["cpu"] + resumed["cpu"]
    rows: list[tuple[object, ...]] = [
        ("blocks, workers", f"{load['blocks']:,}, {load['workers']:,}"),
        ("messages a second of each worker, seconds of a block", f"{load['rate']:g}, {load['seconds']:g}"),
        ("messages of progress", messages),
        ("of them lost after the resume", resumed["lost"]),
        ("seconds until half of the blocks were done, and of the rest", _pair(first, resumed, "seconds")),
        ("seconds until all workers had a block: at first, after the resume", _pair(first, resumed, "full")),
        ("CPU of both drivers, s", cpu),
        ("CPU of a block with its messages, ms", 1e3 * cpu / load["blocks"]),
        ("longest wait of a message, s", max(first["late"], resumed["late"])),
        ("longest turn of the driver's loop, CPU s", max(first["turn"], resumed["turn"])),
        ("memory of a driver, peak MB", max(first["memory"], resumed["memory"])),
        ("run.db, MB", measured["database"]),
        ("`panolog status --json`, s", measured["status"]),
        ("what to start on as many GPUs when one is free: CPU s", decision["seconds"]),
    ]
    return report.markdown(("what", "measured"), rows)


def _pair(first: dict[str, float], second: dict[str, float], name: str) -> str:
    return f"{first[name]:.1f}, {second[name]:.1f}"


def plans(rows: Sequence[PlanSize]) -> str:
    """The table of plans: their size, the bytes of plan and scores, and how long these take."""
    head = (
        "panoramas",
        "blocks",
        "in sight",
        "plan.json, MB",
        "scores.npz, MB",
        "write, s",
        "read, s",
        "peak MB",
    )
    return report.markdown(head, [tuple(asdict(row).values()) for row in rows])


def merges(rows: Sequence[MergeRow]) -> str:
    """Measured, then by the law that they follow."""
    sizes = [row.gaussians for row in rows]
    factor, power = exponent(sizes, [row.seconds for row in rows])
    table: list[tuple[object, ...]] = [
        (f"{row.gaussians:,}", row.blocks, row.seconds, row.speed, row.cat, row.memory) for row in rows
    ]
    each = rows[-1].gaussians // rows[-1].blocks
    table += [(f"{size:,}*", size // each, factor * size**power, None, None, None) for size in _FAR]
    head = ("Gaussians", "blocks", "seconds", "MB/s", "`cat`, MB/s", "more memory, MB")
    return f"{report.markdown(head, table)}\n\nSeconds grow with the power {power:.2f} of the Gaussians."


def _more(first: LevelsRow, second: LevelsRow) -> float:
    """Bytes of the driver for each Gaussian more."""
    held = (row.memory * row.gaussians for row in (second, first))
    return (next(held) - next(held)) / (second.gaussians - first.gaussians)


def levels(rows: Sequence[LevelsRow]) -> str:
    """Of cities."""
    head = (
        *("panoramas", "blocks", "Gaussians", "levels: seconds", "bytes of a Gaussian"),
        *("a block's file: seconds", "Gaussians of others in it"),
    )
    cells: list[tuple[object, ...]] = [
        (row.panoramas, row.blocks, f"{row.gaussians:,}", row.seconds, round(row.memory), row.cut, row.starts)
        for row in rows
    ]
    last = rows[-1]
    for size in _LEVELS:
        panoramas, blocks = (round(size / last.gaussians * count) for count in (last.panoramas, last.blocks))
        cells.append(
            (panoramas, blocks, f"{size:,}*", last.seconds * size / last.gaussians, None, None, None)
        )
    return report.markdown(head, cells)
