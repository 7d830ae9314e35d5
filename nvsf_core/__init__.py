"""NVSF: recorded drive in, measured synthetic drive out. The science, without Dagster."""

__version__ = "0.1.0"
