"""Thousands of random mutations of a tiny drive, a catalogue, a run's choices and a home, under limits."""

import os

# Before any library reads them: the cases run side by side, a process each.
for _name in ("NVSF_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[_name] = "1"
