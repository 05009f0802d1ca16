"""`steerbench score`: scores pictures of any program against true ones, under a named protocol."""

import argparse

from sweeps.scored import score
from sweeps.terminal import show_run


def main(options: argparse.Namespace) -> int:
    """Score the pictures, keep the rows in the store, print them."""
    words = {name: getattr(options, name) for name in ("name", "match", "sequence", "times")}
    run = score(options.pictures, options.truth, *options.overrides, **words)
    show_run(run, f"{run.label} on {run.facts['scene']}, protocol {run.facts['protocol']}")
    return 0
