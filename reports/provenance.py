"""Where the figures of a run come from: the command, the code, the machine, the settings."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from bench.neighbours import Neighbours
from reports.runs import Run


def facts(run: Run) -> dict[str, str]:
    """All provenance except the command and the settings, by name."""
    machine, record, row = run.record["machine"], run.record, run.facts
    memory = f"{machine['memory_bytes'] / 2**30:.0f} GiB"
    computed = {name: row[name] for name in ("device", "backend", "engine", "precision")}
    return {
        "run": run.key,
        "scene": f"{row['scene']}, digest {record['scene']['digest'][:16]}",
        "frames": f"{row['trajectory']} at {row['resolution']}",
        "protocol": _listed(record["protocol"]),
        "budget": _listed(record["budget"]),
        "seed": str(row["seed"]),
        "commit": row["commit"],
        "computed on": _listed(computed),
        "peak memory": record["peak_bytes"],
        "machine": f"{machine['cpu']}, {machine['threads']} threads, {memory}",
        "beside it": _beside(record),
        "GPU": ", ".join(machine["gpus"]) or "none",
        "system": f"{machine['system']}, Python {machine['python']}",
        "versions": _listed(record["made_of"].get("libraries", {})),
    }


def _beside(record: Mapping[str, Any]) -> str:
    """What other processes used while frames were timed; unknown for older runs and scores."""
    seen = record.get("neighbours")
    return str(Neighbours(**seen)) if seen else "not recorded"


def settings(run: Run) -> dict[str, str]:
    """The settings of the run's method, named as one types them, with their values.

    Empty for a run that steerbench did not measure.
    """
    config = run.record["made_of"].get("config", {})
    return dict(_flat("method", config.get("method", {})))


def _flat(name: str, value: Any) -> Iterator[tuple[str, str]]:
    if not isinstance(value, Mapping):
        yield name, str(value)
    else:
        for key, inner in value.items():
            if not key.startswith("_"):  # Hydra's own, such as `_target_`
                yield from _flat(f"{name}.{key}", inner)


def _listed(values: Mapping[str, Any]) -> str:
    return ", ".join(
        f"{name} {' + '.join(value) if isinstance(value, list) else value}"
        for name, value in values.items()
    )
