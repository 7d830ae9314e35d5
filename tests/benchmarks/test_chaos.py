"""The short form of chaos: what happens to a home loses nothing, and is said."""

import sys

from benchmarks.chaos import __main__ as chaos


def test_nothing_that_happens_to_a_home_loses_anything(run_process) -> None:
    done = run_process(sys.executable, "-m", "benchmarks.chaos", SHORT="1")
    assert done.returncode == 0, done.stdout + done.stderr
    said = {line.split("s  ", 1)[1].split(":")[0] for line in done.stdout.splitlines() if " s  " in line}
    assert {"kill_run", "harm_output", "changing_drive", "two_runs", "file_times", "same_time"} <= said


def test_asked_for_help_it_harms_nothing(monkeypatch, capsys) -> None:
    monkeypatch.setenv("MINUTES", "1")
    monkeypatch.setattr(sys, "argv", ["chaos", "-h"])
    assert chaos.main() == 0 and "takes MINUTES (default 60)" in capsys.readouterr().out
    monkeypatch.setattr(sys, "argv", ["chaos", "10"])
    assert chaos.main() == 2
