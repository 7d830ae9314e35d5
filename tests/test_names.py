"""Nothing that a terminal obeys, or cannot write, is left in a printed line."""

from nvsf_core.names import printable


def test_words_of_any_script_are_left_as_they_are() -> None:
    assert printable("Straße 3, 東京\u3000駅: 4.5\xa0m²") == "Straße 3, 東京\u3000駅: 4.5\xa0m²"


def test_what_a_terminal_obeys_is_escaped() -> None:
    assert printable("\x1b]0;pwned\x07\nError: fine\u202e") == r"\x1b]0;pwned\x07\nError: fine\u202e"
    assert printable("\ud800 \udcff").encode() == rb"\ud800 \udcff"
    assert printable(printable("\x1b[2J")) == r"\x1b[2J"
