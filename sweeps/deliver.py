"""Where else runs in the store go: to a tracker, and onto a page."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

from omegaconf import DictConfig

from bench.console import ConsoleLog
from bench.results import Store
from reports.runs import load
from reports.trackers import tracker
from sweeps.failures import reason


def write(
    report: str | None, store: Store, labels: Mapping[str, str], failed: Mapping[str, str] = {}
) -> None:
    """Write a page into the folder `report`, if there is to be one.

    Args:
        labels: the names of its runs, by key; without any, there is no page.
        failed: why other jobs failed, by name.

    Raises:
        SteerbenchError: the page cannot be written.
    """
    if report and labels:
        from reports.page import write_page  # loads matplotlib, which only a page needs

        print(f"report: {write_page(store, labels, Path(report), failed)}", file=sys.stderr)


def send(config: DictConfig, store: Store, run: str, label: str) -> None:
    """Send a run to the tracker of `config`, if it names one. Errors are only logged, because the
    measurement is valid."""
    if not config.tracker:
        return
    outputs = Path(config.outputs)
    log = ConsoleLog(outputs)
    try:
        tracker(config.tracker)(load(store, {run: label})[0], outputs)
        log.info(f"sent to {config.tracker}: {run}")
    except Exception as error:  # third-party library: any exception
        log.info(f"not sent to {config.tracker}: {run}: {reason(error)}")
