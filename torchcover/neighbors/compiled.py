"""Compilation of loops over arrays by numba (extra `fast`); importing this module fails without numba."""

import os
from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

NUMBA_CONFIG = ".numba_config.yaml"  # numba reads it in the working directory at import and at each compilation

# The file may name a cache folder, whose pickles would run as code. The working directory may be untrusted.
if os.path.lexists(NUMBA_CONFIG):
    raise ImportError(f"{NUMBA_CONFIG} in the working directory is not trusted; use environment variables instead")
try:
    import numba
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("backend 'packets' needs numba: pip install 'torchcover[fast]'") from error
if numba.config.DISABLE_JIT:
    raise ImportError("NUMBA_DISABLE_JIT is set")

# An array or a number of a type that the signature declares.
Array: TypeAlias = Any
Function = TypeVar("Function", bound=Callable[..., Any])


def compile_function(signature: str) -> Callable[[Function], Function]:
    """Return a decorator that compiles a function at import.

    The result is cached on disk if the folder of this file or NUMBA_CACHE_DIR can be written.

    Args:
        signature: Types of the arguments and the result, in numba's notation.
    """

    def compile_with_signature(function: Function) -> Function:
        # Sums are neither contracted nor reordered: a distance is the same in every loop.
        options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"nnan", "nsz"}}
        try:
            return numba.njit(signature, cache=True, **options)(function)  # type: ignore[no-any-return]
        except (RuntimeError, OSError):
            return numba.njit(signature, **options)(function)  # type: ignore[no-any-return]

    return compile_with_signature


def inline_function(function: Function) -> Function:
    """Copy a function into its callers; a call in the inner loop would take a third of the search time.

    Args:
        function: Function of arrays and numbers that numba can compile.
    """
    return numba.njit(inline="always")(function)  # type: ignore[no-any-return]
