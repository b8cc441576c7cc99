"""CasADi functions as machine code, which LLVM builds in memory.

LLVM is given the operations of CasADi's interpreter in their order, may neither reorder nor fuse them, and calls the
same mathematical library: results are equal to the last bit, in a sixth to a tenth of the time. It does not optimise.
Optimising takes ten times as long as all the rest, and the code then runs up to twice as fast, which rarely repays it.
The code is cached for other processes, which load it in a tenth of the time that it takes to build.
"""

from __future__ import annotations

import ctypes
import platform
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import cache, lru_cache, partial
from hashlib import sha256
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from vehsim.runtime.cache import lookup_code, store_code

Array = NDArray[np.float64]

BLOCK = 2000
"""Operations in a basic block: a third of the time to build a function of 90,000, and half of the time to run it, are
those of one block."""
LONGEST = 200_000
"""Operations of the longest function: above it, the time for each grows without end."""

KIND = "machine-2"
"""Kind of its entries in the cache: change it when the code of a function changes."""

_ONE = ("SIN", "COS", "TAN", "ASIN", "ACOS", "ATAN", "SINH", "COSH", "TANH", "ASINH", "ACOSH", "ATANH")
_MORE = ("EXP", "LOG", "EXPM1", "LOG1P", "ERF", "FLOOR", "CEIL")
_TWO = ("POW", "ATAN2", "FMOD", "HYPOT", "REMAINDER")
_BUILT_IN = {"SQRT": "llvm.sqrt.f64", "FABS": "llvm.fabs.f64", "COPYSIGN": "llvm.copysign.f64"}
_UNARY = {name: name.lower() for name in (*_ONE, *_MORE)} | {name: _BUILT_IN[name] for name in ("SQRT", "FABS")}
_BINARY = {name: name.lower() for name in _TWO} | {"CONSTPOW": "pow", "COPYSIGN": _BUILT_IN["COPYSIGN"]}
_NUMBER = "{r} = uitofp i1 {r}t to double"
_EITHER = "{{r}}x = fcmp {} double {{x}}, {{y}}\n{{r}}y = fcmp uno double {{y}}, {{y}}\n{{r}}t = or i1 {{r}}x, {{r}}y\n"
_EITHER += "{{r}} = select i1 {{r}}t, double {{x}}, double {{y}}"

_CODE = {
    "ADD": "{r} = fadd double {x}, {y}",
    "SUB": "{r} = fsub double {x}, {y}",
    "MUL": "{r} = fmul double {x}, {y}",
    "DIV": "{r} = fdiv double {x}, {y}",
    "NEG": "{r} = fneg double {x}",
    "SQ": "{r} = fmul double {x}, {x}",
    "TWICE": "{r} = fmul double {x}, 2.0",
    "INV": "{r} = fdiv double 1.0, {x}",
    "LT": "{r}t = fcmp olt double {x}, {y}\n" + _NUMBER,
    "LE": "{r}t = fcmp ole double {x}, {y}\n" + _NUMBER,
    "EQ": "{r}t = fcmp oeq double {x}, {y}\n" + _NUMBER,
    "NE": "{r}t = fcmp une double {x}, {y}\n" + _NUMBER,
    "NOT": "{r}t = fcmp oeq double {x}, 0.0\n" + _NUMBER,
    "AND": "{r}x = fcmp une double {x}, 0.0\n{r}y = fcmp une double {y}, 0.0\n{r}t = and i1 {r}x, {r}y\n" + _NUMBER,
    "OR": "{r}x = fcmp une double {x}, 0.0\n{r}y = fcmp une double {y}, 0.0\n{r}t = or i1 {r}x, {r}y\n" + _NUMBER,
    "IF_ELSE_ZERO": "{r}t = fcmp une double {x}, 0.0\n{r} = select i1 {r}t, double {y}, double 0.0",
    "SIGN": "{r}x = fcmp olt double {x}, 0.0\n{r}y = fcmp ogt double {x}, 0.0\n"
    "{r}z = select i1 {r}y, double 1.0, double {x}\n{r} = select i1 {r}x, double -1.0, double {r}z",
    "FMIN": _EITHER.format("ole"),
    "FMAX": _EITHER.format("oge"),
    **{name: f"{{r}} = call double @{called}(double {{x}})" for name, called in _UNARY.items()},
    **{name: f"{{r}} = call double @{called}(double {{x}}, double {{y}})" for name, called in _BINARY.items()},
}
"""Operation of CasADi -> LLVM's instructions for its result ``r`` and operands ``x, y``."""
_LIBRARY = sorted({*_UNARY.values(), *_BINARY.values()} - {*_BUILT_IN.values()})
"""The functions of C's mathematical library that the code calls."""
_DECLARED = "\n".join(
    [
        *(f"declare double @{called}(double)" for called in _UNARY.values()),
        *(f"declare double @{called}(double, double)" for called in dict.fromkeys(_BINARY.values())),
    ]
)
_ROWS = """
define void @rows(ptr %in, ptr %over, ptr %along, ptr %out, ptr %out_over, ptr %out_along, i64 %m, i64 %n) {{
entry:
  br label %groups
groups:
  %j = phi i64 [0, %entry], [%next_j, %ended]
  br label %row
row:
  %k = phi i64 [0, %groups], [%next_k, %{last}]
  {body}
  %next_k = add i64 %k, 1
  %more = icmp slt i64 %next_k, %n
  br i1 %more, label %row, label %ended
ended:
  %next_j = add i64 %j, 1
  %another = icmp slt i64 %next_j, %m
  br i1 %another, label %groups, label %done
done:
  ret void
}}
"""
"""Calls for ``m`` groups of ``n`` rows, at least one: every pointer moves by its own strides, in doubles."""


