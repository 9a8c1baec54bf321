"""Functions that JAX traces once, though a program calls them in many places."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def trace_once(
    *static_names: str,
) -> Callable[[Callable[Parameters, Result]], Callable[Parameters, Result]]:
    """Makes a decorator: a function that is called with arrays of the same shapes again is not traced again.

    Tracing the renderer or inverse kinematics takes seconds, and a program calls each in several places. `jax.jit`
    keeps the trace, and XLA inlines the calls, so the compiled program is the same. The platform is a part of the key,
    because some functions choose block sizes by `jax.default_backend()`. What else the function reads must not change;
    who changes it in a test or a measurement calls `jax.clear_caches()`.

    Args:
      *static_names: names of the parameters that are not arrays. Their values must be hashable.

    Returns:
      The decorator.
    """

    def decorate(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
        signature = inspect.signature(function)
        of_bound: Callable[..., Result] = function

        def run(platform: str, *args: object) -> Result:
            del platform  # part of the key only
            return of_bound(*args)

        run.__name__ = function.__name__  # the name of the function in the lowered program
        static = [i + 1 for i, name in enumerate(signature.parameters) if name in static_names]
        jitted = jax.jit(run, static_argnums=(0, *static))

        @functools.wraps(function)
        def wrapped(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
            bound = signature.bind(*args, **kwargs)
            bound.apply_defaults()
            return jitted(jax.default_backend(), *bound.args)

        return wrapped

    return decorate
