"""`steerbench`, killed at a chosen change of its files: `python -P mortal.py NUMBER ARGV...`

The changes are those below `outputs` of the working directory, from 1, so that the same start
always ends at the same place; 0 lets it end by itself and prints how many there were. Trainings
leave a checkpoint behind at every step.
"""

import os
import signal
import sys
from itertools import count
from pathlib import Path

from methods.training import loop
from sweeps import cli

CHANGES = ("os.mkdir", "os.rename", "os.remove", "os.rmdir")
"""Python's audit events of changes, beside opening a file to write it."""


def main(last: int, argv: list[str]) -> int:
    """Run the command `argv` up to the change `last`, which does not happen any more."""
    outputs, numbers = Path("outputs").resolve(), count(1)

    def audit(event: str, arguments: tuple[object, ...]) -> None:
        written = event == "open" and str(arguments[1]).startswith("w")
        place = arguments[0] if written or event in CHANGES else None
        below = isinstance(place, str | Path) and Path(place).absolute().is_relative_to(outputs)
        if below and next(numbers) == last:
            os.kill(os.getpid(), signal.SIGKILL)

    loop.CHECKPOINT_S = -1.0
    sys.addaudithook(audit)
    status = cli.guard(cli.dispatch, argv)
    print(next(numbers) - 1)
    return status


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), sys.argv[2:]))
