"""PTX as C++ for the emulation: one statement for each instruction, a checked access for each load."""

import re
from pathlib import Path

from tests.renderer.cuda.ptx.program import BYTES, Instruction, Kernel, PtxError, Variable, kernels
from tests.renderer.cuda.ptx.rules import RULES

HEADER = Path(__file__).parent / "ptx.h"
WINDOW = 20  # kWindow of ptx.h
SPECIAL = {
    f"%{ours}.{axis}": f"{theirs}.{axis}"
    for ours, theirs in (
        ("tid", "threadIdx"),
        ("ntid", "blockDim"),
        ("ctaid", "blockIdx"),
        ("nctaid", "gridDim"),
    )
    for axis in "xyz"
}
WIDER = {"s16": "s32", "u16": "u32", "s32": "s64", "u32": "u64"}
REGISTER = {1: "bool", 2: "uint16_t", 4: "uint32_t", 8: "uint64_t"}  # by bytes
SIGNATURE = re.compile(r"__launch_bounds__\((\d+)\)\s+(\w+)\(([^)]*)\)")


def translate(ptx: str, source: str, name: str, error: int = 0) -> str:
    """A program as a file that EmulatedLaunch runs in place of `source`, whose kernels name the parameters.

    Args:
        name: of the file that reports give lines of.
        error: PTX_ERROR of ptx.h.

    Raises:
        PtxError: with the text of what is not known.
    """
    signatures = {match[2]: (int(match[1]), match[3]) for match in SIGNATURE.finditer(source)}
    parts = [f'#define PTX_ERROR {error}\n#include "{HEADER}"\nusing namespace ptx;\n']
    for kernel in kernels(ptx):
        threads, parameters = signatures[kernel.name]
        if kernel.threads != threads:
            raise PtxError(f"{kernel.name}: {kernel.threads} threads, {threads} in the source")
        parts.append(_Translation(kernel, name).text(parameters))
    return "\n".join(parts)


def _c_type(kind: str) -> str:
    """Of a type of PTX."""
    if kind in ("f32", "f64", "pred"):
        return {"f32": "float", "f64": "double", "pred": "bool"}[kind]
    return f"{'int' if kind[0] == 's' else 'uint'}{kind[1:]}_t"


