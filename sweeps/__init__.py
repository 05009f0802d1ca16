"""Hydra configurations and the `steerbench` command line.

Importing it sets what torch and the memory allocator read when they are loaded, also in processes
that a launcher starts.
"""

import os

from bench.allocator import keep_freed

# Two thread pools take turns here, torch's and numba's. A pool that spins while idle blocks cores
# that the other needs; one that sleeps at once must be woken a thousand times per step. So let it
# spin for some ten microseconds.
os.environ.setdefault("GOMP_SPINCOUNT", "20000")
# Large tensors on pages of 2 MB: fewer pages to map, and fewer addresses to look up.
os.environ.setdefault("THP_MEM_ALLOC_ENABLE", "1")
keep_freed()
