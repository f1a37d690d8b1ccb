"""The instructions of PTX that only compute, as expressions of C++ with the functions of ptx.h.

A rule names the types of result and operands: those of the opcode (`t`), `t` without sign (`u`), twice as
wide (`w`), of the source of a conversion (`s`), or one by name. Flushing subnormals is no part of an
expression: translation.py does it for every instruction with `.ftz`.
"""

import re
from dataclasses import dataclass
from itertools import product

FTZ = r"(?P<ftz>\.ftz)?"
INTEGER = r"[su](?:16|32|64)"


@dataclass(frozen=True)
class Rule:
    """What opcodes that match a pattern compute."""

    pattern: re.Pattern[str]
    types: tuple[str, ...]  # of the result, then of the operands
    expression: str  # {0} is the first operand, {w} and its like are types of C++


def _rule(pattern: str, types: str, expression: str) -> Rule:
    return Rule(re.compile(pattern), tuple(types.split()), expression)


def _comparisons() -> list[Rule]:
    """`setp`: the plain ones are false if an operand is NaN, those with `u` are true."""
    signs = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">="}
    opposite = {"eq": "!=", "ne": "==", "lt": ">=", "le": ">", "gt": "<=", "ge": "<"}
    made = [
        _rule(r"setp\.nan" + FTZ + r"\.(?P<t>f32|f64)", "pred t t", "{0} != {0} || {1} != {1}"),
        _rule(r"setp\.num" + FTZ + r"\.(?P<t>f32|f64)", "pred t t", "{0} == {0} && {1} == {1}"),
    ]
    for name, sign in signs.items():
        ordered = "{0} < {1} || {0} > {1}" if name == "ne" else f"{{0}} {sign} {{1}}"
        unordered = "!({0} < {1} || {0} > {1})" if name == "eq" else f"!({{0}} {opposite[name]} {{1}})"
        made += [
            _rule(rf"setp\.{name}\.(?P<t>[bsu](?:16|32|64))", "pred t t", f"{{0}} {sign} {{1}}"),
            _rule(rf"setp\.{name}{FTZ}\.(?P<t>f32|f64)", "pred t t", ordered),
            _rule(rf"setp\.{name}u{FTZ}\.(?P<t>f32|f64)", "pred t t", unordered),
        ]
    return made


def _conversions() -> list[Rule]:
    """`cvt`. Integers wrap or extend; floats round as the opcode says."""
    made = [
        _rule(rf"cvt\.(?P<t>{INTEGER})\.(?P<s>{INTEGER})", "t s", "{t}({0})"),
        _rule(rf"cvt\.rn{FTZ}\.(?P<t>f32)\.(?P<s>[su](?:8|16|32|64))", "t s", "{t}({0})"),
        _rule(r"cvt\.rn\.(?P<t>f64)\.(?P<s>[su](?:8|16|32|64))", "t s", "{t}({0})"),
        _rule(rf"cvt\.rn{FTZ}\.(?P<t>f32)\.(?P<s>f64)", "t s", "{t}({0})"),
        _rule(rf"cvt{FTZ}\.(?P<t>f64)\.(?P<s>f32)", "t s", "{t}({0})"),
        _rule(rf"cvt{FTZ}\.sat\.(?P<t>f32)\.(?P<s>f32)", "t s", "saturate({0})"),
    ]
    roundings = {"rni": "rint", "rzi": "trunc", "rmi": "floor", "rpi": "ceil"}
    for (name, function), kind in product(roundings.items(), ("f32", "f64")):
        made += [
            _rule(rf"cvt\.{name}{FTZ}\.(?P<t>{kind})\.(?P<s>{kind})", "t s", f"std::{function}({{0}})"),
            _rule(
                rf"cvt\.{name}{FTZ}\.(?P<t>[su](?:32|64))\.(?P<s>{kind})",
                "t s",
                f"to_integer<{{t}}>(std::{function}({{0}}))",
            ),
        ]
    return made


