"""The speed of an iteration, and of gsplat on the same Gaussians."""

import time
from dataclasses import asdict, replace

import torch

from benchmarks.first_hour.outcome import NO_CARD, ROOT, Context, Outcome, shown
from benchmarks.rasterizer import __main__ as rasterizer
from benchmarks.rasterizer import peers, roofline
from benchmarks.rasterizer.cases import CaseSpec
from benchmarks.rasterizer.page import page
from benchmarks.rasterizer.rows import COUNTS, Row, benchmark, tables
from panolog.orchestrator.runs.machines.machine import cores
from panolog.renderer.process import prepare
from panolog.scene.errors import DeviceError
from panolog.scene.files import write_bytes

PAGE = "performance-cuda.md"
_SHARE = 0.6  # of a step's time, after which no further row is begun: a row of a million takes long
_REPEATS = 10
_FIGURE = CaseSpec(1920, 1_000_000)  # of the summary, so the first


def iterations(context: Context) -> Outcome:
    """`benchmarks.rasterizer`, as many rows as there is time for; on a card its page is in docs/ too."""
    ends = time.monotonic() + _SHARE * context.seconds
    prepare(cores())
    arguments = ["--device", context.device, *["--quick"] * (not context.cuda)]
    if context.scene and context.model:
        counts = ",".join(map(str, COUNTS))
        arguments += ["--scene", context.scene, "--model", context.model, "--gaussians", counts]
    options = rasterizer.parse(arguments)
    cases = [*([_FIGURE] if context.cuda else []), *rasterizer.specs(options)]
    output = f"docs/{PAGE}" if context.cuda else str(context.work / PAGE)
    command = shown(["python", "-m", "benchmarks.rasterizer", *arguments, "-o", output])
    rows: list[Row] = []
    outcome = Outcome("failed", reason="no row was measured")
    for row in benchmark(cases, context.device, options.threads, options.repeats):
        rows.append(row)
        content = {"rows": [each.content() for each in rows]}
        outcome = Outcome("passed", _figure(rows[0]), "", (command,), content, tables(rows))
        context.save(outcome)
        if time.monotonic() > ends:
            break
    written = page(rows).encode()
    write_bytes(context.work / PAGE, written)
    if context.cuda:
        write_bytes(ROOT / "docs" / PAGE, written)
    return outcome


def _figure(row: Row) -> str:
    size = f"{row.gaussians:,} Gaussians at {row.width}×{row.height}"
    return f"{row.times.iteration:.2f} ms for an iteration of {size}"


def kernels(context: Context) -> Outcome:
    """Each kernel of an iteration against `benchmarks.rasterizer.roofline`, if it knows the card; baking."""
    prepare(cores())
    size = (2048, 1_000_000)
    spec = CaseSpec(*size)
    name = torch.cuda.get_device_name()
    case = spec.make().to(context.device)
    took, baking = roofline.measured(case, _REPEATS), roofline.baking(case, _REPEATS)
    command = f"python -m benchmarks.rasterizer.roofline --width {size[0]} --gaussians {size[1]}"
    card = roofline.card_of(name)
    expected = {} if card is None else {n: ms for n, ms, _ in roofline.milliseconds(card, spec)}
    figure = f"{sum(took.values()):.2f} ms in the kernels of an iteration, {baking:.1f} ms to bake a view"
    return Outcome(
        "passed",
        figure,
        "",
        (command,),
        {"card": name, "measured_ms": took, "model_ms": expected, "baking_ms": baking},
        roofline.comparison(took, expected),
    )


def gsplat(context: Context) -> Outcome:
    """`benchmarks.rasterizer.peers`; without gsplat our row alone."""
    prepare(cores())
    size = (2048, 1_000_000) if context.cuda else (256, 5_000)
    case = CaseSpec(*size).make().to(context.device)
    our_row, panorama = peers.ours(case, _REPEATS)
    command = f"python -m benchmarks.rasterizer.peers --width {size[0]} --gaussians {size[1]}"
    content = {"rows": [asdict(our_row)]}
    alone = Outcome("skipped", commands=(command,), content=content, text=peers.table([our_row]))
    if not context.cuda:
        return replace(alone, reason=NO_CARD)
    context.save(alone)
    print("compiling gsplat's kernels, if that is not done", flush=True)
    try:
        rows = [our_row, peers.theirs(case, _REPEATS, panorama)]
    except DeviceError as error:
        return replace(alone, reason=str(error))
    content = {"rows": [asdict(row) for row in rows]}
    figure = " and ".join(
        f"{row.rasterizer} {row.cells()[peers.HEAD.index('Mpx/s')]:,.0f} Mpx/s" for row in rows
    )
    return Outcome("passed", figure, "", (command,), content, peers.table(rows))
