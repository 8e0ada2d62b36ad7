"""Speed and memory, measured side by side in one run. One thread, as in a campaign's worker, if not told otherwise."""

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "LP_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")
