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
    exact = encode(positions.double(), table.double(), GRID, backend="reference")
    packed = pack(table)
    formats = [
        Trial("float32", lambda: encode(positions, table, GRID), exact),
        Trial("packed bf16", lambda: encode(positions, table, GRID, packed=packed), exact),
    ]
    made = [Experiment("encoding: features, entries of -1 to 1", "table", formats)]

    field = HashField(GRID, precision="fp32", generator=generator).requires_grad_(False)
    field.table.copy_(table.bfloat16())
    rounded = HashField(GRID, precision="bf16").requires_grad_(False)
    rounded.load_state_dict(field.state_dict())
    rounded.repack()
    exact_field = copy.deepcopy(field).double()
    exact_field.backend = "reference"
    answers = _answers(exact_field, positions.double(), directions.double())
    for index, name in enumerate(("log density", "features")):
        trials = [
            Trial(kind, partial(_answer, of_kind, positions, directions, index), answers[index])
            for kind, of_kind in (("float32", field), ("bf16", rounded))
        ]
        made.append(Experiment(f"field: {name}", "networks", trials))
    return made


def _answer(field: HashField, positions: Tensor, directions: Tensor, index: int) -> Tensor:
    return _answers(field, positions, directions)[index]


def _answers(field: HashField, positions: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Log density [S] and features [S, K]."""
    sigma, geometry = field.density(positions)
    return sigma.log(), field.features(geometry, field.encode_directions(directions))
