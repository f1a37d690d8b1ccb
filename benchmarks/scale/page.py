"""docs/scale.md, from what the parts have found."""

from collections.abc import Sequence
from typing import Any

from benchmarks import report
from benchmarks.scale.cities import NAMES, City, growth
from benchmarks.scale.laws import Calibrated, Law
from benchmarks.scale.machines import Hours, law, spread
from benchmarks.scale.models import LevelsRow, MergeRow, exponent
from panolog.orchestrator.estimates.suggestions import DETAIL as SPAN

COMMAND = "python -m benchmarks.scale -o FOLDER --docs docs/scale.md"
HEADING = f"""# Scale

How bytes and seconds grow with a place. The command below writes this page; FOLDER keeps what each part has
found as JSON, and `--only` measures some parts again. Each section says what is measured and what is a model.
Where the load is above one, other work has shared the cores: seconds are then upper bounds.

    {COMMAND}"""
CITIES = """## Cities whose blocks keep their size

    python -m benchmarks.scale -o FOLDER --only cities [--cities SCENES]

**Measured**: whole runs of cities of `panolog demo --city` at {width}×{height}, with as many districts
as it takes for none to have more than {district} panoramas, a block for every {block},
`stage2.detail={detail:g}` and `cache.memory={cache}`, for {iterations} iterations of Stage I and of each
block. Each task ran alone on one core; the largest of each kind counts. Some 400 MiB are the process
itself, most of it libraries that all tasks share."""
LAWS = """## The tasks of a city

    python -m benchmarks.scale -o FOLDER --only laws [--scene CITY]

**Measured**: the calibration, which every run makes: some iterations with the Gaussians at the start,
and some with as many as are expected later, on a city that `panolog demo --city` makes. **Model**: all
of the second table. It is what `panolog doctor` estimates with that calibration for cities whose
streets and sparse points (250 for each panorama) are drawn without images: recipe `panolog`, 30,000
iterations, `--set stage2.detail=8`, one block for 75 panoramas. A width that is not calibrated takes time and
memory in proportion to its pixels. The bytes of a GPU are counted, see `workers/device_memory.py`; the
seconds are of the CPU."""
ONE = """Stage I is one task here; `districts` divides it. The largest block's memory follows its width and,
up to `cache.memory` (4 GiB), its panoramas, each with a baked exterior of 32 bytes for a pixel; what exceeds
that is in a file. Its Gaussians hardly grow with the city; what it starts from has levels of detail of all
others."""
DRIVER = """## The driver

    python -m benchmarks.scale -o FOLDER --only driver

**Measured**, with the real driver, database, files and command; simulated are the workers, whose
messages come by the clock. The driver ends when half of the blocks are done, as after a crash, and
another resumes the run. `panolog status` includes the start of Python."""
DASHBOARD = """Its dashboard:

    python -m benchmarks.scale -o FOLDER --only dashboard

The dashboard of a run of the same size, **measured** as a browser loads it. The run's history was
written without running it; then all blocks in training report once a second."""
PLANS = """What bounds the number of blocks is the plan: each training panorama has a score for each
block, 8 bytes in memory and some 30 in `plan.json`. 1,000 blocks of 6,000 panoramas are 190 MB, and the
dashboard reads no more than 200; 10,000 blocks of 100,000 panoramas would be 30 GB, which no driver can
hold. The town of this measurement has nine panoramas, and the dashboard's run 400."""
MODELS = """## Merge

    python -m benchmarks.scale -o FOLDER --only merge

**Measured** is what has no mark; rows with * are the power law through the others. The merge copies
files one after another, so memory does not grow. 160 million Gaussians need 80 GB of free disk (parts
and result) and a billion 500 GB, which the machine did not have."""
DETAIL = """## Levels of detail

    python -m benchmarks.scale -o FOLDER --only levels

**Measured** is what has no mark; rows with * are in proportion to the last one that was."""
LEVELS = """The driver makes levels of detail block by block, in files that it maps: it holds the positions of
all Gaussians and what one block takes. From the second largest city to the largest its memory grew by
{each:.0f} bytes for a Gaussian. So {machine:.0f} GB are enough for {most:.0f} million, and by the same law a
billion would take {billion:.0f} GB. A cut looks at the levels of each other block, so its seconds grow with
the number of blocks, and those of all blocks with its square.

The Gaussians of others show when reduction begins: those of a city with 500 for each panorama are a
metre apart, which spans a pixel of 1024×512 from 160 metres on."""
MACHINES = """## Which machine, and how many hours

    python -m benchmarks.scale -o FOLDER --only machines

**A model, not a measurement**: no card has run this. The paper names its card, an RTX 4090, but no
times. An iteration is assumed to take {each:.1f} ms for each million Gaussians and {pixel:.1f} ms for
each million pixels on a TITAN RTX (gsplat's published times on Mip-NeRF 360, of which the fit is within
{spread:.0f} %), over the ratio of memory bandwidths; the rest is the product's estimate for such a
calibration. Panoramas of 3840×1920 have six times as many pixels as the images of those times, so that
part is extrapolated: take the hours as an order of magnitude. `python -m benchmarks.first_hour` on a
card replaces the assumption."""
PLACES = """The paper's scenes have 5,637 panoramas together; it does not say how many each has, so each
row has a quarter of them, the paper's recipe and two blocks, and as many Gaussians as the paper's model
has bytes for. Two blocks keep two cards busy. The city has the recipe `panolog` with levels of detail,
a district for as many panoramas as one of those scenes has, and a block for 75 of them. Not in the
hours: poses, depth maps, and what the driver itself does. For the city that is the limit: its plan has
10⁸ scores, and its levels of detail need the memory of the section above."""
CITY_PICTURES = (
    ("city-memory", "Peak memory of the largest task of each kind against the panoramas of the city"),
    ("city-iteration", "Milliseconds of an iteration of the slowest task of each kind"),
)
PICTURES = (
    ("block-memory", "Memory of the largest block on the CPU against the panoramas of the city, by width"),
    ("block-hours", "Hours of the largest block on the CPU against the panoramas of the city, by width"),
)
_GIB, _FAR = 2**30, (160_000_000, 1_000_000_000)
_LEVELS = (10_000_000, 40_000_000, 160_000_000, 1_000_000_000)
_MACHINE = 8e9  # bytes of memory in an example


