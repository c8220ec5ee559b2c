"""C statements for a folded function, and their evaluation with the machine's C compiler."""

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from frictionzoo.core.errors import ExportError
from frictionzoo.simulation.fold import Specialised
from frictionzoo.simulation.fold.expression import Expression

_FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-shared", "-fPIC", "-x", "c")
_TRUTH = {"eq": "==", "ne": "!=", "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "and": "&&", "or": "||"}
_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", **_TRUTH}
_CALLED = {"abs": "fabs", "rem": "fmod", "is_finite": "isfinite"}
_OTHERS = {
    "neg": "-{0}",
    "not": "!{0}",
    "max": "{0} > {1} ? {0} : {1}",
    "min": "{0} < {1} ? {0} : {1}",
    "select": "{0} ? {1} : {2}",
    "sign": "({0} > 0) - ({0} < 0)",
    "rsqrt": "1 / sqrt({0})",
    "logistic": "1 / (1 + exp(-{0}))",
}


def write_statements(folded: Specialised, inputs: list[str], output: str) -> tuple[set[str], list[str]]:
    """Return the names of the inputs that are read, and statements that assign to `output[0]`, `output[1]`, ...

    The function's arguments and its one output have shape (nv,); an argument is read as `in->NAME[0]`.
    """
    text: dict[int, str] = {}
    lines, used = list[str](), set[str]()

    def read(entry: Any) -> str:
        if isinstance(entry, Expression):
            return text[id(entry)]
        if isinstance(entry, bool | np.bool_):
            return str(int(entry))
        number = repr(float(entry)).replace("inf", "INFINITY").replace("nan", "NAN")
        return f"({number})" if number.startswith("-") else number

    for number, expression in enumerate(folded.order):
        operation, arguments = expression.operation, expression.arguments
        if operation == "input":
            place, (index,) = arguments
            used.add(inputs[place])
            text[id(expression)] = f"in->{inputs[place]}[{index}]"
            continue
        text[id(expression)] = f"t{number}"  # a truth value is 0.0 or 1.0
        lines.append(f"const double t{number} = {_write(operation, [read(entry) for entry in arguments])};")
    (entries,) = folded.outputs
    return used, [*lines, *(f"{output}[{index}] = {read(entry)};" for index, entry in enumerate(entries))]


def _write(operation: str, arguments: list[str]) -> str:
    if operation in _INFIX:
        return f" {_INFIX[operation]} ".join(arguments)
    if operation in _OTHERS:
        return _OTHERS[operation].format(*arguments)
    return f"{_CALLED.get(operation, operation)}({', '.join(arguments)})"


def write_literal(name: str) -> str:
    """Return a C string literal; every byte but plain characters is escaped."""
    plain = (
        chr(byte) if 32 <= byte < 127 and chr(byte) not in '"\\?' else f"\\{byte:03o}"
        for byte in name.encode("utf-8", "replace")
    )
    return f'"{"".join(plain)}"'


def run_compiled(
    source: str, function: str, inputs: Float[np.ndarray, "calls values"], outputs: int
) -> Float[np.ndarray, "calls outputs"]:
    """Compile C source, and call `void function(const INPUT *, double *)` once for each row of inputs.

    Raises:
        ExportError: There is no C compiler, or it refuses the source.
    """
    compiler = next((path for name in ("cc", "gcc", "clang") if (path := shutil.which(name))), None)
    if compiler is None:
        raise ExportError("no C compiler (cc, gcc or clang), expected one to check the written C code; install one")
    call = "void run(long calls, const double *in, long width, double *out, long outputs) { long i; "
    call += f"for (i = 0; i < calls; i++) {function}((const void *)(in + i * width), out + i * outputs); }}\n"
    inputs, results = np.ascontiguousarray(inputs, np.float64), np.empty((len(inputs), outputs))
    with tempfile.TemporaryDirectory() as scratch:
        written, library = Path(scratch, "run.c"), Path(scratch, "run.so")
        written.write_text(source + call)
        command = [compiler, *_FLAGS, str(written), "-o", str(library), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise ExportError(f"{compiler} refuses the written C code: {' '.join(done.stderr.split())[:300]}")
        compiled = ctypes.CDLL(str(library))
        addresses = [ctypes.c_void_p(array.ctypes.data) for array in (inputs, results)]
        sizes = [ctypes.c_long(size) for size in (*inputs.shape, outputs)]
        compiled.run(sizes[0], addresses[0], sizes[1], addresses[1], sizes[2])
    return results
