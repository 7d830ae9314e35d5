"""Runs the tests that use a CUDA device, in a process of their own."""

import subprocess
import sys
import tempfile
from pathlib import Path
from xml.etree import ElementTree

from benchmarks.common.documents import ROOT, Row
from benchmarks.gpu.plan import Plan


def test_rows(plan: Plan) -> list[Row]:
    """One row: how many passed and were skipped, seconds, and the names of those that failed."""
    with tempfile.TemporaryDirectory() as name:
        report = Path(name) / "report.xml"
        command = ("-m", "pytest", "-p", "no:cacheprovider", f"--junitxml={report}", *plan.tests)
        subprocess.run([sys.executable, *command], cwd=ROOT, check=False)
        suite = next(ElementTree.parse(report).getroot().iter("testsuite"))
    counts = {key: int(suite.attrib[key]) for key in ("tests", "failures", "errors", "skipped")}
    broken = [
        f"{case.attrib['classname']}.{case.attrib['name']}"
        for case in suite.iter("testcase")
        if case.find("failure") is not None or case.find("error") is not None
    ]
    left = counts["failures"] + counts["errors"] + counts["skipped"]
    return [
        {
            "tests": ", ".join(plan.tests), "passed": counts["tests"] - left, "skipped": counts["skipped"],
            "failed": broken, "seconds": float(suite.attrib["time"]),
        }
    ]  # fmt: skip