class _Translation:
    """Of one kernel."""

    def __init__(self, kernel: Kernel, file: str) -> None:
        self.kernel = kernel
        self.file = file
        self.used: dict[str, str] = {}  # registers, with their types

    def text(self, parameters: str) -> str:
        """The function; `parameters` of the source, which has the same in the same order."""
        kernel = self.kernel
        declared = [part.strip() for part in parameters.split(",")]
        if len(declared) != len(kernel.parameters):
            raise PtxError(
                f"{kernel.name}: {len(kernel.parameters)} parameters, {len(declared)} in the source"
            )
        pairs = list(zip(declared, kernel.parameters, strict=True))
        given = [(text.split()[-1], each) for text, each in pairs]
        body = [self._line(each) for each in kernel.body]
        registers = [f"  {kind} {name};" for name, kind in sorted(self.used.items())]
        structs = {_struct(each): f"Bytes<{each.bytes}, {each.align}>" for each in kernel.parameters}
        return "\n".join(
            [
                *(f"using {name} = {struct};" for name, struct in structs.items()),
                f'extern "C" __global__ CUDA_HOST_UNCHECKED void __launch_bounds__({kernel.threads})',
                f"    {kernel.name}({', '.join(_declaration(text, each) for text, each in pairs)}) {{",
                _spans("parameter", [(f"(char*)&{name}", each) for name, each in given]),
                "  {",
                *(_array("__shared__ char", _plain(each.name), each) for each in kernel.shared),
                *(_array("char", each.name, each) for each in kernel.local),
                _spans("shared", [(_plain(each.name), each) for each in kernel.shared]),
                _spans("local", [(each.name, each) for each in kernel.local]),
                "  uint32_t turns = 0;",
                *registers,
                *body,
                "  }",
                "}",
            ]
        )  # fmt: skip

    def _line(self, instruction: Instruction | str) -> str:
        if isinstance(instruction, str):
            return f"{_label(instruction)}:;"
        try:
            statement = self._statement(instruction)
        except PtxError as error:
            raise PtxError(f"{self.kernel.name}, {instruction}: {error}") from None
        guard = f"if ({self._read(instruction.guard, 'pred')}) " if instruction.guard else ""
        return f'#line {instruction.line} "{self.file}"\n  {guard}{{ {statement} }}'

    def _statement(self, it: Instruction) -> str:
        for rule in RULES:
            if match := rule.pattern.fullmatch(it.opcode):
                return self._computed(it, rule.types, rule.expression, match.groupdict())
        operation = it.opcode.split(".")[0]
        method = getattr(self, f"_{operation}", None) if operation in OPERATIONS else None
        if method is None:
            raise PtxError("unknown instruction")
        return str(method(it))

    def _computed(
        self, it: Instruction, types: tuple[str, ...], expression: str, groups: dict[str, str | None]
    ) -> str:
        kind, flush = groups["t"] or "", bool(groups.get("ftz"))
        known = {
            "t": kind,
            "u": re.sub("^s", "u", kind),
            "w": WIDER.get(kind, ""),
            "s": groups.get("s") or "",
        }
        result, *given = (known.get(each, each) for each in types)
        target, *operands = self._expect(it, len(types))
        values = [self._read(text, each) for text, each in zip(operands, given, strict=True)]
        if flush:
            values = [f"flush({value})" for value in values]
        names = {key: _c_type(each) for key, each in known.items() if each}
        value = expression.format(*values, f=groups.get("f"), **names)
        return self._write(
            target, f"flush({_c_type(result)}({value}))" if flush else f"{_c_type(result)}({value})"
        )

    def _expect(self, it: Instruction, count: int) -> tuple[str, ...]:
        if len(it.operands) != count:
            raise PtxError(f"{count} operands expected")
        return it.operands

    def _match(self, it: Instruction, pattern: str) -> re.Match[str]:
        match = re.fullmatch(pattern, it.opcode)
        if match is None:
            raise PtxError("unknown modifier")
        return match

    # Operands

    def _register(self, name: str) -> str:
        variable = f"v_{name[1:]}"
        self.used[variable] = REGISTER[self.kernel.register_bytes(name)]
        return variable

    def _write(self, name: str, value: str) -> str:
        if not name.startswith("%"):
            raise PtxError(f"{name} is no register")
        return f"set({self._register(name)}, {value});"

    def _read(self, text: str, kind: str) -> str:
        """An operand as a value of a type."""
        c_type = _c_type(kind)
        if text in SPECIAL and kind == "u32":
            return SPECIAL[text]
        if text.startswith("!") and kind == "pred":
            return f"!{self._read(text[1:], kind)}"
        if text.startswith("%") and text not in SPECIAL:
            return f"as<{c_type}>({self._register(text)})"
        if match := re.fullmatch(r"0[fF]([0-9A-Fa-f]{8})", text):
            return f"as<{c_type}>(uint32_t(0x{match[1]}u))"
        if match := re.fullmatch(r"0[dD]([0-9A-Fa-f]{16})", text):
            return f"as<{c_type}>(uint64_t(0x{match[1]}ull))"
        if re.fullmatch(r"-?\d+|0x[0-9A-Fa-f]+", text) and kind[0] != "f":
            return f"{c_type}({text}{'ll' if text[0] == '-' else 'ull'})"
        if kind in ("u32", "b32", "u64", "b64"):
            return f"{c_type}({self._symbol(text)[0]})"
        raise PtxError(f"operand {text}")

    def _symbol(self, name: str) -> tuple[str, str]:
        """The address of a variable or parameter, and what it is in: spans and their number."""
        for k, each in enumerate(self.kernel.shared):
            if each.name == name:
                return f"({k + 1}u << {WINDOW})", f"shared_spans, {len(self.kernel.shared)}"
        for spans, variables in (("local", self.kernel.local), ("parameter", self.kernel.parameters)):
            for k, each in enumerate(variables):
                if each.name == name:
                    return f"uint64_t({spans}_spans[{k}].begin)", f"{spans}_spans + {k}, 1"
        raise PtxError(f"operand {name}")

    def _address(self, space: str, text: str, size: int) -> str:
        """Where a number of bytes is."""
        match = re.fullmatch(r"\[([%$\w]+)(?:\+(-?\d+))?\]", text)
        if match is None:
            raise PtxError(f"operand {text}")
        base, offset = match[1], int(match[2] or 0)
        if base.startswith("%"):
            narrow = self.kernel.register_bytes(base) == BYTES["u32"] and space == "shared"
            address, spans = self._read(base, "u32" if narrow else "u64"), self._spans_of(space)
        else:
            address, spans = self._symbol(base)
        if space == "global":
            return f"(char*)({address} + {offset}ll)"
        at = "shared_at" if space == "shared" else "own_at"
        return f"{at}({spans}, {address} + {offset}{'' if space == 'shared' else f', {size}'})"

    def _spans_of(self, space: str) -> str:
        counts = {"shared": self.kernel.shared, "local": self.kernel.local, "param": self.kernel.parameters}
        return f"{space.replace('param', 'parameter')}_spans, {len(counts.get(space, ()))}"

    # What does more than compute. Each method is named after its operation.

    def _ld(self, it: Instruction) -> str:
        match = self._match(it, r"ld\.(param|global|shared|local)(?:\.v([248]))?\.([bsuf](?:8|16|32|64))")
        space, kind, count = match[1], match[3], int(match[2] or 1)
        target, source = self._expect(it, 2)
        targets = _elements(target, count)
        at = self._address(space, source, count * BYTES[kind])
        checked = f"load<{_c_type(kind)}, {count}>({at}, {it.used:#x}u)"
        own = f"*(const Vector<{_c_type(kind)}, {count}>*){at}"
        values = own if space in ("param", "local") else checked
        return f"const auto x = {values}; " + " ".join(
            self._write(each, f"x.of[{k}]") for k, each in enumerate(targets)
        )

    def _st(self, it: Instruction) -> str:
        match = self._match(it, r"st\.(global|shared|local)(?:\.v([248]))?\.([bsuf](?:8|16|32|64))")
        space, kind, count = match[1], match[3], int(match[2] or 1)
        target, source = self._expect(it, 2)
        at = self._address(space, target, count * BYTES[kind])
        vector = f"Vector<{_c_type(kind)}, {count}>"
        values = f"{vector}{{{{{', '.join(self._read(each, kind) for each in _elements(source, count))}}}}}"
        return f"*({vector}*){at} = {values};" if space == "local" else f"store({at}, {values});"

    def _atom(self, it: Instruction) -> str:
        match = self._match(it, r"(?:atom|red)\.global\.(?:add\.(f32|u32|u64)|or\.(b32))")
        operation, kind = ("Add", match[1]) if match[1] else ("Or", match[2])
        *target, address, value = self._expect(it, 2 if it.opcode.startswith("red") else 3)
        at = self._address("global", address, BYTES[kind])
        result = f"atomic<{operation}, {_c_type(kind)}>({at}, {self._read(value, kind)})"
        return self._write(target[0], result) if target else f"{result};"

    _red = _atom

    def _shfl(self, it: Instruction) -> str:
        match = self._match(it, r"shfl\.sync\.(up|down|bfly|idx)\.b32")
        how = {"up": "kUp", "down": "kDown", "bfly": "kButterfly", "idx": "kIndex"}[match[1]]
        target, *operands = self._expect(it, 5)
        value, *rest = target.split("|")
        given = ", ".join(self._read(each, "b32") for each in operands)
        inside = "".join(self._write(each, "x.inside") for each in rest)
        return f"const auto x = shuffle({how}, {given}); {self._write(value, 'x.value')} {inside}"

    def _vote(self, it: Instruction) -> str:
        match = self._match(it, r"vote\.sync\.(?:(any|all)\.pred|(ballot)\.b32)")
        target, predicate, mask = self._expect(it, 3)
        return self._write(
            target, f"{match[1] or match[2]}({self._read(predicate, 'pred')}, {self._read(mask, 'b32')})"
        )

    def _bar(self, it: Instruction) -> str:
        if it.opcode == "bar.warp.sync":
            return f"__syncwarp({self._read(self._expect(it, 1)[0], 'b32')});"
        self._match(it, r"bar\.sync|bar\.red\.or\.pred")
        if it.opcode == "bar.sync":
            barrier = self._expect(it, 1)[0]
            result = "__syncthreads();"
        else:
            target, barrier, predicate = self._expect(it, 3)
            result = self._write(target, f"__syncthreads_or({self._read(predicate, 'pred')}) != 0")
        if barrier != "0":
            raise PtxError("another barrier than 0")
        return result

    def _bra(self, it: Instruction) -> str:
        self._match(it, r"bra(?:\.uni)?")
        (label,) = self._expect(it, 1)
        back = self.kernel.body.index(label) < self.kernel.body.index(it)
        return f"{'turn(turns); ' if back else ''}goto {_label(label)};"

    def _ret(self, it: Instruction) -> str:
        self._match(it, "ret")
        return "return;"


