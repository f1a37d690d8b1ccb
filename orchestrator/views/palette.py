"""The colours of blocks, for plan.png, maps and curves alike.

None of them reads as a state: no red (failed), green (done), amber (paused), nor the blue of what is running.
"""

import colorsys

import numpy as np

# At least 19 apart in CIELAB also for the red-blind and the green-blind (Machado et al. 2009), and with at
# least 3:1 to white and to near black. The first ones differ most.
BLOCK_COLORS = (
    "#6c3cfc", "#309c9c", "#b400c0", "#849048", "#a884cc", "#3c6c90", "#786c60", "#9078fc",
)  # fmt: skip
_HUES = ((175, 200), (250, 325))  # degrees, of more blocks: teal, and violet to magenta
_LUMINANCES = (0.15, 0.27)  # of these, in turn


def block_color(block: int, count: int) -> str:
    """The colour of one of `count` blocks: one of the eight, or of more a hue far from its neighbours'."""
    if count <= len(BLOCK_COLORS):
        return BLOCK_COLORS[block]
    (first, gap), (after, last) = _HUES
    hue = first + (gap - first + last - after) * (block * 0.618034 % 1)
    hue += after - gap if hue > gap else 0
    linear = np.array(colorsys.hls_to_rgb(hue / 360, 0.5, 0.55)) ** 2.2
    scale = _LUMINANCES[block % 2] / (linear @ [0.2126, 0.7152, 0.0722])
    red, green, blue = (255 * np.minimum(linear * scale, 1) ** (1 / 2.2)).round().astype(int)
    return f"#{red:02x}{green:02x}{blue:02x}"
