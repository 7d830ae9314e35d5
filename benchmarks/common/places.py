"""Folders of the benchmarks' results and of the documents that quote them."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""Of the checkout."""
RESULTS = ROOT / "benchmarks" / "results"
DOCS = ROOT / "docs"
