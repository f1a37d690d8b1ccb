"""Each rule as a function that returns its violations, one line each."""

import ast
import json
import re
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import grimp
import lizard

ROOT = Path(__file__).parents[2]
ROOMS = ("orchestrator", "prepare", "export", "workers", "renderer", "partition", "synthetic", "scene")
MAX_MODULES, MAX_LINES, MAX_FUNCTION, MIN_LINES = 15, 400, 60, 40  # modules per folder; the others in lines

CODE = (".py", ".js", ".css", ".html", ".cpp", ".h", ".cu", ".cuh")
TEXT = (*CODE, ".md", ".pyi", ".j2", ".toml", ".yaml", ".yml", ".sh", ".txt", ".env", ".ts")
# Words, then phrases that users read before a word of the trade replaced them.
DIALECT = re.compile(  # in small letters
    r"\b(?:told|tells|asks|asked|hears|nobody|whoever|somebody|beside|mend|(?:go|goes|went|going) on"
    r"|from afar|limits, honestly|last sign|a place is free|fewer will do|judge this|gradients added"
    r"|(?:above|below|from) the truth|its truth|above truth|there already; give)\b"
    r"|--most\b"  # an option's former name
)

# File -> the words it may use, each as often as it stands there, and the technical meaning.
ALLOWED_WORDS: dict[str, tuple[dict[str, int], str]] = {
    "orchestrator/cli/commands/doctor.py": ({"mend": 1}, "the former name of a key in JSON, kept"),
    "orchestrator/cli/results.py": ({"--most": 1}, "the former name of an option, kept"),
    "tests/orchestrator/cli/commands/test_view.py": ({"--most": 1}, "tests the former name"),
}


@cache
def tracked() -> tuple[Path, ...]:
    """Our files under version control, and those that git would add, as paths below the root."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    files = (Path(name) for name in sorted(set(names)))
    own = (file for file in files if "vendor" not in file.parts)
    return tuple(file for file in own if (ROOT / file).is_file())  # neither links to folders nor deleted ones


@cache
def text(file: Path) -> str:
    """What a tracked file contains."""
    return (ROOT / file).read_text()


@cache
def imports() -> grimp.ImportGraph:
    """Which module of the package imports which, those inside functions included."""
    return grimp.build_graph("panolog", cache_dir=None)


def module(file: Path) -> str:
    """The name under which a file of the package is imported."""
    parts = file.with_suffix("").parts
    return ".".join(("panolog", *(parts[:-1] if parts[-1] == "__init__" else parts)))


def _statements(file: Path) -> Iterator[ast.AST]:
    """All nodes of a Python file but expressions, which contain no statement and are most of the nodes."""
    waiting: list[ast.AST] = [ast.parse(text(file))]
    while waiting:
        node = waiting.pop()
        waiting += (it for it in ast.iter_child_nodes(node) if not isinstance(it, ast.expr))
        yield node


def full_folders() -> Iterator[str]:
    """Folders with more modules than a reader takes in at once; scripts of a page are modules as well."""
    modules = (file for file in tracked() if file.suffix in (".py", ".js") and file.name != "__init__.py")
    for folder, count in sorted(Counter(file.parent for file in modules).items()):
        if count > MAX_MODULES:
            yield f"{folder}: {count} modules"


def long_files() -> Iterator[str]:
    """Files longer than `MAX_LINES`."""
    for file in tracked():
        if file.suffix in CODE and (lines := len(text(file).splitlines())) > MAX_LINES:
            yield f"{file}: {lines} lines"


def long_functions() -> Iterator[str]:
    """Python functions longer than `MAX_FUNCTION` lines."""
    for file in tracked():
        if file.suffix == ".py" and _may_have_long_functions(text(file)):
            for node in _statements(file):
                if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                    lines = (node.end_lineno or node.lineno) - node.lineno + 1
                    if lines > MAX_FUNCTION:
                        yield f"{file}:{node.name}: {lines} lines"


def _may_have_long_functions(code: str) -> bool:
    """Whether, from a `def` on, the next one or decorator or class that is no deeper is far away."""
    open_: list[tuple[int, int]] = []  # indent and line of what has not ended
    for number, line in enumerate([*code.splitlines(), "class"]):
        bare = line.lstrip()
        if bare.startswith(("def ", "async def ", "class", "@")):
            indent = len(line) - len(bare)
            while open_ and open_[-1][0] >= indent:
                if number - open_.pop()[1] > MAX_FUNCTION:
                    return True
            open_.append((indent, number))
    return False


def long_functions_of_others() -> Iterator[str]:
    """Functions of C++ and JavaScript with more than `MAX_FUNCTION` lines of code, without inner ones."""
    for file in tracked():
        if file.suffix in (".cpp", ".h", ".cu", ".cuh", ".js"):
            name = str(file if file.suffix == ".js" else file.with_suffix(".cpp"))  # of a language it knows
            for function in lizard.analyze_file.analyze_source_code(name, text(file)).function_list:
                if function.nloc > MAX_FUNCTION:
                    yield f"{file}:{function.name}: {function.nloc} lines"


def small_modules() -> Iterator[str]:
    """Small modules with at most one importer whose docstring does not say why they are "separate"."""
    for file in tracked():
        if file.suffix != ".py" or file.parts[0] not in ROOMS or file.name in ("__init__.py", "__main__.py"):
            continue
        lines = len(text(file).splitlines())
        if lines < MIN_LINES and "separate" not in (ast.get_docstring(ast.parse(text(file))) or "").lower():
            importers = imports().find_modules_that_directly_import(module(file))
            if len(importers) <= 1:
                by = next(iter(importers), "no module").removeprefix("panolog.")
                yield f"{file}: {lines} lines, imported by {by} alone"


def import_circles() -> Iterator[str]:
    """Groups of modules in which each one reaches each other one; a package's `__init__` is one module."""
    graph = imports()
    reach = {name: graph.find_downstream_modules(name) for name in graph.modules}
    seen: set[str] = set()
    for name in sorted(graph.modules):
        circle = {other for other in reach[name] if name in reach[other]}
        if circle and name not in seen:
            seen |= circle | {name}
            yield " <-> ".join(sorted(circle | {name}))


