"""What a PTX program says: kernels with their parameters, variables, registers and instructions.

All that is not known is an error with its text.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field

BYTES = {"pred": 1} | {f"{kind}{bits}": bits // 8 for bits in (8, 16, 32, 64) for kind in "bsuf"}
EVERY_BYTE = 0xFFFFFFFF

_HEAD = re.compile(
    r"\.(version|target|address_size|global)\b.*"
)  # constants of C++, which no kernel may read
_ENTRY = re.compile(r"\.visible \.entry (\w+)\(")
_PARAMETER = re.compile(
    r"\.param (?:\.align (\d+) )?\.(\w+)(?: \.ptr(?: \.global)?(?: \.align \d+)?)? (\w+)(?:\[(\d+)\])?,?"
)
_THREADS = re.compile(r"\.maxntid (\d+)(?:, 1, 1)?")
_IGNORED = re.compile(r"\.minnctapersm \d+|\.pragma \"nounroll\";|\.loc .*")
_USED = re.compile(r"\.pragma \"used_bytes_mask (\d+)\";")
_REGISTERS = re.compile(r"\.reg \.(\w+)\s+(%\w+?)(<\d+>)?;")
_VARIABLE = re.compile(r"\.(shared|local) \.align (\d+) \.(\w+)\s+(\w+)(?:\[(\d+)\])?;")
_LABEL = re.compile(r"(\$\w+):")
_INSTRUCTION = re.compile(r"(?:@(!?%\w+)\s+)?([a-z]\w*(?:[.:]+\w+)*)\s*([^;]*);")


class PtxError(ValueError):
    """PTX that the translation does not know."""


@dataclass(frozen=True)
class Instruction:
    """One operation; `used` says which bytes of a load matter, lowest bit first."""

    line: int
    guard: str  # a predicate, with "!" in front if it is negated; or nothing
    opcode: str  # with its modifiers
    operands: tuple[str, ...]
    used: int = EVERY_BYTE

    def __str__(self) -> str:
        return f"line {self.line}: {self.opcode} {', '.join(self.operands)}"


@dataclass(frozen=True)
class Variable:
    """In shared or local memory, or a parameter."""

    name: str
    align: int
    bytes: int


@dataclass
class Kernel:
    """An entry function."""

    name: str
    parameters: list[Variable] = field(default_factory=list)
    threads: int = 0
    registers: dict[str, int] = field(default_factory=dict)  # bytes; of %r<3> the key is "%r" alone
    shared: list[Variable] = field(default_factory=list)
    local: list[Variable] = field(default_factory=list)
    body: list[Instruction | str] = field(default_factory=list)  # a string is a label

    def register_bytes(self, name: str) -> int:
        """Raises PtxError where no register of that name is declared."""
        for key in (name, name.rstrip("0123456789")):
            if key in self.registers:
                return self.registers[key]
        raise PtxError(f"{self.name}: {name} is not declared")


def kernels(ptx: str) -> Iterator[Kernel]:
    """Of a program, in its order. Raises PtxError."""
    lines = _lines(ptx)
    for number, line in lines:
        if match := _ENTRY.fullmatch(line):
            yield _kernel(match[1], lines)
        elif not _HEAD.fullmatch(line):
            raise PtxError(f"line {number}: {line}")


def _lines(ptx: str) -> Iterator[tuple[int, str]]:
    """With numbers, without comments."""
    for number, line in enumerate(ptx.splitlines(), start=1):
        code = line.split("//")[0].strip(" \t\0")
        if code:
            yield number, code


def _kernel(name: str, lines: Iterator[tuple[int, str]]) -> Kernel:
    kernel = Kernel(name)
    for number, line in lines:
        if line == ")":
            break
        if not (match := _PARAMETER.fullmatch(line)):
            raise PtxError(f"line {number}: {line}")
        size = BYTES[match[2]]
        kernel.parameters.append(Variable(match[3], int(match[1] or size), size * int(match[4] or 1)))
    for _, line in lines:
        if line == "{":
            break
        if match := _THREADS.fullmatch(line):
            kernel.threads = int(match[1])
        elif not _IGNORED.fullmatch(line):
            raise PtxError(f"{name}: {line}")
    _body(kernel, lines)
    return kernel


def _body(kernel: Kernel, lines: Iterator[tuple[int, str]]) -> None:
    scopes: list[dict[str, str]] = []  # registers of inner blocks, with names of their own
    used, count = EVERY_BYTE, 0
    for number, line in lines:
        if line == "{":
            scopes.append({})
            count += 1
        elif line == "}" and not scopes:
            return
        elif line == "}":
            scopes.pop()
        elif match := _REGISTERS.fullmatch(line):
            register = match[2]
            if scopes:
                register = scopes[-1][match[2]] = f"{match[2]}_{count}_"
            kernel.registers[register] = BYTES[match[1]]
        elif match := _VARIABLE.fullmatch(line):
            variable = Variable(match[4], int(match[2]), BYTES[match[3]] * int(match[5] or 1))
            (kernel.shared if match[1] == "shared" else kernel.local).append(variable)
        elif match := _LABEL.fullmatch(line):
            kernel.body.append(match[1])
        elif match := _USED.fullmatch(line):
            used = int(match[1])
        elif match := _INSTRUCTION.fullmatch(_renamed(line, scopes)):
            kernel.body.append(Instruction(number, match[1] or "", match[2], _operands(match[3]), used))
            used = EVERY_BYTE
        elif not _IGNORED.fullmatch(line):
            raise PtxError(f"{kernel.name}, line {number}: {line}")
    raise PtxError(f"{kernel.name} has no end")


def _renamed(line: str, scopes: list[dict[str, str]]) -> str:
    names = {own: name for scope in scopes for own, name in scope.items()}
    return re.sub(r"%\w+", lambda register: names.get(register[0], register[0]), line)


def _operands(text: str) -> tuple[str, ...]:
    """Those between commas, a vector in braces as one."""
    return tuple(part.strip() for part in re.split(r",(?![^{]*\})", text)) if text.strip() else ()
