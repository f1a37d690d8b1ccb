"""Kernels broken on purpose: each of them has to be found.

Made from the sources by patterns. One that no longer matches fails: when a kernel changes, so do its mutants.
"""

import functools
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from panolog.renderer.cuda.nvrtc import CSRC
from tests.renderer.cuda.emulation.build import included

MODULES = tuple(path.stem for path in sorted((CSRC / "cuda").glob("*.cu")))
HANG = "threads wait for others that never come|meets"
LOST = "out of bounds|race"  # whichever is met first
UNSET = "uninitialised"
BARRIER = f"race|{UNSET}|{HANG}"
SOURCES = "cuda/*.cu*"  # with headers
VALUES = ""  # no access is wrong, the results are


@dataclass(frozen=True)
class Pattern:
    """How a source is broken: one mutant for each match."""

    name: str
    pattern: str  # regular expression
    instead: str
    found: str = (
        VALUES  # regular expression of the report; VALUES: at least the results differ from the CPU's
    )
    files: str = "cuda/*.cu"


PATTERNS = (
    Pattern("no barrier", r"__syncthreads\(\);", ";", BARRIER),
    Pattern("no barrier in a vote", r"__syncthreads_or\(([^()]+)\)", r"((\1) || true)", BARRIER),
    Pattern("no atomic sum", r"atomicAdd\((.+), (\w+)\);", r"*(\1) += \2;", "race"),
    Pattern("no atomic bits", r"atomicOr\((.+), (\w+)\);", r"*(\1) |= \2;", "race"),
    Pattern(
        "a part of a warp", r"(?<=kAllLanes = 0x)ffffffff", "7fffffff", "not for all lanes", "cuda/*.cuh"
    ),
    # bounds of threads
    Pattern("one too many", r"if \((i|threadIdx\.x) >= (count|kCount)\b", r"if (\1 > \2", LOST),
    Pattern("no bound among others", r"i >= count \|\| ", "", LOST),
    Pattern("a step after a fault", r"if \(\*status\) return;|(?<=count \|\| )\*status \|\|", "", VALUES),
    Pattern("no only thread", r"if \(threadIdx\.x\) return;", "", "race"),
    # projection
    Pattern("a float too many", r"(i|k) < floats\b", r"\1 <= floats", LOST),
    Pattern("a block is always full", r"\(count - begin < kSpan \? count - begin : kSpan\)", "(kSpan)", LOST),
    Pattern("a float less in shared memory", r"\[kSpan \* kRest\]", "[kSpan * kRest - 1]", "out of bounds"),
    Pattern(
        "the next thread's row", r"(?<=rest \+ kRest \* )threadIdx\.x", "(threadIdx.x + 1)", f"{LOST}|{UNSET}"
    ),
    Pattern("rows that keep what was there", r"own\[k\] = 0;", ";", VALUES),
    Pattern("no bound in a condition", r"\bi < count && (?=tile_counts)", "", LOST),
    Pattern("no bound of the rest", r"else if \(i < count\)", "else", LOST),
    Pattern("no bound of a row", r"if \(i < count\) (?=take_row)", "", LOST),
    Pattern("an output without a value", r"seen\.screen\[2 \* i\] = (?=seen\.screen)", "", VALUES),
    Pattern("a count without a value", r"(?=out\.tile_counts\[i\] = met;)", "if (met) ", VALUES),
    Pattern("rays without values", r"rays\[i\] = ray;", "", VALUES),
    Pattern("tiles of the box", r"(count \+=|mine = .+ &&) may_meet_tile\(.+\);", r"\1 true;", VALUES),
    # a step of Adam
    Pattern("values that should stay", r"if \(at >= p\.count\) return;", "", files=SOURCES),
    Pattern("a moment that stays", r"p\.exp_avg\[at\] = m, |, p\.exp_avg_sq\[at\] = s", "", files=SOURCES),
    Pattern("the unit of another row", r"(?<=p\.units\[)row", "0", files=SOURCES),
    Pattern("the row of a block", r"begin \+ k / kRest", "begin"),
    Pattern("another parameter", r"kBrokenGradient << k", "kBrokenGradient"),
    Pattern("a fault that stays", r", \*broken = 0", ""),
    # motion
    Pattern("a row of motion too many", r"n < here \* kMotion", "n <= here * kMotion", LOST),
    Pattern("a thread without a part", r"if \(part < kMotionParts\) (?=parts)", "", LOST),
    Pattern("the rows of another part", r"row = part;", "row = 0;"),
    Pattern("another product", r"j \+= i;", ""),
    Pattern("no only thread for a sum", r"if \(threadIdx\.x >= kMotionSums\) return;", "", LOST),
    Pattern("a sum that continues", r"(?<=  )total = 0;", ""),
    Pattern("motion that keeps what was there", r"seen\.motion\[kMotion \* i \+ k\] = 0;", ";", f"{UNSET}"),
    # lists of tiles
    Pattern("one past its pairs", r"(tiles|rows)\[(at \+ k|to)\] =", r"\1[\2 + 1] =", LOST),
    Pattern("a pair too many", r"k < run\.count", "k <= run.count", LOST),
    Pattern("one more than there is room", r"(at \+ k|to) < room", r"\1 <= room", "out of bounds"),
    Pattern("lanes that share tiles", r"(?<=room; )k \+= kLanes", "k += 1", "race"),
    Pattern("lanes that test the same tiles", r"(?<=box\.count\); )k \+= kLanes", "k += 1", VALUES),
    Pattern("a lane without a splat", r"if \(i < count\) \{", "{", LOST),
    Pattern("the votes of other splats", r" >> shift & ", " & ", VALUES),
    Pattern("lanes in one place", r"__popc\(met & \(\(1u << lane\) - 1\)\)", "0", "race"),
    Pattern("rows of tiles in one place", r"at \+= run\.count;", "", VALUES),
    # compositing
    Pattern("always a full batch", r"min\(left, kTilePixels\)", "kTilePixels", LOST),
    Pattern("an entry too many", r"thread < count &&", "thread <= count &&", "out of bounds"),
    Pattern("splats that are not there", r"first \+ lane < count &&", "", UNSET),
    Pattern("the next splat", r"(?<=__ffs\(int\(met\)\)) - 1", "", VALUES),
    Pattern("lanes that leave", r"!__any_sync\(kAllLanes, (pair[^;]+)\)\)", r"!(\1))", HANG),
    Pattern("threads that leave", r"(?=float t = pixel\.at >= 0)", "if (pixel.at < 0) return; ", HANG),
    Pattern("no bound of the image", r"if \(pixel\.at < 0\) return;", "", LOST),
    Pattern("the end of the next tile", r"starts\[tile \+ 1\]", "starts[tile + 2]", LOST),
    Pattern("the next channel", r"color\[3 \* pixel\.at \+ 2\]", "color[3 * pixel.at + 3]", LOST),
    Pattern("a column too many", r"column < (tile\.)?width &&", r"column <= \1width &&", LOST, SOURCES),
    Pattern("a row too many", r"row < (tile\.)?height \?", r"row <= \1height ?", LOST, SOURCES),
    Pattern(
        "the edge of a pixel",
        r"across\[int\(2 \* pixel\.x\)\]",
        "across[int(2 * pixel.x) + 1]",
        files="cuda/views.cuh",
    ),
    Pattern(
        "the middle of another patch",
        r"\[int\(patch\.top \+ patch\.bottom\)",
        r"\g<0> + 16",
        files="cuda/views.cuh",
    ),
    # an exterior
    Pattern("tiles that are not active", r"exterior\.places\[tile\] >= 0 && ", ""),
    Pattern("what is frozen anywhere", r"\(span\[0\] <= distance && distance <= span\[1\]\)", "true"),
    Pattern("what is frozen never", r"\(span\[0\] <= distance && distance <= span\[1\]\)", "false"),
    Pattern("the exterior in other rows", r"(?<!depth)\[own \+ i\] =", "[i] =", f"{LOST}|{UNSET}"),
    Pattern("the exterior at no distance", r"depth\[own \+ i\] =", "depth[i] ="),
    Pattern("sums of what is frozen", r"if \(s\.row >= own\) return;", "", LOST),
    Pattern("the transmittance of no front", r"front\.transmittance", "1.0f"),
    Pattern("no front in the gradient", r" - front\.\w+\)", ")"),
    Pattern("an alpha without the front", r" - \(1 - t\)\)", ")"),
    Pattern("no front", r"= front\.(r|g|b|inverse_depth)\b", "= 0"),
    Pattern("no back", r"t \* back\.\w+", "t"),
    Pattern("another layer", r"int64_t\(place\) \*", "int64_t(0) *"),
    Pattern("another plane", r"at\[4 \* kTilePixels\]", "at[3 * kTilePixels]"),
    # weights
    Pattern("an entry of the first batch", r"begin \+ place\)", "place)"),
    Pattern("weights where no span is", r"if \(span\[0\] > span\[1\]\) return;", ""),
    Pattern("weights outside of the image", r"view\.pixel\.at >= 0 \? 1\.0f : 0\.0f", "1.0f"),
    # losses
    Pattern("a halo too narrow", r"(?<=kSide = kTile \+ 2 \* kRadius)", " - 1", VALUES),
    Pattern("one past a loop", r"i < (kHalo|kLine)\b", r"i <= \1", "out of bounds"),
    Pattern("one less in a loop", r"i < (kHalo|kLine)\b", r"i < \1 - 1", UNSET),
    Pattern("a turn too few", r"turn < kTurns", "turn < kTurns - 1", VALUES),
    Pattern("one less in shared memory", r"\[(kHalo|kLine)\]", r"[\1 - 1]", "out of bounds"),
    Pattern("one warp too many", r"warp < kWarps", "warp <= kWarps", "out of bounds"),
    Pattern("beyond the lower pole", r"row >= height \?", "row > height ?", LOST),
    Pattern("no seam", r"while \(column (<|>=) \w+\) column .= width;", "", VALUES),
    Pattern("pixels outside", r"if \(pixel < 0\) continue;", "", LOST),
    Pattern(
        "threads that skip barriers",
        r"(channel < 3; \+\+channel\) \{)",
        r"\1 if (pixel < 0) continue;",
        BARRIER,
    ),
    Pattern("masked beyond the poles", r"at >= 0 && (?=masked)", "", LOST),
    Pattern("a mask's pixel outside", r"pixel >= 0 && (?=!masked)", "", LOST),
    Pattern("windows that keep their weight", r"if \(mask\) means\[m\] \*= rest;", ";", VALUES),
    Pattern("derivatives of another window", r"weight \* rest", "weight", VALUES),
    Pattern("samples under a mask", r"if \(masked\(in, pixel\)\) return \{0, 0, 0\};", "", VALUES),
    Pattern("no exposure", r"if \(!in\.exposure\) return", "return", VALUES),
    Pattern("another channel's exposure", r"in\.exposure\[channel\]", "in.exposure[0]", VALUES),
    Pattern("a gradient without its exposure", r"s\.slope \* sum", "sum", VALUES),
    Pattern("saturated samples that count", r" \|\| sample_of\.y >= 1", "", VALUES),
    Pattern("sums of pixels outside", r"if \(used\)(?=\s+for)", "", LOST),
    Pattern("the next row's weight", r"rows\[pixel / width\]", "rows[pixel / width + 1]", LOST),
    Pattern("no weight of a row", r"row \* (fabsf|found)", r"\1", VALUES),
    Pattern("a gradient without its weight", r" \* row(_weight\(.*\))?;", ";", VALUES),
    Pattern("samples outside", r"i < pixels && ", "", LOST),
    Pattern("a sum that begins with anything", r"(double total|float sum|depth) = 0;", r"\1;", VALUES),
    Pattern("another lane's sum", r"threadIdx\.x % kWarp == 0", "threadIdx.x % kWarp == 1", VALUES),
)


