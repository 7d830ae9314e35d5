"""Where benchmarks keep what they printed, and the documents that it stands in."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""Of the checkout."""
RESULTS = ROOT / "benchmarks" / "results"
DOCS = ROOT / "docs"