class MachineCode:
    """A ``function`` of dense columns as machine code; raises ``ValueError`` if it has too many operations, or one that
    is not known.

    It may run in several threads at once, and releases Python's lock.
    """

    def __init__(self, function: ca.Function, key: str = ""):
        """``key``: what `code_key` gives, for the cache; by default it is not cached."""
        built = _object_code(function)
        self._load(built)
        if key:
            store_code(KIND, key, built)

    @classmethod
    def recalled(cls, key: str) -> MachineCode | None:
        """That of the cache; None if it holds none."""
        if not key or (built := lookup_code(KIND, key)) is None:
            return None
        code = cls.__new__(cls)
        code._load(built)
        return code

    def _load(self, built: bytes) -> None:
        llvm = _llvm()
        self._engine = _engine(llvm)  # it owns the code
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(built))
        self._engine.finalize_object()
        if not (address := self._engine.get_function_address("rows")):
            raise OSError("the code does not contain what it should")
        self._rows = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 6, *[ctypes.c_longlong] * 2)(address)
        self._rows.engine = self._engine  # type: ignore[attr-defined]  # what `bound` returns keeps it

    def rows(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> None:
        """Evaluate it for every row of arrays (m, n, width), which lie in ``inputs`` and are written to ``outputs``;
        the numbers of a row are contiguous."""
        m, n = outputs[0].shape[:2]
        if m and n:
            self._rows(*_places(inputs), *_places(outputs), m, n)

    def bound(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> Callable[[], None]:
        """A call that reads the columns ``inputs`` where they are, and writes ``outputs``; both must stay alive."""
        places = [*_places([a[None, None] for a in inputs]), *_places([a[None, None] for a in outputs])]
        return partial(self._rows, *places, 1, 1)


def _places(arrays: Sequence[Array]) -> tuple[Any, Any, Any]:
    """Addresses of arrays (m, n, width), and their strides along the first two axes."""
    addresses = (ctypes.c_void_p * len(arrays))(*[a.__array_interface__["data"][0] for a in arrays])
    return addresses, *_strides(tuple(a.strides[:2] for a in arrays))


@lru_cache(maxsize=1024)
def _strides(strides: tuple[tuple[int, ...], ...]) -> tuple[Any, Any]:
    """Strides in bytes, as numbers of doubles for the machine code."""
    kind = ctypes.c_longlong * len(strides)
    return kind(*(over // 8 for over, _ in strides)), kind(*(along // 8 for _, along in strides))


@cache
def _llvm() -> Any:
    import llvmlite.binding as llvm

    llvm.check_jit_execution()  # LLVM itself does not notice that memory stays not executable, and the code crashes
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    _engine(llvm)  # opens this process for LLVM
    missing = [called for called in _LIBRARY if llvm.address_of_symbol(called) is None]
    if missing:  # LLVM would end the process
        raise OSError(f"this process has no {', '.join(missing)}")
    return llvm


def _machine(llvm: Any) -> Any:
    # for any processor of this kind: none may give other bits than its neighbour
    return llvm.Target.from_default_triple().create_target_machine(opt=0)


def _engine(llvm: Any) -> Any:
    return llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine(llvm))


def _object_code(function: ca.Function) -> bytes:
    """What LLVM makes of the function: it refers to the mathematical library by name."""
    llvm = _llvm()
    return bytes(_machine(llvm).emit_object(llvm.parse_assembly(_written(function))))


def code_key(function: ca.Function) -> str:
    """Everything that the code of a function depends on; "" if it cannot be built. Not for threads: CasADi may crash if
    they touch expressions."""
    if not function.is_a("SXFunction") or function.n_instructions() > LONGEST:
        return ""
    with suppress(ImportError):
        from llvmlite import __version__ as llvm  # LLVM itself takes 20 ms to load

        machine = sys.platform, platform.machine(), ca.CasadiMeta.version(), llvm
        written = _ROWS, _DECLARED, sorted(_CODE.items()), BLOCK
        return sha256(repr((machine, written)).encode() + function.serialize().encode()).hexdigest()
    return ""


@cache
def _operations() -> dict[int, str]:
    return {getattr(ca, name): name.removeprefix("OP_") for name in dir(ca) if name.startswith("OP_")}


def _written(function: ca.Function) -> str:
    """The function in LLVM's language."""
    if not function.is_a("SXFunction"):
        raise ValueError(f"function {function.name()}: {function.class_name()}, only an SXFunction has operations")
    if function.n_instructions() > LONGEST:
        raise ValueError(f"function {function.name()}: {function.n_instructions()} operations, at most {LONGEST}")
    lines = [*_pointers("in", "over", "along", "i", function.n_in())]
    lines += _pointers("out", "out_over", "out_along", "o", function.n_out())
    names, values, block = _operations(), {}, "row"
    for k in range(function.n_instructions()):
        if k % BLOCK == BLOCK - 1:
            block = f"block{k}"
            lines += [f"br label %{block}", f"{block}:"]
        name = names[function.instruction_id(k)]
        given, made = function.instruction_input(k), function.instruction_output(k)
        r = f"%v{k}"
        if name == "CONST":
            values[made[0]] = f"0x{np.float64(function.instruction_constant(k)).view(np.uint64):016X}"
        elif name == "INPUT":
            lines.append(f"{r}p = getelementptr double, ptr %i{given[0]}, i64 {given[1]}")
            lines.append(f"{r} = load double, ptr {r}p")
            values[made[0]] = r
        elif name == "OUTPUT":
            lines.append(f"{r}p = getelementptr double, ptr %o{made[0]}, i64 {made[1]}")
            lines.append(f"store double {values[given[0]]}, ptr {r}p")
        elif name in _CODE:
            operands = [values[number] for number in given]
            lines.append(_CODE[name].format(r=r, x=operands[0], y=operands[-1]))
            values[made[0]] = r
        else:
            raise ValueError(f"operation {name}: not known")
    return _DECLARED + _ROWS.format(body="\n  ".join(lines), last=block)


def _pointers(array: str, over: str, along: str, name: str, count: int) -> Iterator[str]:
    """Instructions that find the row of every one of ``count`` arrays."""
    for i in range(count):
        yield f"%{name}{i}a = getelementptr ptr, ptr %{array}, i64 {i}"
        yield f"%{name}{i}b = load ptr, ptr %{name}{i}a"
        for index, strides in (("j", over), ("k", along)):
            at = f"%{name}{i}{index}"
            yield f"{at}a = getelementptr i64, ptr %{strides}, i64 {i}"
            yield f"{at}s = load i64, ptr {at}a"
            yield f"{at} = mul i64 {at}s, %{index}"
        yield f"%{name}{i}s = add i64 %{name}{i}j, %{name}{i}k"
        yield f"%{name}{i} = getelementptr double, ptr %{name}{i}b, i64 %{name}{i}s"