OPERATIONS = ("ld", "st", "atom", "red", "shfl", "vote", "bar", "bra", "ret")


def _elements(text: str, count: int) -> list[str]:
    """Of a vector in braces, or the only one."""
    elements = [part.strip() for part in text.strip("{}").split(",")]
    if len(elements) != count or (count > 1) != text.startswith("{"):
        raise PtxError(f"a vector of {count} expected")
    return elements


def _label(text: str) -> str:
    return "L" + text.lstrip("$")


def _plain(symbol: str) -> str:
    """The name of a variable in a function, without the function's."""
    match = re.fullmatch(r"_ZZ(\d+)(\w+)", symbol)
    if match is None:
        return symbol
    rest = re.fullmatch(r"E(\d+)(\w+)", match[2][int(match[1]) :])
    if rest is None or len(rest[2]) != int(rest[1]):
        raise PtxError(f"shared variable {symbol}")
    return rest[2]


def _declaration(text: str, parameter: Variable) -> str:
    """A parameter of the source as one of C++ without its types."""
    kind, name = text.rsplit(maxsplit=1)
    plain = "char*" if kind.endswith("*") else kind if kind in ("int64_t", "float") else ""
    size = {"char*": 8, "int64_t": 8, "float": 4}.get(plain, parameter.bytes)
    if size != parameter.bytes:
        raise PtxError(f"{text} has {parameter.bytes} bytes")
    return f"{plain or _struct(parameter)} {name}"


def _struct(parameter: Variable) -> str:
    """A type without a comma, by which `in_order` would tell parameters apart."""
    return f"Bytes{parameter.bytes}By{parameter.align}"


def _array(kind: str, name: str, variable: Variable) -> str:
    return f"  alignas({variable.align}) {kind} {name}[{variable.bytes}];"


def _spans(name: str, variables: list[tuple[str, Variable]]) -> str:
    inner = ", ".join(f"{{{at}, {each.bytes}}}" for at, each in variables)
    return f"  const Span {name}_spans[] = {{{inner or '{nullptr, 0}'}}};"
