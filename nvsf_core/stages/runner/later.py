"""A function whose module is imported when it is needed: a list of the stages does not wait for torch."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True, slots=True)
class Later:
    """A function of a module that is not imported yet; called as the function itself."""

    module: str
    """Full name of the module."""
    function: str
    """Name of a function in it."""

    def load(self) -> Callable[..., Any]:
        """Import the module, unless it is, and return its function."""
        function: Callable[..., Any] = getattr(import_module(self.module), self.function)
        return function

    def __call__(self, *args: Any) -> Any:
        """Call the function."""
        return self.load()(*args)