def tests_of_benchmarks() -> Iterator[str]:
    """Tests outside of tests/benchmarks that import benchmarks: what both need belongs to tests/."""
    for file in tracked():
        of_tests = file.suffix == ".py" and file.parts[0] == "tests" and file.parts[1] != "benchmarks"
        if of_tests and "benchmarks" in text(file):
            for node in _statements(file):
                if isinstance(node, ast.Import):
                    names = [alias.name for alias in node.names]
                elif isinstance(node, ast.ImportFrom):
                    names = [node.module or ""]
                else:
                    continue
                if any(name.partition(".")[0] == "benchmarks" for name in names):
                    yield f"{file}:{node.lineno}: imports benchmarks"


def durations() -> Iterator[str]:
    """Entries of tests/durations.json that are not recorded, and files with tests of a system without one."""
    recorded = json.loads(text(Path("tests/durations.json")))
    for file, seconds in recorded.items():
        if not (ROOT / file).exists():
            yield f"{file}: is in tests/durations.json, and there is no such file"
        elif seconds == int(seconds):
            yield f"{file}: {seconds} s is not recorded: make test OPTIONS=--write-durations"
    tests = [file for file in tracked() if file.parts[0] == "tests" and file.match("test_*.py")]
    for path in (file for file in tests if str(file) not in recorded and "system" in text(file)):
        if any("system" in marks and "nightly" not in marks for marks in _marks(path)):
            yield f"{path}: has tests of a system, and no entry in tests/durations.json"


def mutants() -> Iterator[str]:
    """Entries of tests/mutants.json whose text is not once in their file, or whose tests are nowhere."""
    for mutant in json.loads(text(Path("tests/mutants.json"))):
        for file in [it for it in (mutant["file"], *mutant["tests"]) if not (ROOT / it).exists()]:
            yield f"tests/mutants.json: {mutant['why']}: there is no {file}"
        if (ROOT / mutant["file"]).exists() and text(Path(mutant["file"])).count(mutant["old"]) != 1:
            yield f"tests/mutants.json: {mutant['why']}: {mutant['file']} has not once {mutant['old']!r}"


def _marks(file: Path) -> Iterator[set[str]]:
    """The markers of each test of a file; those of a parameter alone do not count."""
    tree = ast.parse(text(file))
    common = [
        node.value
        for node in tree.body
        if isinstance(node, ast.Assign) and any(ast.unparse(it) == "pytestmark" for it in node.targets)
    ]
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
            marked = "\n".join(map(ast.unparse, [*common, *node.decorator_list]))
            marked = re.sub(r"marks=[^,)]*", "", marked)
            yield set(re.findall(r"pytest\.mark\.(\w+)", marked))


def dialect() -> Iterator[str]:
    """Words of private style where plain technical English has its own, outside of `ALLOWED_WORDS`."""
    for file in tracked():
        listed = str(file) == "tests/structure/rules.py"  # which has the words themselves
        if listed or not (file.suffix in TEXT or file.name in ("Makefile", "Dockerfile", "run")):
            continue
        allowed, _ = ALLOWED_WORDS.get(str(file), ({}, ""))
        small = text(file).lower()
        found = [(small.count("\n", 0, it.start()) + 1, it[0]) for it in DIALECT.finditer(small)]
        counts = Counter(word for _, word in found)
        yield from (f"{file}:{n}: {word}" for n, word in found if counts[word] > allowed.get(word, 0))
        yield from (
            f"{file}: fewer times '{word}' than allowed" for word in allowed if counts[word] < allowed[word]
        )


RULES: tuple[Callable[[], Iterator[str]], ...] = (
    full_folders,
    long_files,
    long_functions,
    long_functions_of_others,
    small_modules,
    import_circles,
    tests_of_benchmarks,
    durations,
    mutants,
    dialect,
)
