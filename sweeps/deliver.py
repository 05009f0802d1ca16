"""Where else a run in the store goes: to a tracker, and onto a page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from omegaconf import DictConfig

from bench.console import ConsoleLog
from bench.results import Store
from reports.runs import load
from reports.trackers import tracker
from sweeps import failures


def write(config: DictConfig, store: Store, labels: Mapping[str, str]) -> None:
    """Write the page that `config` asks for, if it does, about the runs that `labels` has names of,
    by key.

    Raises:
        SteerbenchError: the page cannot be written.
    """
    if not config.report:
        return
    from reports.page import write_page  # loads matplotlib, which only a page needs

    page = write_page(store, labels, Path(config.report))
    ConsoleLog(Path(config.outputs)).info(f"report: {page}")


def send(config: DictConfig, store: Store, run: str, label: str) -> None:
    """Send a run to the tracker of `config`, if it names one. Errors are only logged, because the
    measurement is valid."""
    if not config.tracker:
        return
    outputs = Path(config.outputs)
    log = ConsoleLog(outputs)
    try:
        tracker(config.tracker).send(load(store, {run: label})[0], outputs)
        log.info(f"sent to {config.tracker}: {run}")
    except Exception as error:  # third-party library: any exception
        log.info(f"not sent to {config.tracker}: {run}: {failures.reason(error)}")
