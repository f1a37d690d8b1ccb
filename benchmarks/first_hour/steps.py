"""The steps in the order of their importance, with their shares of the time."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Step:
    """One step."""

    what: str
    share: float  # of the time, relative to the others; what a step leaves over, the later ones share
    module: str  # in benchmarks.first_hour
    function: str  # of the module: takes a Context, returns an Outcome
    card: bool = False  # whether nothing of it can run without one


STEPS = {
    "machine": Step("the card, its driver and the software", 6, "machine", "find"),
    "tests": Step("the tests that need a card", 16, "suites", "tests"),
    "memcheck": Step("compute-sanitizer: accesses out of bounds", 8, "sanitizer", "check", card=True),
    "racecheck": Step("compute-sanitizer: races in shared memory", 8, "sanitizer", "check", card=True),
    "synccheck": Step("compute-sanitizer: barriers", 5, "sanitizer", "check", card=True),
    "initcheck": Step(
        "compute-sanitizer: reads of what was never written", 5, "sanitizer", "check", card=True
    ),
    "waits": Step("waits for the card and host time of an iteration", 4, "waits", "count"),
    "memory": Step("memory of a training step against its estimate", 5, "memory", "compare"),
    "performance": Step("a training iteration and its parts", 12, "speed", "iterations"),
    "kernels": Step("each kernel, and what the model of cards expects", 4, "speed", "kernels", card=True),
    "demo": Step("the demo's town, trained on card and CPU", 15, "quality", "demo"),
    "scene": Step("a scene, trained on the card", 10, "quality", "scene"),
    "gsplat": Step("gsplat on the same Gaussians", 8, "speed", "gsplat"),
}


def limit(names: list[str], seconds: float) -> float:
    """Seconds that the first of the steps may take, if so many are left for all of them."""
    return seconds * STEPS[names[0]].share / sum(STEPS[name].share for name in names)