def page(found: dict[str, Any], measured_on: str, folder: str) -> str:
    """The page, of the parts that there are. Args: folder of the pictures, from the page."""
    parts = [HEADING, f"Measured on: {measured_on}."]
    if "cities" in found:
        size = found["cities"]["size"]
        drawn = [f"![{text}]({folder}/{name}.svg)" for name, text in CITY_PICTURES]
        measured = [City.parse(row) for row in found["cities"]["cities"]]
        text = CITIES.format(**size, detail=SPAN, height=size["width"] // 2)
        parts += [text, *drawn, cities(measured)]
    if "laws" in found:
        pictures = [f"![{text}]({folder}/{name}.svg)" for name, text in PICTURES]
        bases = [Calibrated(**row) for row in found["calibrations"]]
        rows = [Law(**row) for row in found["laws"]]
        parts += [LAWS, _calibrated(bases), *pictures, laws(rows), ONE]
    if "driver" in found:
        parts += [DRIVER, driver(found["driver"])]
    if "dashboard" in found:
        parts += [DASHBOARD, dashboard(found["dashboard"]), PLANS]
    if "merge" in found:
        parts += [MODELS, merges([MergeRow(**row) for row in found["merge"]])]
    if "levels" in found:
        rows_of_levels = [LevelsRow(**row) for row in found["levels"]]
        each = _more(*rows_of_levels[-2:])
        text = LEVELS.format(each=each, machine=_MACHINE / 1e9, most=_MACHINE / each / 1e6, billion=each)
        parts += [DETAIL, levels(rows_of_levels), text]
    if "machines" in found:
        each_, pixel = law()
        text = MACHINES.format(each=each_, pixel=pixel, spread=100 * spread())
        parts += [text, machines([Hours(**row) for row in found["machines"]]), PLACES]
    return "\n\n".join(parts) + "\n"


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
        ("memory of a driver, peak MB", max(first["memory"], resumed["memory"])),
        ("run.db, MB", measured["database"]),
        ("`panolog status --json`, s", measured["status"]),
        ("what to start on as many GPUs when one is free: CPU s", decision["seconds"]),
    ]
    return report.markdown(("what", "measured"), rows)


def dashboard(found: dict[str, Any]) -> str:
    """Of one run."""
    size, measured = found["size"], found["measured"]
    rows: list[tuple[object, ...]] = [
        ("blocks, of them in training", f"{size['blocks']:,}, {size['together']:,}"),
        ("events", size["events"]),
        ("first page, run not in memory, s", measured["cold"]),
        ("the same again, s", measured["warm"]),
        ("from a record to a client: longest, s", max(measured["alone"])),
        (f"the same among {measured['clients']} other clients, s", max(measured["among"])),
        ("memory of the server, peak MB", measured["memory"]),
        ("run.db, MB", measured["database"]),
    ]
    return report.markdown(("what", "measured"), rows)


def _pair(first: dict[str, float], second: dict[str, float], name: str) -> str:
    return f"{first[name]:.1f}, {second[name]:.1f}"


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


def machines(rows: Sequence[Hours]) -> str:
    """Places on machines."""
    head = (
        *("place", "machines", "districts", "blocks", "Gaussians", "largest task, GiB of a GPU", "fits"),
        *("Stage I, h", "blocks, h", "all, h"),
    )
    return report.markdown(
        head,
        [
            (
                *(row.place, row.machines, row.districts, row.blocks, row.gaussians, row.memory / _GIB),
                *("yes" if row.fits else "no", row.coarse, row.refinement, row.total),
            )
            for row in rows
        ],
    )
