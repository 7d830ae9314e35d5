"""Harm a home at work, again and again, and look whether anything is lost: `make chaos MINUTES=60`."""
