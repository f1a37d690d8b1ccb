"""`panolog doctor SCENE`: what a job needs. A module of its own: it cannot be imported without the core."""

from panolog.orchestrator.commands.doctor import Finding
from panolog.orchestrator.resources.preflight import Preflight, machine_line, stage_line, time_of
from panolog.orchestrator.run.units import gib
from panolog.orchestrator.views.summary import STAGES
from panolog.scene.model import Scene


def examine_job(scene: Scene, preflight: Preflight) -> list[Finding]:
    """What a job needs, stage by stage, and whether the machines will do."""
    held_out = f"{len(scene.train)} to train on, {len(scene.test)} held out"
    stages = preflight.estimate.stages
    cuda = preflight.config.device == "cuda"
    task = max(stages, key=lambda stage: stage.device if cuda else stage.host)
    need = gib(task.device if cuda else task.host)
    findings = [
        Finding("scene", f"{len(scene.panoramas)} panoramas {scene.width}x{scene.height}, {held_out}"),
        Finding("sparse points", f"{len(scene.points):,}"),
        *(Finding(f"machine {node.host}", machine_line(node)) for node in preflight.nodes),
        Finding("blocks", preflight.config.blocks),
        *(Finding(STAGES[stage.name], stage_line(stage)) for stage in stages),
        Finding("Gaussians, roughly", f"{stages[0].gaussians:,} after Stage I, sky included"),
        Finding(f"{'GPU ' * cuda}memory of the job", f"about {need} for one task"),
        Finding(
            "disk of the job", f"about {gib(preflight.estimate.disk)} of {gib(preflight.free)} free here"
        ),
        Finding("time of the job", time_of(preflight.estimate.seconds)),
    ]
    if preflight.problem:
        findings.append(Finding("the job", "does not fit", ok=False, fatal=True, mend=preflight.problem))
    return findings
