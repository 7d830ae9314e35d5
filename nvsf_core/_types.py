"""Types that many folders share."""

from collections.abc import Callable

Scalar = float | int | str | bool
"""One figure of a table, its unit in the key that it stands under."""
Say = Callable[[str], None]
"""Takes one line a time for the person who waits."""
