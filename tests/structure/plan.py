"""The plan of the packages as a picture: `python -m tests.structure.plan` writes docs/plan.svg."""

import ast
import textwrap
from collections.abc import Iterable
from html import escape

from tests.structure.rules import ROOMS, ROOT, imports

PICTURE = ROOT / "docs/plan.svg"
OPENED = ("orchestrator", "prepare", "workers")  # drawn with the packages inside
WIDTH, MARGIN, GAP = 520, 10, 12  # pixels
NAME, TEXT, LETTER = 17, 16, 7.2  # pixels from line to line, and of a letter
STYLE = (
    "rect{stroke:#5b6b7b} .room{fill:#eef3f8} .box{fill:#ffffff} .name{font-size:15px;font-weight:600;"
    "fill:#12202e} .text{font-size:12.5px;fill:#37475a}"
)


def packages(parent: str) -> list[str]:
    """Packages directly inside of another, as dotted names below panolog."""
    folder = ROOT / parent.replace(".", "/")
    return sorted(f"{parent}.{file.parent.name}" for file in folder.glob("*/__init__.py"))


def purpose(package: str) -> str:
    """What the docstring of a package says in its first sentence, and the packages inside of it."""
    source = (ROOT / package.replace(".", "/") / "__init__.py").read_text()
    first = (ast.get_docstring(ast.parse(source)) or "").split("\n\n")[0].replace("\n", " ").split(". ")[0]
    inner = [name.rpartition(".")[2] for name in packages(package) if package not in OPENED]
    return first.rstrip(".") + (f" ({', '.join(inner)})" if inner else "")


def rows(names: Iterable[str]) -> list[list[str]]:
    """Packages in rows such that each imports only packages of rows below its own. ValueError for circles."""
    graph, depth = imports(), dict.fromkeys(names, 0)
    inside = {name: {f"panolog.{name}"} | graph.find_descendants(f"panolog.{name}") for name in depth}
    owner = {module: name for name, modules in inside.items() for module in modules}
    pairs = {
        (name, owner[target])
        for name, modules in inside.items()
        for module in modules
        for target in graph.find_modules_directly_imported_by(module)
        if owner.get(target, name) != name
    }
    for _ in depth:  # as often as the longest way down can have steps
        for above, below in pairs:
            depth[below] = max(depth[below], depth[above] + 1)
    if circle := sorted(pair for pair in pairs if depth[pair[0]] >= depth[pair[1]]):
        raise ValueError(f"packages import each other: {circle}")
    return [sorted(name for name in depth if depth[name] == row) for row in range(max(depth.values()) + 1)]


def _box(name: str, x: float, y: float, w: float, height: float = 0.0) -> tuple[float, list[str]]:
    """A package with its purpose, at least so high. Returns its lower edge, and its drawing."""
    lines = textwrap.wrap(purpose(name), int((w - 16) / LETTER))
    parts = [f"<text x='{x + 8:g}' y='{y + NAME + 3:g}' class='name'>{name.rpartition('.')[2]}/</text>"]
    for n, line in enumerate(lines, 1):
        at = y + NAME + 3 + n * TEXT
        parts.append(f"<text x='{x + 8:g}' y='{at:g}' class='text'>{escape(line)}</text>")
    bottom = y + NAME + 14 + TEXT * len(lines)
    if name in OPENED:
        bottom, inner = _stack(packages(name), x + GAP, bottom, w - 2 * GAP)
        parts += inner
        bottom += GAP
    bottom = max(bottom, y + height)
    kind, size = "room" if name in OPENED else "box", f"width='{w:g}' height='{bottom - y:g}'"
    return bottom, [f"<rect x='{x:g}' y='{y:g}' {size} rx='6' class='{kind}'/>", *parts]


def _stack(names: Iterable[str], x: float, y: float, w: float) -> tuple[float, list[str]]:
    """Packages row by row; opened ones have the whole width. Returns the lower edge, and the drawing."""
    parts: list[str] = []
    for row in rows(names):
        closed = [name for name in row if name not in OPENED]
        for line in [*([name] for name in row if name in OPENED), *([closed] if closed else [])]:
            width = (w - (len(line) - 1) * GAP) / len(line)
            bottom = max(_box(name, x, y, width)[0] for name in line)
            for column, name in enumerate(line):
                parts += _box(name, x + column * (width + GAP), y, width, bottom - y)[1]
            y = bottom + GAP
    return y - GAP, parts


def picture() -> str:
    """The plan as SVG."""
    bottom, drawn = _stack(ROOMS, MARGIN, MARGIN, WIDTH - 2 * MARGIN)
    size = f"viewBox='0 0 {WIDTH} {bottom + MARGIN:g}' font-family='system-ui, sans-serif'"
    white = f"<rect width='{WIDTH}' height='{bottom + MARGIN:g}' style='fill:#ffffff;stroke:none'/>"
    head = f"<svg xmlns='http://www.w3.org/2000/svg' {size}>"
    return "\n".join([head, f"<style>{STYLE}</style>", white, *drawn, "</svg>\n"])


if __name__ == "__main__":
    PICTURE.write_text(picture())
