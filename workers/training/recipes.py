"""Recipes: presets of ordinary settings. A run's own settings win over those of its recipe.

`paper` is the paper to the letter, and 3DGS where it is silent: the defaults of all settings. `panolog`
changes what has proven better; `python -m benchmarks.paper` measures each change alone and with the rest.
They are separate from the settings because they cover those of the whole run.
"""

from collections.abc import Mapping
from typing import Any, Literal

Recipe = Literal["paper", "panolog"]

RECIPES: Mapping[Recipe, Mapping[str, Any]] = {  # by dotted key
    "paper": {},
    "panolog": {
        "partition.tau_grad": 0.1,
        "optimizer.short_runs": 0.5,  # a short run at the rates of a long one ends before shapes arrive
        "reset.recovery": 100,  # as a full run has: pruned is what stays transparent, not what is slow
    },
}
