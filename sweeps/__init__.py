"""What is varied: Hydra configurations and the `steerbench` command line.

It sets what torch and the memory allocator read when they are loaded, also in the processes of a
launcher.
"""

import os

from bench.allocator import keep_freed

# Two thread pools take turns here, torch's and numba's. A pool that spins while it waits keeps the
# other from its cores, one that sleeps at once is woken a thousand times a step: let it spin for
# some ten microseconds.
os.environ.setdefault("GOMP_SPINCOUNT", "20000")
keep_freed()
