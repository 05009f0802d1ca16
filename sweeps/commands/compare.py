"""`steerbench compare`: what changed from one run of the store to another."""

from __future__ import annotations

import argparse

from bench.results import Store
from reports.regression import Figures, change_table, changes
from reports.runs import load_runs
from sweeps.terminal import show


def main(options: argparse.Namespace) -> int:
    """Print what the second of two runs of the store is, less the first; 1 if it is worse."""
    store = Store(options.outputs)
    keys = [store.whole_key(key) for key in (options.old, options.new)]
    old, new = (Figures.of(load_runs(store, {key: key})[0]) for key in keys)
    rows = list(changes([old], [new]))
    show(change_table(" to ".join(keys), rows))
    return int(any(row.verdict for row in rows))
