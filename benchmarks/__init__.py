"""Benchmarks of run time and memory, with one thread as in a campaign's worker unless stated otherwise."""

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "LP_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
