"""The one compiler switch all kernels share."""

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile a loop with numba, cached on disk where a cache can be written.

    Floating point stays strict (no ``fastmath``) so that results do not depend on the machine's
    vector width, and the interpreter lock is released so that threads run side by side.
    """
    compile_with = functools.partial(numba.njit, nogil=True, error_model="numpy")
    try:
        compiled = compile_with(cache=True)(function)
    except RuntimeError:  # no writable cache folder: compile in every process instead
        compiled = compile_with()(function)
    return cast(F, compiled)
