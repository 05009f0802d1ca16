"""`steerbench compare`: what changed from one run of the store to another."""

import argparse

from bench.results import Store
from reports.regression import Figures, change_table, changes
from reports.runs import load_runs
from reports.tables import decimal
from sweeps.terminal import console, show


def main(options: argparse.Namespace) -> int:
    """Print what the second of two runs of the store is, less the first; 1 if it is worse."""
    store = Store(options.outputs)
    keys = [store.whole_key(key) for key in (options.old, options.new)]
    old, new = load_runs(store, keys)
    rows = list(changes([Figures.of(old)], [Figures.of(new)]))
    show(change_table(" to ".join(keys), rows))
    between = decimal(old.psnr_to(new), 2)
    console().print(f"PSNR between the pictures that both kept: {between} dB", markup=False)
    return int(any(row.verdict for row in rows))
