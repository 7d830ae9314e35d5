"""Seeds, from which all random numbers of a run are made."""

from nvsf_core.errors import RecipeError

MOST_SEED = 2**32 - 1
"""Largest seed that numpy, torch and a table's int64 column all accept."""


def require_seed(seed: object, what: str = "seed") -> int:
    """Return the seed, if it is valid.

    Raises:
        RecipeError: It is not a whole number from 0 to `MOST_SEED`.
    """
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed <= MOST_SEED:
        # Python refuses to write out a number of more than 4300 digits.
        is_huge = isinstance(seed, int) and not -MOST_SEED <= seed <= MOST_SEED
        found = "one that is far outside" if is_huge else f"{seed!r:.60}"
        raise RecipeError(f"{what}: expected a whole number from 0 to {MOST_SEED}, found {found}")
    return seed


def is_seed_folder(name: str) -> bool:
    """Whether a folder has the name of a seed's: its digits alone."""
    return name.isascii() and name.isdecimal() and len(name) <= 10 and str(int(name)) == name


def seed_from_text(text: str, what: str) -> int:
    """The seed in the text of an environment variable or an argument.

    Raises:
        RecipeError: It is no whole number from 0 to `MOST_SEED`.
    """
    # Longer texts are no seed, and Python refuses to read those of more than 4300 digits.
    is_whole = text.isascii() and text.isdecimal() and len(text) <= 20
    return require_seed(int(text) if is_whole else text, what)
