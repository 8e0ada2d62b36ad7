"""Benchmarks of run time and memory, with one thread as in a campaign's worker unless stated otherwise."""

import os

#: Variables that set the number of threads of the libraries.
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "LP_NUM_THREADS")
for _variable in THREAD_VARIABLES:
    os.environ.setdefault(_variable, "1")
