"""Types that many folders share."""

from collections.abc import Callable

Scalar = float | int | str | bool
"""One value of a table; its key names the unit."""
Say = Callable[[str], None]
"""Reports progress to the user, one line per call."""
