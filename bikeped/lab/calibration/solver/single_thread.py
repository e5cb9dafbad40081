"""One thread for the linear algebra of the fit.

Its matrices are small: handing them to a second thread costs more than it saves, some twenty times
over where others use the processor as well.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar

F = TypeVar("F", bound=Callable[..., Any])


def one_thread(function: F) -> F:
    """Runs the function with the linear algebra pinned to one thread, and gives it back after."""

    @functools.wraps(function)
    def pinned(*given: Any, **named: Any) -> Any:
        controller = _controller()
        if controller is None:
            return function(*given, **named)
        with controller.limit(limits=1, user_api="blas"):
            return function(*given, **named)

    return pinned  # type: ignore[return-value]


@functools.cache
def _controller() -> Any:
    """Looks the libraries up once; None without threadpoolctl (the command then pins them by
    environment, before they are loaded)."""
    try:
        from threadpoolctl import ThreadpoolController
    except ImportError:
        return None
    return ThreadpoolController()
