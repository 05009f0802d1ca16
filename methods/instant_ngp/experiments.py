"""Experiments on the number formats of a field: its table, its networks."""

from __future__ import annotations

import copy
from functools import partial

import torch
from torch import Tensor

from bench.accuracy import Experiment, Trial
from methods.instant_ngp.field import HashField
from methods.kernels.encode import HashGrid, encode, pack

SAMPLES = 1 << 16
GRID = HashGrid(log2_table=17)


def experiments() -> list[Experiment]:
    """One on the table alone; two on the networks alone, on a table that bfloat16 holds exactly."""
    generator = torch.Generator().manual_seed(0)
    table = torch.empty(GRID.entries, GRID.features).uniform_(-1, 1, generator=generator)
    positions = torch.rand(SAMPLES, 3, generator=generator)
    directions = torch.randn(SAMPLES, 3, generator=generator)
    field = HashField(GRID, precision="fp32", generator=generator).requires_grad_(False)
    field.table.copy_(table.bfloat16())
    return [_table(table, positions), *_networks(field, positions, directions)]


def _table(table: Tensor, positions: Tensor) -> Experiment:
    exact = encode(positions.double(), table.double(), GRID, backend="reference")
    packed = pack(table)
    trials = [
        Trial("float32", lambda: encode(positions, table, GRID), exact),
        Trial("packed bf16", lambda: encode(positions, table, GRID, packed=packed), exact),
    ]
    return Experiment("encoding: features, entries of -1 to 1", "table", trials)


def _networks(field: HashField, positions: Tensor, directions: Tensor) -> list[Experiment]:
    exact_field = copy.deepcopy(field).double()
    exact_field.backend = "reference"
    exact = _answers(exact_field, positions.double(), directions.double())
    fields = {"float32": field, "bf16": _in_bf16(field)}
    return [
        Experiment(
            f"field: {name}",
            "networks",
            [
                Trial(kind, partial(_answer, of_kind, positions, directions, index), exact[index])
                for kind, of_kind in fields.items()
            ],
        )
        for index, name in enumerate(("log density", "features"))
    ]


def _in_bf16(field: HashField) -> HashField:
    other = HashField(field.grid, field.channels, precision="bf16")
    other.load_state_dict(field.state_dict())
    other.repack()
    return other.requires_grad_(False)


def _answer(field: HashField, positions: Tensor, directions: Tensor, index: int) -> Tensor:
    return _answers(field, positions, directions)[index]


def _answers(field: HashField, positions: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Log density [S] and features [S, K]."""
    sigma, geometry = field.density(positions)
    return sigma.log(), field.features(geometry, field.encode_directions(directions))
