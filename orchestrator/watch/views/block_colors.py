"""The colours of blocks, for plan.png, maps and curves alike.

None of them reads as a state: no red (failed), green (done), amber (paused), nor the blue of what is running.
"""

# At least 19 apart in CIELAB also for the red-blind and the green-blind (Machado et al. 2009), and with at
# least 3:1 to white and to near black. The first ones differ most.
BLOCK_COLORS = (
    "#6c3cfc", "#309c9c", "#b400c0", "#849048", "#a884cc", "#3c6c90", "#786c60", "#9078fc",
)  # fmt: skip


def block_color(block: int) -> str:
    """The colour of a block: one of the eight; neighbours in a grid have different ones up to six across."""
    return BLOCK_COLORS[(block + block // len(BLOCK_COLORS)) % len(BLOCK_COLORS)]


# From which seam on a face between blocks has which colour on maps, in light and dark.
SEAM_GRADES = {"hardly": (0.0, "#2a9d5c"), "some": (1.5, "#d98a1f"), "clear": (3.0, "#d6453d")}


def seam_grade(seam: float) -> str:
    """The last of `SEAM_GRADES` that a seam reaches."""
    return next(name for name, (least, _) in reversed(SEAM_GRADES.items()) if seam >= least)
