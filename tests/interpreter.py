"""Triton's interpreter, as unforgiving as a GPU: any order of programs, no race or stray access."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from torch import Tensor

READ, WRITE, ATOMIC = 0, 1, 2


class Launch:
    """What the programs of one launch of a kernel read and write."""

    def __init__(self, tensors: list[Tensor], random: np.random.Generator) -> None:
        self._random = random
        ranges = sorted(_range(x) for x in tensors if x.numel())
        self._begins, self._ends = np.array(ranges, np.uint64).reshape(-1, 2).T
        self._program = 0
        self._accesses: list[np.ndarray] = []  # address, program and kind: [N, 3]

    def ordered(self, *grid: int) -> None:
        self.grid, self._order = grid, self._random.permutation(int(np.prod(grid)))

    def next(self, *place: int) -> tuple[int, ...]:
        """The program that is run when it is the turn of the one at `place`."""
        self._program = int(self._order[np.ravel_multi_index(place, self.grid)])
        return tuple(map(int, np.unravel_index(self._program, self.grid)))

    def access(self, pointers: Any, mask: Any, kind: int) -> None:
        """Raises IndexError if a lane that is not masked leaves the tensors."""
        size = np.uint64(max(1, pointers.get_element_ty().primitive_bitwidth // 8))
        address = np.broadcast_to(pointers.data, np.shape(mask.data))[mask.data].ravel()
        of = np.searchsorted(self._begins, address, side="right").astype(int) - 1
        if (of < 0).any() or (address + size > self._ends[of]).any():
            raise IndexError("an access outside of all tensors")
        rows = np.empty((len(address), 3), np.int64)
        rows[:, 0], rows[:, 1], rows[:, 2] = address, self._program, kind
        self._accesses.append(rows)

    def finish(self) -> None:
        """Raises RuntimeError if a program writes what another one reads or writes, but for atomic
        operations on both sides."""
        if not self._accesses:
            return
        rows = np.unique(np.concatenate(self._accesses), axis=0)
        first = np.flatnonzero(np.diff(rows[:, 0], prepend=-1))  # of each address
        programs, kinds = rows[:, 1], 1 << rows[:, 2]
        several = np.minimum.reduceat(programs, first) != np.maximum.reduceat(programs, first)
        kind = np.bitwise_or.reduceat(kinds, first)
        written = (kind & 1 << WRITE > 0) | ((kind & 1 << ATOMIC > 0) & (kind & 1 << READ > 0))
        if (several & written).any():
            raise RuntimeError("a race of two programs")


def _range(tensor: Tensor) -> tuple[int, int]:
    """Addresses of its first byte and behind its last one."""
    steps = zip(tensor.shape, tensor.stride(), strict=True)
    last = sum((size - 1) * step for size, step in steps)
    return tensor.data_ptr(), tensor.data_ptr() + (last + 1) * tensor.element_size()


@contextmanager
def unforgiving(seed: int = 0) -> Iterator[None]:
    """Inside, every launch of a kernel that is interpreted is looked at; without Triton, nothing
    is."""
    try:
        from triton.runtime.interpreter import GridExecutor, InterpreterBuilder
    except ImportError:
        yield
        return
    random = np.random.default_rng(seed)
    launches: list[Launch] = []
    run, ordered = GridExecutor.__call__, InterpreterBuilder.set_grid_dim
    place, load = InterpreterBuilder.set_grid_idx, InterpreterBuilder.create_masked_load
    store, add = InterpreterBuilder.create_masked_store, InterpreterBuilder.create_atomic_rmw

    def launched(self: Any, *args: Any, **kwargs: Any) -> None:
        launches.append(Launch([x for x in args if isinstance(x, Tensor)], random))
        run(self, *args, **kwargs)
        launches.pop().finish()

    def set_grid_dim(self: Any, *grid: int) -> None:
        launches[-1].ordered(*grid)
        ordered(self, *grid)

    def set_grid_idx(self: Any, *at: int) -> None:
        place(self, *launches[-1].next(*at))

    def create_masked_load(self: Any, pointers: Any, mask: Any, *rest: Any) -> Any:
        launches[-1].access(pointers, mask, READ)
        return load(self, pointers, mask, *rest)

    def create_masked_store(self: Any, pointers: Any, value: Any, mask: Any, *rest: Any) -> Any:
        launches[-1].access(pointers, mask, WRITE)
        return store(self, pointers, value, mask, *rest)

    def create_atomic_rmw(
        self: Any, kind: Any, pointers: Any, value: Any, mask: Any, *rest: Any
    ) -> Any:
        launches[-1].access(pointers, mask, ATOMIC)
        return add(self, kind, pointers, value, mask, *rest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(GridExecutor, "__call__", launched)
        accesses = create_masked_load, create_masked_store, create_atomic_rmw
        for own in (set_grid_dim, set_grid_idx, *accesses):
            patch.setattr(InterpreterBuilder, own.__name__, own)
        yield
