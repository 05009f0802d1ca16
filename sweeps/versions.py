"""Which of several runs of one job stands for it: code, libraries and machines change between runs,
and the store keeps them all."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

from bench.errors import some
from bench.kinds import Say
from bench.measure import measure
from bench.provenance import digest
from bench.results import Store
from reports.runs import Run, Runs, grouped, readable
from sweeps.measurement import job_key, targets


def standing(store: Store, say: Say) -> list[Run]:
    """One run of each job and scene in `store`, the one used last first.

    Of several versions the run of the present code stands; of several of these, or if there is
    none, the one used last. `say` gets a line on which were taken, and how many others there are.
    """

    def last_used(run: Run) -> float:
        return max(store.used(run.key)[0], run.record["stored"])

    in_order = sorted(readable(store), key=last_used, reverse=True)
    versions = grouped(in_order, lambda run: (_own_job(run), run.digest))
    taken: list[Run] = []
    said: list[str] = []
    for several in versions.values():
        first = several[0]
        if len(several) > 1:
            present = [run for run in several if is_present(run)]
            why = "of the present code" if present else "the one used last"
            first = [*present, first][0]
            said.append(f"{first.key} ({why}; {len(several) - 1} others)")
        taken.append(first)
    if said:
        say(f"several versions of a run: taken {some(said)}")
    return taken


def by_job(store: Store, say: Say) -> Mapping[str, Runs]:
    """The `standing` runs by the key of each job that asked for them.

    A job has several if its settings fit scenes in different folders.
    """
    of_jobs: dict[str, list[Run]] = {}
    for run in standing(store, say):
        for job in {_own_job(run), *store.used(run.key)[1]}:
            of_jobs.setdefault(job, []).append(run)
    return of_jobs


def _own_job(run: Run) -> str:
    """The key of the job whose settings a run was stored with; of scored pictures, the command."""
    parts = run.record["made_of"]
    if "config" not in parts:
        return run.command
    return job_key(parts["config"], parts.get("turns", ""))


def is_present(run: Run) -> bool:
    """Whether a run is of the code that is here now; not if that cannot be imported."""
    parts = run.record["made_of"]
    try:
        return "config" in parts and parts["code"] == _code(frozenset(targets(parts["config"])))
    except Exception:  # a plug-in of elsewhere, or one that is broken by now
        return False


@cache
def _code(things: frozenset[Any]) -> str:
    return digest(measure, *things)
