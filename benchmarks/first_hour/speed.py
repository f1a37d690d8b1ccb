"""The speed of an iteration, and of gsplat on the same Gaussians."""

from dataclasses import asdict, replace
from pathlib import Path

import torch

from benchmarks import performance
from benchmarks.first_hour.outcome import NO_CARD, ROOT, Context, Outcome, shown
from benchmarks.rasterizer import peers, roofline
from benchmarks.rasterizer.cases import CaseSpec
from benchmarks.rasterizer.rows import Row, tables
from panolog.orchestrator.runs.machines.machine import cores
from panolog.renderer.process import prepare
from panolog.scene.errors import DeviceError
from panolog.scene.files import write_bytes

PAGE = "performance-cuda.md"
_SHARE = 0.6  # of a step's time, after which no further row is begun: a row of a million takes long
_REPEATS = 10


def iterations(context: Context) -> Outcome:
    """`benchmarks.performance`, as many rows as there is time for; on a card its page is in docs/ too."""
    prepare(cores())
    trained = ["--scene", context.scene, "--model", context.model] if context.scene and context.model else []
    output = f"docs/{PAGE}" if context.cuda else context.work / PAGE
    options = ["--device", context.device, *trained, *["--quick"] * (not context.cuda), "-o", str(output)]
    command = shown(["python", "-m", "benchmarks.performance", *options])
    rows: list[Row] = []
    outcome = Outcome("failed", reason="no row was measured")
    scene, model = map(Path, trained[1::2]) if trained else (None, None)
    limit = _SHARE * context.seconds
    for row in performance.measure(scene, model, context.device, quick=not context.cuda, seconds=limit):
        rows.append(row)
        content = {"rows": [each.content() for each in rows]}
        outcome = Outcome("passed", _figure(rows[0]), "", (command,), content, tables(rows))
        context.save(outcome)
    page = performance.page(rows).encode()
    write_bytes(context.work / PAGE, page)
    if context.cuda:
        write_bytes(ROOT / "docs" / PAGE, page)
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
