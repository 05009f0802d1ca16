"""What is varied: Hydra configurations and the `steerbench` command line.

Here stands what its processes ask of their libraries, those of a launcher, too: torch, which is
loaded later, reads the environment once.
"""

import os

from bench.allocator import keep_freed

# Two thread pools take turns here, torch's and numba's. A pool that spins while it waits keeps the
# other from its cores, one that sleeps at once is woken a thousand times a step: let it spin for
# some ten microseconds.
os.environ.setdefault("GOMP_SPINCOUNT", "20000")
keep_freed()
