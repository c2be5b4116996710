"""Compiler of expressions to machine code with LLVM, without a C compiler, and the cache of this code on disk.

Operations run in double precision, in the order written, without fusion. Every function takes four arrays in double
precision: it reads parameters, constants and inputs, and writes results.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.extending import intrinsic

from edp.errors import StorageError
from edp.networks.twin.symbolic.expression import Expression, ExpressionGraph
from edp.storage import write_bytes

DOUBLE, INDEX, VOID = ir.DoubleType(), ir.IntType(64), ir.VoidType()
MAX_OPTIMISED = 40_000
"""Maximum number of operations of a module whose code generation is optimised."""
CHECK = 16
"""Bytes of the checksum before machine code in a file; LLVM does not verify the code that it loads."""
OPERATORS = {"+": "fadd", "-": "fsub", "*": "fmul", "/": "fdiv"}


@dataclass(frozen=True, eq=False)
class Loaded:
    """Machine code in memory.

    Attributes:
        addresses: addresses of the functions by name.
        engine: owner of the code; the code is freed with the engine.
    """

    addresses: Mapping[str, int]
    engine: object


class CodeModule:
    """Functions compiled from one graph.

    Args:
        graph: graph of the expressions.
        groups: parameters, constants and inputs: the input expressions of the three arrays that a function reads.
    """

    def __init__(self, graph: ExpressionGraph, groups: Sequence[Sequence[Expression]]) -> None:
        self._graph, self._code = graph, ir.Module("equations")
        self._places = {node.index: (at, k) for at, group in enumerate(groups) for k, node in enumerate(group)}
        self.names: list[str] = []
        self.operations = 0

    def add(self, name: str, results: Sequence[Expression]) -> None:
        """Add a function that computes `results`."""
        self.names.append(name)
        pointer = DOUBLE.as_pointer()
        function = ir.Function(self._code, ir.FunctionType(VOID, [pointer] * 4), name)
        for argument in function.args:
            argument.add_attribute("noalias")
        build = ir.IRBuilder(function.append_basic_block())
        values: dict[int, ir.Value] = {}
        nodes = self._graph.needed(results)
        self.operations += len(nodes)
        for node in nodes:
            values[node.index] = self._value(build, function, node, values)
        for k, node in enumerate(results):
            build.store(values[node.index], build.gep(function.args[-1], [INDEX(k)]))
        build.ret_void()

    def _value(self, build: Any, function: Any, node: Expression, values: Mapping[int, ir.Value]) -> ir.Value:
        if node.operation == "constant":
            return ir.Constant(DOUBLE, node.value)
        if node.operation == "input":
            group, index = self._places[node.index]
            return build.load(build.gep(function.args[group], [INDEX(index)]))
        arguments = [values[argument.index] for argument in node.arguments]
        if node.operation == "less":
            return build.select(build.fcmp_ordered("<", *arguments[:2]), *arguments[2:])
        if node.operation in OPERATORS:
            return getattr(build, OPERATORS[node.operation])(*arguments)
        return build.call(self._library(node.operation), arguments)

    def _library(self, name: str) -> ir.Function:
        full = "llvm.sqrt.f64" if name == "sqrt" else name
        if full not in self._code.globals:
            library = ir.Function(self._code, ir.FunctionType(DOUBLE, [DOUBLE]), full)
            library.attributes.add("nounwind")
        return self._code.globals[full]

    def object_code(self) -> bytes:
        """Return the machine code for this processor."""
        # The time of optimised code generation grows with a power of the length of a function.
        machine = _target_machine(optimised=self.operations <= MAX_OPTIMISED)
        parsed = binding.parse_assembly(str(self._code))
        options = binding.create_pipeline_tuning_options(speed_level=2)
        passes = binding.create_pass_builder(machine, options)
        passes.getModulePassManager().run(parsed, passes)
        return bytes(machine.emit_object(parsed))


def digest_of(*parts: object) -> str:
    """Return a digest of `parts`, the processor and the version of LLVM: the key of machine code in the cache."""
    state = hashlib.blake2b(digest_size=16)
    for part in (*parts, binding.get_host_cpu_name(), _features(), binding.llvm_version_info):
        state.update(repr(part).encode() + b"\0")
    return state.hexdigest()


def load(code: bytes, names: Sequence[str]) -> Loaded:
    """Load machine code into memory.

    Args:
        code: result of `CodeModule.object_code`.
        names: names of its functions.
    """
    _target_machine()
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), _target_machine())
    engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return Loaded({name: engine.get_function_address(name) for name in names}, engine)


def read_or_compile(file: Path | None, compile_code: Callable[[], bytes]) -> bytes:
    """Return machine code from a cache file; if the file is absent or damaged, compile the code and write the file.

    Args:
        file: cache file, or None to compile without a cache. A file that cannot be written is not an error.
        compile_code: returns the machine code.
    """
    if file is not None:
        with contextlib.suppress(OSError):
            content = file.read_bytes()
            if content[:CHECK] == _check(content[CHECK:]):
                return content[CHECK:]
    code = compile_code()
    if file is not None:
        with contextlib.suppress(OSError, StorageError):
            write_bytes(file, _check(code) + code)
    return code


def _check(code: bytes) -> bytes:
    return hashlib.blake2b(code, digest_size=CHECK).digest()


def _target_machine(optimised: bool = True) -> Any:
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    return binding.Target.from_default_triple().create_target_machine(
        opt=2 if optimised else 0,
        cpu=binding.get_host_cpu_name(),
        features=_features(),
        reloc="pic",
        codemodel="jitdefault",
        jit=True,
    )


def _features() -> str:
    try:
        return str(binding.get_host_cpu_features().flatten())
    except RuntimeError:  # LLVM does not know them for every processor
        return ""


def _call(typing: Any, address: Any, parameters: Any, constants: Any, inputs: Any, results: Any) -> Any:
    """Emit the call of a `Loaded` function at an address, for code compiled by Numba."""
    signature = types.void(address, parameters, constants, inputs, results)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        arrays = zip(signature.args[1:], arguments[1:], strict=True)
        pointers = [context.make_array(kind)(context, builder, value).data for kind, value in arrays]
        kind = ir.FunctionType(VOID, [pointer.type for pointer in pointers])
        builder.call(builder.inttoptr(arguments[0], kind.as_pointer()), pointers)
        return context.get_dummy_value()

    return signature, generate


call: Any = intrinsic(_call)
"""Function ``call(address, parameters, constants, inputs, results)`` for code compiled by Numba."""
