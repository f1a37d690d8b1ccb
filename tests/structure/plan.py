"""The plan of the packages as a picture: `python -m tests.structure.plan` writes docs/plan.svg."""

import ast
import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from html import escape

from tests.structure.rules import ROOT, imports

PICTURE = ROOT / "docs/plan.svg"
LAYERS = (
    ("orchestrator",),
    ("prepare", "export"),
    ("workers",),
    ("renderer", "partition", "synthetic"),
    ("scene",),
)
OPENED = ("orchestrator", "prepare", "workers")  # drawn with the packages inside

WIDTH, MARGIN, GAP, LANE = 520, 10, 34, 36  # pixels; the lane on the right is for arrows that skip a layer
NAME, TEXT = 17, 16  # pixels from line to line
FONT = "font-family='system-ui, sans-serif'"
Edges = frozenset[tuple[str, str]]


@dataclass(frozen=True)
class Box:
    """A package in the picture: the corner, width and height in pixels."""

    name: str
    x: float
    y: float
    w: float
    h: float


def packages(parent: str = "") -> list[str]:
    """Packages directly inside of another, as dotted names below panolog."""
    folder = ROOT / parent.replace(".", "/")
    prefix = f"{parent}." if parent else ""
    return sorted(f"{prefix}{file.parent.name}" for file in folder.glob("*/__init__.py"))


def purpose(package: str) -> str:
    """What the docstring of a package says in its first sentence, and the packages inside of it."""
    source = (ROOT / package.replace(".", "/") / "__init__.py").read_text()
    first = (ast.get_docstring(ast.parse(source)) or "").split("\n\n")[0].replace("\n", " ").split(". ")[0]
    inner = [name.rpartition(".")[2] for name in packages(package) if package not in OPENED]
    return first.rstrip(".") + (f" ({', '.join(inner)})" if inner else "")


def edges(names: Iterable[str]) -> Edges:
    """Which of the packages imports which, without the arrows that follow from others.

    Raises ValueError if packages import each other in a circle.
    """
    names = list(names)
    graph = imports()
    inside = {name: {f"panolog.{name}"} | graph.find_descendants(f"panolog.{name}") for name in names}
    owner = {module: name for name, modules in inside.items() for module in modules}
    found = {
        (name, owner[target])
        for name, modules in inside.items()
        for module in modules
        for target in graph.find_modules_directly_imported_by(module)
        if owner.get(target, name) != name
    }
    reach = {name: _reachable(name, found) for name in names}
    circle = sorted(name for name in names if name in reach[name])
    if circle:
        raise ValueError(f"packages import each other in a circle: {', '.join(circle)}")
    return frozenset((a, b) for a, b in found if not any((a, c) in found and b in reach[c] for c in names))


def _reachable(name: str, found: set[tuple[str, str]]) -> set[str]:
    seen: set[str] = set()
    waiting = [name]
    while waiting:
        new = {b for a, b in found if a == waiting[-1]} - seen
        waiting.pop()
        seen |= new
        waiting += new
    return seen


def rows(names: Iterable[str], arrows: Edges) -> list[list[str]]:
    """Packages in rows such that each arrow points downwards."""
    depth = dict.fromkeys(names, 0)
    for _ in depth:
        for a, b in arrows:
            depth[b] = max(depth[b], depth[a] + 1)
    return [sorted(name for name in depth if depth[name] == row) for row in range(max(depth.values()) + 1)]


def _lines(text: str, width: float) -> list[str]:
    return textwrap.wrap(text, int(width / 7.2))


def _height(name: str, width: float) -> float:
    return NAME + 14 + TEXT * len(_lines(purpose(name), width - 16))


def _text(box: Box, *, opened: bool = False) -> str:
    """Name and purpose of a package; of an opened one the parent's name is left out."""
    label = box.name.rpartition(".")[2] + "/"
    x, y = box.x + 8, box.y + NAME + 3
    parts = [f"<text x='{x:g}' y='{y:g}' class='name'>{escape(label)}</text>"]
    for n, line in enumerate(_lines(purpose(box.name), box.w - 16), 1):
        parts.append(f"<text x='{x:g}' y='{y + n * TEXT:g}' class='text'>{escape(line)}</text>")
    kind = "room" if opened else "box"
    rectangle = (
        f"<rect x='{box.x:g}' y='{box.y:g}' width='{box.w:g}' height='{box.h:g}' rx='6' class='{kind}'/>"
    )
    return "\n".join([rectangle, *parts])


def _place(lines: list[list[str]], x: float, y: float, w: float, arrows: Edges) -> dict[str, Box]:
    """Boxes for rows of packages: one that is alone in the first or last row takes all of the width."""
    boxes: dict[str, Box] = {}
    columns = max(map(len, lines))
    for row, names in enumerate(lines):
        whole = (len(names) == 1 and row in (0, len(lines) - 1)) or columns == 1
        width = w if whole else (w - (columns - 1) * MARGIN) / columns
        height = max(_height(name, width) for name in names)
        free = columns - len(names)
        for column, name in enumerate(names):
            above = [boxes[a].x for a, b in arrows if b == name and a in boxes]
            shift = 0.0 if whole or not free else _shift(above, x, width, free, len(names))
            boxes[name] = Box(name, x + (column + shift) * (width + MARGIN), y, width, height)
        y += height + GAP
    return boxes