@dataclass(frozen=True)
class Mutant:
    """One change of one source."""

    name: str
    pattern: Pattern
    file: Path  # below csrc
    start: int
    end: int
    text: str

    def write(self, folder: Path) -> Path:
        """The sources with this change, without the kernels that lack it; returns the folder of the kernels.

        A compiler would spend most of its time on the others.
        """
        shutil.copytree(CSRC, folder, ignore=shutil.ignore_patterns("*.cpp"))
        source = (folder / self.file).read_text()
        (folder / self.file).write_text(source[: self.start] + self.text + source[self.end :])
        for module in self.modules():
            path = folder / "cuda" / f"{module}.cu"
            path.write_text(_only(self.kernels, path.read_text()))
        return folder / "cuda"

    @functools.cached_property
    def kernels(self) -> frozenset[str]:
        """Those that may have the change: of a header or of no function, all of its modules."""
        sources = {module: (CSRC / "cuda" / f"{module}.cu").read_text() for module in self.modules()}
        source = (CSRC / self.file).read_text()
        function = _function(source[: self.start]) if _inside(source[: self.start]) else ""
        if self.file.suffix != ".cu" or not function:
            return frozenset(name for source in sources.values() for name in _KERNEL.findall(source))
        return frozenset(_KERNEL.findall(source)) & _callers(function, source)

    def modules(self) -> tuple[str, ...]:
        """In which it may be found: for a header in all that include it."""
        return tuple(module for module in MODULES if CSRC / self.file in _files(module))