RULES = (
    _rule(rf"(?P<f>add|sub|mul)(?:\.rn)?{FTZ}\.(?P<t>f32|f64)", "t t t", "{f}({0}, {1})"),
    _rule(rf"(?P<f>add|sub)\.(?P<t>{INTEGER})", "u u u", "{f}({0}, {1})"),
    _rule(rf"mul\.lo\.(?P<t>{INTEGER})", "u u u", "mul({0}, {1})"),
    _rule(r"mul\.hi\.(?P<t>[su](?:16|32))", "t t t", "mul_high<{w}>({0}, {1})"),
    _rule(r"mul\.wide\.(?P<t>[su](?:16|32))", "w t t", "mul_wide<{w}>({0}, {1})"),
    _rule(rf"mad\.lo\.(?P<t>{INTEGER})", "u u u u", "add(mul({0}, {1}), {2})"),
    _rule(rf"fma\.rn{FTZ}\.(?P<t>f32|f64)", "t t t t", "ptx::fma({0}, {1}, {2})"),
    _rule(r"fma\.rm\.(?P<t>f32)", "t t t t", "fma_down({0}, {1}, {2})"),
    _rule(rf"div\.rn{FTZ}\.(?P<t>f32|f64)", "t t t", "divide({0}, {1})"),
    _rule(r"div\.(?P<t>[su](?:32|64))", "t t t", "divide({0}, {1})"),
    _rule(rf"rcp\.rn{FTZ}\.(?P<t>f32|f64)", "t t", "divide({t}(1), {0})"),
    _rule(rf"sqrt\.rn{FTZ}\.(?P<t>f32|f64)", "t t", "ptx::sqrt({0})"),
    _rule(rf"div\.approx{FTZ}\.(?P<t>f32)", "t t t", "div_approx({0}, {1})"),
    _rule(rf"(?P<f>rcp|sqrt|rsqrt|ex2|lg2|sin|cos)\.approx{FTZ}\.(?P<t>f32)", "t t", "ptx::{f}_approx({0})"),
    _rule(rf"abs{FTZ}\.(?P<t>f32|f64|s16|s32|s64)", "t t", "magnitude({0})"),
    _rule(rf"neg{FTZ}\.(?P<t>f32|f64|s16|s32|s64)", "t t", "negative({0})"),
    _rule(r"copysign\.(?P<t>f32)", "t t t", "copy_sign({0}, {1})"),
    _rule(rf"min{FTZ}\.(?P<t>f32|f64|{INTEGER})", "t t t", "least({0}, {1})"),
    _rule(rf"max{FTZ}\.(?P<t>f32|f64|{INTEGER})", "t t t", "most({0}, {1})"),
    _rule(r"selp\.(?P<t>[bsu](?:16|32|64)|f32|f64)", "t t t pred", "{2} ? {0} : {1}"),
    _rule(r"mov\.(?P<t>pred|[bsu](?:16|32|64)|f32|f64)", "t t", "{0}"),
    _rule(r"cvta(?:\.to)?\.(?:global|shared|local)\.(?P<t>u64)", "t t", "{0}"),
    _rule(r"and\.(?P<t>b16|b32|b64|pred)", "t t t", "{t}({0} & {1})"),
    _rule(r"or\.(?P<t>b16|b32|b64|pred)", "t t t", "{t}({0} | {1})"),
    _rule(r"xor\.(?P<t>b16|b32|b64|pred)", "t t t", "{t}({0} ^ {1})"),
    _rule(r"not\.(?P<t>b16|b32|b64)", "t t", "{t}(~{0})"),
    _rule(r"not\.(?P<t>pred)", "t t", "!{0}"),
    _rule(r"shl\.(?P<t>b16|b32|b64)", "t t u32", "shift_left({0}, {1})"),
    _rule(r"shr\.(?P<t>[bsu](?:16|32|64))", "t t u32", "shift_right({0}, {1})"),
    _rule(r"popc\.(?P<t>b32)", "u32 t", "count_bits({0})"),
    _rule(r"brev\.(?P<t>b32)", "t t", "reverse_bits({0})"),
    _rule(r"clz\.(?P<t>b32)", "u32 t", "leading_zeros({0})"),
    _rule(r"bfind\.shiftamt\.(?P<t>u32)", "t t", "find_shift({0})"),
    _rule(r"bfi\.(?P<t>b32)", "t t t u32 u32", "insert_bits({0}, {1}, {2}, {3})"),
    *_comparisons(),
    *_conversions(),
)