def _shift(above: list[float], x: float, width: float, free: int, count: int) -> float:
    """By how many columns a row that is not full moves to the right: below what imports it."""
    if count > 1 or not above:
        return free / 2
    return min(free, max(0.0, (sum(above) / len(above) - x) / (width + MARGIN)))


def _arrow(a: Box, b: Box) -> str:
    """From the lower edge of a box to the upper edge of another, straight down where possible."""
    left, right = max(a.x, b.x) + 12, min(a.x + a.w, b.x + b.w) - 12
    if left <= right:
        start = end = (left + right) / 2
    else:
        start = min(max(b.x + b.w / 2, a.x + 12), a.x + a.w - 12)
        end = min(max(start, b.x + 12), b.x + b.w - 12)
    return f"<path d='M{start:g} {a.y + a.h:g} L{end:g} {b.y - 2:g}' class='arrow'/>"


def _between_rows(box: Box, a: Box, b: Box) -> bool:
    """Whether a box is in the way of an arrow."""
    return (
        a.y + a.h <= box.y < b.y - box.h
        and box.x < min(a.x + a.w, b.x + b.w)
        and box.x + box.w > max(a.x, b.x)
    )


def _around(a: Box, b: Box, x: float, shift: float = 0) -> str:
    """An arrow along a lane at x, for a package several rows below; `shift` keeps two tips apart."""
    start, end = a.y + a.h / 2, b.y + b.h / 2 + shift
    return f"<path d='M{a.x + a.w:g} {start:g} H{x:g} V{end:g} H{b.x + b.w + 2:g}' class='arrow'/>"


def _room(name: str, y: float, w: float) -> tuple[Box, str]:
    """An opened package with the packages inside, and its drawing."""
    inner = packages(name)
    head = _height(name, w)
    arrows = edges(inner)
    boxes = _place(rows(inner, arrows), MARGIN + 10, y + head + 4, w - 36, arrows)
    bottom = max(box.y + box.h for box in boxes.values())
    room = Box(name, MARGIN, y, w, bottom + 10 - y)
    drawn = [_text(room, opened=True), *map(_text, boxes.values())]
    for a, b in sorted(arrows):
        blocked = any(_between_rows(box, boxes[a], boxes[b]) for box in boxes.values())
        drawn.append(_around(boxes[a], boxes[b], w - 6) if blocked else _arrow(boxes[a], boxes[b]))
    return room, "\n".join(drawn)


def picture() -> str:
    """The plan as SVG: packages by layers, an arrow from each to what it imports."""
    w = WIDTH - MARGIN - LANE
    boxes: dict[str, Box] = {}
    drawn: list[str] = []
    y: float = MARGIN
    for layer in LAYERS:
        if layer[0] in OPENED:
            boxes[layer[0]], room = _room(layer[0], y, w)
            drawn.append(room)
        else:
            new = _place([list(layer)], MARGIN, y, w, frozenset())
            drawn += map(_text, new.values())
            boxes |= new
        y = max(box.y + box.h for box in boxes.values()) + GAP
    drawn += _between(boxes)
    height = y - GAP + MARGIN
    return _document(height, drawn)


def _between(boxes: Mapping[str, Box]) -> list[str]:
    """The arrows between top-level packages; those that skip a layer have a lane for each source."""
    layer = {name: number for number, names in enumerate(LAYERS) for name in names}
    arrows = sorted(edges(boxes))
    far = [(a, b) for a, b in arrows if layer[b] > layer[a] + 1]
    lanes = {a: number for number, a in enumerate(sorted({a for a, _ in far}, key=lambda a: -layer[a]))}
    near = [_arrow(boxes[a], boxes[b]) for a, b in arrows if (a, b) not in far]
    x = WIDTH - LANE + 8
    return near + [_around(boxes[a], boxes[b], x + 12 * lanes[a], 8 * lanes[a]) for a, b in far]


def _document(height: float, drawn: list[str]) -> str:
    return "\n".join(
        [
            f"<svg xmlns='http://www.w3.org/2000/svg' viewBox='0 0 {WIDTH} {height:g}' {FONT}>",
            "<style>rect{stroke:#5b6b7b} .room{fill:#eef3f8} .box{fill:#ffffff} .name{font-size:15px;"
            "font-weight:600;fill:#12202e} .text{font-size:12.5px;fill:#37475a}"
            " .arrow{fill:none;stroke:#1f6fb2;stroke-width:1.6;marker-end:url(#tip)}</style>",
            "<defs><marker id='tip' viewBox='0 0 8 8' refX='7' refY='4' markerWidth='7' markerHeight='7'"
            " orient='auto'><path d='M0 0 L8 4 L0 8 z' fill='#1f6fb2'/></marker></defs>",
            f"<rect width='{WIDTH}' height='{height:g}' style='fill:#ffffff;stroke:none'/>",
            *drawn,
            "</svg>\n",
        ]
    )


if __name__ == "__main__":
    PICTURE.write_text(picture())