@functools.cache
def _files(module: str) -> frozenset[Path]:
    """The source of a module and all that it includes."""
    return frozenset(included(CSRC / "cuda" / f"{module}.cu", (CSRC,)))


def mutants(pattern: Pattern) -> Iterator[Mutant]:
    """One for each match, with names from the functions that they are in."""
    names: list[str] = []
    for path in sorted(CSRC.glob(pattern.files)):
        source = path.read_text()
        for match in re.finditer(pattern.pattern, source):
            where = f"{_function(source[: match.start()]) or path.stem}, {pattern.name}"
            names.append(where)
            name = where if names.count(where) == 1 else f"{where} {names.count(where)}"
            text = match.expand(pattern.instead)
            yield Mutant(name, pattern, path.relative_to(CSRC), match.start(), match.end(), text)


_KERNEL = re.compile(r"__launch_bounds__\(\d+\)\s+(\w+)\(")
_FUNCTION = re.compile(r"(?:__launch_bounds__\(\d+\)|__forceinline__ [\w<>]+)\s+(\w+)\(")
_END = re.compile(r"^\}", re.MULTILINE)  # of a function or a struct


def _function(before: str) -> str:
    """The last function that begins in a source."""
    found = _FUNCTION.findall(before)
    return found[-1] if found else ""


def _inside(before: str) -> bool:
    """Whether a source that is cut here is cut in a function, and not between two."""
    return _FUNCTION.search(_END.split(before)[-1]) is not None


def _callers(function: str, source: str) -> set[str]:
    """The functions of a source that name this one, or another that does; and itself."""
    found, parts = {function}, [(_function(part), part) for part in _END.split(source)]
    for _ in parts:
        found |= {name for name, part in parts if name and found & set(re.findall(r"\w+", part))}
    return found


def _only(kernels: frozenset[str], source: str) -> str:
    """A source in which the other kernels are templates without an instance: they are not compiled."""

    def head(match: re.Match[str]) -> str:
        return match[0] if match[1] in kernels else f"template <int> void\n    {match[1]}("

    return re.sub(r'extern "C" __global__ void ' + _KERNEL.pattern, head, source)
