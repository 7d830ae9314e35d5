"""What a person sees: one line that rewrites itself on a terminal, few lines elsewhere."""

import io
import logging

import dagster as dg

from pipelines.terminal import ProgressHandler, terse_logger, with_bar


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def said(stream: io.StringIO, *lines: str) -> str:
    logger = logging.Logger("test")
    logger.addHandler(ProgressHandler(stream))
    for line in lines:
        logger.info(line)
    return stream.getvalue()


def test_a_terminal_s_progress_line_is_rewritten_and_what_is_done_stays():
    text = said(Terminal(), "[a] field: step 1/4", "[a] field: step 2/4", "[a] field: done in 3 s")
    assert text.count("\n") == 1 and text.endswith("\r\033[K[a] field: done in 3 s\n")
    assert "[##......] 1/4" in text


def test_elsewhere_progress_is_rare_and_what_is_done_is_all_there():
    lines = [f"[a] field: step {step}/900" for step in range(900)]
    text = said(io.StringIO(), *lines, "[a] field: done in 3 s", "[a] frames: up to date, skipped")
    assert len(text.splitlines()) == 3 and "\r" not in text


def test_warnings_are_never_left_out():
    stream = io.StringIO()
    logger = logging.Logger("test")
    logger.addHandler(ProgressHandler(stream))
    for number in range(3):
        logger.warning("something is wrong %d", number)
    assert len(stream.getvalue().splitlines()) == 3


def test_a_terminal_that_is_gone_stops_nothing(monkeypatch):
    monkeypatch.setattr(logging, "raiseExceptions", False)
    logger = logging.Logger("test")
    gone = Terminal()
    logger.addHandler(ProgressHandler(gone))
    gone.close()
    logger.info("[a] field: done in 3 s")


def test_a_line_that_counts_nothing_has_no_bar():
    assert with_bar("[a] mesh: started") == "[a] mesh: started"
    assert with_bar("[a] x: 16 of 16 frames") == "[a] x: [########] 16 of 16 frames"


def test_a_drive_s_words_neither_steer_a_terminal_nor_make_lines_of_their_own(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr("sys.stderr", stream)
    logger = terse_logger(dg.build_init_logger_context())
    logger.warning("camera \x1b]0;pwned\x07\nERROR all is lost left out")
    assert stream.getvalue().count("\n") == 1
    assert r"camera \x1b]0;pwned\x07\nERROR all is lost left out" in stream.getvalue()
