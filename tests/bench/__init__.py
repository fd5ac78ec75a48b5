"""Measurements of speed and accuracy, one module each."""

import os

for library in ("OPENBLAS", "MKL", "OMP"):  # one thread, as in the program; before numpy loads
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")
