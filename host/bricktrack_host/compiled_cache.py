"""Compiled code read back quickly: numba's own cache, without what only compiling needs.

Beside the machine code of a function, numba keeps its LLVM code, for others to take in when they are
compiled, and parses it whenever it loads the function: most of the time that this takes. It also makes itself
ready to compile, which takes as long as loading thirty functions does. Here both wait until something is
compiled. What is kept, for which processor, and when it is stale, are numba's matter as ever.
"""

from functools import cache
from typing import Any

from llvmlite import binding as llvm  # type: ignore[import-untyped]
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.runtime.nrt import rtsys

_Parts = tuple[Any, ...]


class _QuickImpl(CompileResultCacheImpl):
    """What is kept of a compiled function: numba's parts of it, and its LLVM code apart."""

    def reduce(self, cres: Any) -> tuple[_Parts, bytes]:
        """Return numba's parts, which hold no more of the LLVM code than its names, and that code."""
        parts: _Parts = super().reduce(cres)  # type: ignore[no-untyped-call]
        name, kind, (object_code, bitcode) = parts[0]
        return ((name, kind, (object_code, _names_alone(bitcode))), *parts[1:]), bitcode

    def rebuild(self, target_context: Any, reduced_data: tuple[_Parts, bytes]) -> Any:
        """Return the compiled function, which parses its LLVM code once another is to take it in."""
        parts, bitcode = reduced_data
        cres: Any = super().rebuild(target_context, parts)  # type: ignore[no-untyped-call]

        @cache
        def module_for_linking() -> Any:
            return llvm.parse_bitcode(bitcode)

        cres.library._get_module_for_linking = module_for_linking
        return cres


class QuickCache(FunctionCache):
    """Numba's cache of a function, which loads what was compiled before without being ready to compile."""

    _impl_class = _QuickImpl

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the function compiled for arguments of these types, or `None`."""
        rtsys.initialize(target_context)  # what code that counts references calls
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]


def _names_alone(bitcode: bytes) -> bytes:
    """Return LLVM code that defines the same names and stops the process if it is ever run."""
    whole = llvm.parse_bitcode(bitcode)
    lines = ["declare void @llvm.trap()"]
    lines += [
        f'define void @"{f.name}"() {{ call void @llvm.trap() unreachable }}'
        for f in whole.functions
        if not f.is_declaration
    ]
    lines += [f'@"{v.name}" = global i8 0' for v in whole.global_variables if not v.is_declaration]
    return bytes(llvm.parse_assembly("\n".join(lines)).as_bitcode())
