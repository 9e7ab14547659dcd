"""How loops over arrays are compiled: by numba, the extra `fast`. Where that is missing, importing this fails."""

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

try:
    import numba
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("backend 'packets' needs numba: pip install 'torchcover[fast]'") from error
if numba.config.DISABLE_JIT:
    raise ImportError("NUMBA_DISABLE_JIT is set")

# An array or a number of the type that the signature says.
Array: TypeAlias = Any
Function = TypeVar("Function", bound=Callable[..., Any])


def compile_function(signature: str) -> Callable[[Function], Function]:
    """Compile at once, and keep it on disk where a folder can be written (beside this file, or NUMBA_CACHE_DIR)."""

    def made(function: Function) -> Function:
        # Neither contraction nor another order of sums: a distance is the same whichever loop computes it.
        options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"nnan", "nsz"}}
        try:
            return numba.njit(signature, cache=True, **options)(function)  # type: ignore[no-any-return]
        except (RuntimeError, OSError):
            return numba.njit(signature, **options)(function)  # type: ignore[no-any-return]

    return made


def inline_function(function: Function) -> Function:
    """Copy it into the functions that call it; a call in the inner loop costs a third of the search."""
    return numba.njit(inline="always")(function)  # type: ignore[no-any-return]
