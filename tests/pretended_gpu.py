"""A pretended GPU: what is meant for CUDA runs here, with numbers that lie on the CPU.

A tensor on `cuda:0` holds one on the CPU. Python sees the GPU, torch's C++ code the CPU,
because a torch without CUDA cannot differentiate anywhere else. Every operation is computed
on what its tensors hold, after it was checked for what CUDA refuses: tensors or random numbers of
two devices, `.numpy()`, a tensor of the CPU in a Triton kernel, and waiting while a graph is
captured. `torch.cuda.set_sync_debug_mode` tells of every operation for which the host waits;
`launched` counts kernels of torch and of Triton.

Not pretended: time, memory, streams, the order of atomics, types that CUDA has no kernel for, which
operations autocast lowers there, and Triton's compiler. Only one thread sees the GPU.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from bench import isolation
from methods.kernels.dispatch import availability, multiplies_bf16

GPU, CPU = torch.device("cuda", 0), torch.device("cpu")

TORCH = str(Path(torch.__file__).parent)
AUTOGRAD = torch.autograd.graph.__file__
"""Where Python hands a backward pass to C++."""

KNOWN_TO_HOST = {
    *("_local_scalar_dense", "is_nonzero", "equal", "_linalg_check_errors", "nonzero", "bincount"),
    *("masked_select", "_unique2", "unique_dim", "unique_consecutive"),
}
"""Operations of which the host has to know the result, or its size."""

INDEXED = {"index", "_unsafe_index", "index_put", "index_put_", "_index_put_impl_"}


class GpuTensor(Tensor):
    """A tensor that says it is on `cuda:0`, around the CPU tensor `held`."""

    held: Tensor
    device, is_cuda, is_cpu = GPU, True, False

    @staticmethod
    def __new__(cls, held: Tensor) -> GpuTensor:
        new = Tensor._make_wrapper_subclass(
            cls,
            held.shape,
            strides=held.stride(),
            storage_offset=held.storage_offset(),
            dtype=held.dtype,
            device=CPU,
        )
        new.held = held
        return new

    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        before, _gpu.inside = _gpu.inside, _kind(kwargs.get("device")) != "cpu"
        try:
            with torch._C.DisableTorchFunctionSubclass():
                return func(*args, **kwargs)
        finally:
            _gpu.inside = before

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        raise RuntimeError(f"{func}: the pretended GPU is gone, or in another thread")

    def backward(self, *args: Any, **kwargs: Any) -> None:
        """Outside of `__torch_function__`: what Python makes on the way is not made by C++."""
        _gpu.differentiating = True
        try:
            torch.autograd.backward(self, *args, **kwargs)
        finally:
            _gpu.differentiating = False

    def numpy(self, *args: object, **kwargs: object) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    __array__ = numpy

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def new_tensor(self, data: Any, **kwargs: Any) -> Tensor:
        return torch.tensor(data, **{"dtype": self.dtype, "device": GPU} | kwargs)

    def untyped_storage(self) -> torch.UntypedStorage:
        return self.held.untyped_storage()


class Graph(list[tuple[Callable[..., Any], tuple, dict, Any]]):
    """The operations that were captured, with their results."""

    def replay(self) -> None:
        """Compute them again, into the same memory."""
        for func, args, kwargs, results in self:
            again = _tensors([func(*args, **kwargs)])
            for old, new in zip(_tensors([results]), again, strict=True):
                if old.data_ptr() != new.data_ptr():
                    old.copy_(new)


class Event:
    """A moment: the host waits for it, unless it has waited for anything since."""

    def __init__(self, gpu: PretendedGpu) -> None:
        self._gpu, self._before = gpu, gpu.waited

    def synchronize(self) -> None:
        if self._gpu.waited == self._before:
            self._gpu.wait()


class PretendedGpu(TorchDispatchMode):
    """Computes every operation of torch, those of the CPU as if it were not there."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # nothing is compiled, and to import the compiler takes seconds

    def __init__(self) -> None:
        super().__init__()
        self.generators: dict[int, torch.Generator] = {}  # kept: the address of one is its key
        self.sync_debug_mode = self.waited = self.launched = 0
        self.graph: Graph | None = None
        self.inside = False  # a function that works on the GPU: what C++ makes belongs there
        self.differentiating = False  # the same of C++ alone, but not of Python that it calls

    @contextmanager
    def capturing(self, graph: Graph, **options: object) -> Iterator[None]:
        """As `torch.cuda.graph`."""
        self.graph = graph
        try:
            yield
        finally:
            self.graph = None

    def wait(self) -> None:
        """The host waits for the GPU: refused while a graph is captured."""
        self.waited += 1
        if self.graph is not None:
            raise RuntimeError("CUDA error: operation not permitted when stream is capturing")
        message = "called a synchronizing CUDA operation"
        if self.sync_debug_mode == 2:
            raise RuntimeError(message)
        if self.sync_debug_mode == 1:
            frame = _caller(TORCH)
            warnings.warn_explicit(message, UserWarning, frame.f_code.co_filename, frame.f_lineno)

    def moved(self, tensor: Tensor, device: torch.device, waits: bool = True) -> Tensor:
        if tensor.requires_grad and torch.is_grad_enabled():
            raise NotImplementedError("the pretended GPU differentiates no copies between devices")
        if waits:
            self.wait()
        copy = _held(tensor).detach().clone()
        return GpuTensor(copy) if device.type == "cuda" else copy

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        tensors = _tensors((args, *kwargs.values()))
        ours = [x for x in tensors if isinstance(x, GpuTensor)]
        on_gpu = self._computes(kwargs.get("device"), tensors, ours)
        if ours:
            others = [x for x in tensors if not isinstance(x, GpuTensor)]
            self._refuse_or_wait(func, args, kwargs, others)
        generator = kwargs.get("generator")
        if generator is not None and (generator._cdata in self.generators) != on_gpu:
            raise RuntimeError("the random numbers and their generator are on two devices")
        if _kind(kwargs.get("device")) == "cuda":
            kwargs = {**kwargs, "device": CPU}
        inputs = {id(_held(x)): x for x in tensors}
        args = _each(_held, args)
        kwargs = {name: _each(_held, x) for name, x in kwargs.items()}
        results = func(*args, **kwargs)
        self.launched += on_gpu and _computes(func, args, results)
        if self.graph is not None and on_gpu:
            self.graph.append((func, args, kwargs, results))

        def returned(x: Tensor) -> Tensor:
            """What was changed in place is the same object as before."""
            return inputs[id(x)] if id(x) in inputs else GpuTensor(x) if on_gpu else x

        return _each(returned, results)

    def _computes(self, device: Any, tensors: list[Tensor], ours: list[Tensor]) -> bool:
        """Whether an operation of `tensors` that was asked for on `device` gives one on the GPU."""
        if _kind(device) != "cpu":
            return bool(ours) if device is None else _kind(device) == "cuda"
        # Python asks for the CPU where it says nothing, C++ where it saw the tensors that we hold.
        inside = self.inside or (self.differentiating and _caller().f_code.co_filename == AUTOGRAD)
        return inside and (bool(ours) or not tensors)

    def _refuse_or_wait(self, func: Any, args: Any, kwargs: Any, others: list[Tensor]) -> None:
        """What an operation of our tensors does with `others`, of the CPU, and for the host."""
        name, first = func.overloadpacket.__name__, args[0]
        summed = name == "repeat_interleave" and kwargs.get("output_size") is None
        if summed or name in KNOWN_TO_HOST:
            self.wait()
        elif name == "copy_" and others:
            return self.wait()
        elif name == "_has_compatible_shallow_copy_type":
            return None  # a module that moves asks this of a parameter here and there
        elif name == "where":
            for _ in others:
                self.wait()  # for a number of the CPU, which is copied
        elif name in INDEXED and isinstance(first, GpuTensor):
            others = self._wait_for_indices(args, others)
        changed = func._schema.is_mutable and isinstance(first, Tensor) and _held(first) is first
        if changed or any(x.dim() or name in ("cat", "stack") for x in others):
            raise RuntimeError(f"Expected all tensors to be on the same device: {func}")
        return None

    def _wait_for_indices(self, args: Any, others: list[Tensor]) -> list[Tensor]:
        """Wait for the number of true ones in a mask, and for what is copied from the CPU: indices
        and a number to be put; return the rest of `others`."""
        indices = [x for x in args[1] if x is not None]
        masks = [x for x in indices if x.dtype in (torch.bool, torch.uint8)]
        numbers = [x for x in others if len(args) > 2 and x is args[2] and not x.dim()]
        if not (numbers and len(masks) == len(indices) == 1):  # else the mask is filled
            for _ in [*masks, *numbers, *(x for x in indices if not isinstance(x, GpuTensor))]:
                self.wait()
        return [x for x in others if len(args) > 2 and x is args[2]]


_gpu: PretendedGpu
"""The one there is."""


def _each(function: Callable[[Tensor], Tensor], x: Any) -> Any:
    if isinstance(x, Tensor):
        return function(x)
    return type(x)([_each(function, part) for part in x]) if isinstance(x, list | tuple) else x


def _tensors(x: Iterable[Any]) -> list[Tensor]:
    found: list[Tensor] = []
    for part in x:
        if isinstance(part, Tensor):
            found.append(part)
        elif isinstance(part, list | tuple):
            found += _tensors(part)
    return found


def _computes(func: Any, args: Any, results: Any) -> bool:
    """Whether an operation launches a kernel: it makes more than memory or a view."""
    if func._schema.is_mutable or "empty" in func.overloadpacket.__name__:
        return func._schema.is_mutable
    known = {x.untyped_storage().data_ptr() for x in _tensors(args)}
    return any(
        x.numel() and x.untyped_storage().data_ptr() not in known for x in _tensors([results])
    )


def _held(x: Tensor) -> Tensor:
    return x.held if isinstance(x, GpuTensor) else x


def _kind(device: Any) -> str | None:
    return None if device is None else torch.device(device).type


def _caller(*but: str) -> FrameType:
    """The innermost frame outside of this file and of files whose paths begin with `but`."""
    frame = sys._getframe(1)
    while frame.f_code.co_filename.startswith((__file__, *but)):
        assert frame.f_back is not None
        frame = frame.f_back
    return frame


@contextmanager
def pretended_gpu() -> Iterator[PretendedGpu]:
    """Everything in here, in this thread, sees a GPU."""
    global _gpu
    _gpu = PretendedGpu()
    with pytest.MonkeyPatch.context() as patch:
        for name, what in _of_torch_cuda(_gpu).items():
            patch.setattr(torch.cuda, name, what)
        _patch_torch(patch, _gpu)
        _patch_triton(patch)
        for cached in (availability, multiplies_bf16):
            cached.cache_clear()
        with _gpu:
            yield _gpu
    for cached in (availability, multiplies_bf16):
        cached.cache_clear()


def _of_torch_cuda(gpu: PretendedGpu) -> dict[str, Any]:
    modes = {"default": 0, "warn": 1, "error": 2}

    def set_sync_debug_mode(mode: int | str) -> None:
        gpu.sync_debug_mode = modes[mode] if isinstance(mode, str) else mode

    return {
        "_lazy_init": lambda: None,
        "is_available": lambda: True,
        "device_count": lambda: 1,
        "get_device_name": lambda *device: "pretended GPU",
        "get_device_properties": lambda *device: SimpleNamespace(uuid="pretended"),
        "is_bf16_supported": lambda **kwargs: multiplies_bf16("cpu"),
        "max_memory_allocated": lambda *device: 1,
        "reset_peak_memory_stats": lambda *device: None,
        "synchronize": lambda *device: None,
        "set_sync_debug_mode": set_sync_debug_mode,
        "get_sync_debug_mode": lambda: gpu.sync_debug_mode,
        "device_of": lambda tensor: nullcontext(),
        "Stream": MagicMock,
        "current_stream": lambda *device: MagicMock(record_event=lambda: Event(gpu)),
        "stream": lambda stream: nullcontext(),
        "graph_pool_handle": lambda: None,
        "CUDAGraph": Graph,
        "graph": gpu.capturing,
    }


def _patch_torch(patch: pytest.MonkeyPatch, gpu: PretendedGpu) -> None:
    """What makes and moves tensors, and what asks C++, which sees the CPU, for their device."""
    convert, make, lower = Tensor.to, torch.tensor, torch.autocast.__init__

    def to(self, *args, copy=False, **kwargs):
        if args and isinstance(args[0], Tensor):
            args = args[0].device, args[0].dtype, *args[1:]
        device, dtype, non_blocking, layout = torch._C._nn._parse_to(*args, **kwargs)
        layout = layout or torch.preserve_format
        new = convert(self, dtype=dtype or self.dtype, copy=copy, memory_format=layout)
        if device is None or device.type in (self.device.type, "meta"):
            return new if device is None or device.type != "meta" else convert(new, device)
        return gpu.moved(new, device, waits=not non_blocking)

    def tensor(data, *, device=None, **kwargs):
        if _kind(device) == "cuda":
            return make(data, **kwargs).to(GPU)
        return make(data, device=device, **kwargs)

    class Generator(torch.Generator):
        device = property(lambda self: GPU if self._cdata in gpu.generators else CPU)

        def __new__(cls, device="cpu"):
            new = super().__new__(cls)
            if _kind(device) == "cuda":
                gpu.generators[new._cdata] = new
            return new

    def autocast(self, device_type, *args, **kwargs):
        lower(self, "cpu", *args, **kwargs)

    # By these, Adam learns whether it is captured; a CUDA build without a driver would fail.
    stream = SimpleNamespace(is_capturing=lambda: gpu.graph is not None)
    patch.setattr(torch.accelerator, "current_accelerator", lambda *args, **kwargs: GPU)
    patch.setattr(torch.accelerator, "current_stream", lambda *device: stream)
    patch.setattr(isolation, "ORIGINALS", {})  # what is replaced here is no fault
    patch.setattr(Tensor, "to", to)
    patch.setattr(Tensor, "cuda", lambda self, *args, **kwargs: self.to(GPU))
    patch.setattr(Tensor, "cpu", lambda self, *args, **kwargs: self.to(CPU))
    patch.setattr(torch, "tensor", tensor)
    patch.setattr(torch, "Generator", Generator)
    # So that a module moves to the GPU and back in place, as it does on a real one.
    patch.setattr(torch.__future__, "get_swap_module_params_on_conversion", lambda: True)
    patch.setattr(torch.autocast, "__init__", autocast)


def _patch_triton(patch: pytest.MonkeyPatch) -> None:
    """Where Triton is installed, its interpreter takes tensors of the GPU, and no others."""
    try:
        from triton.runtime.interpreter import GridExecutor
    except ImportError:
        return
    run = GridExecutor.__call__

    def launch(self, *args, **kwargs):
        if any(isinstance(x, Tensor) and not isinstance(x, GpuTensor) for x in args):
            raise ValueError("Pointer argument cannot be accessed from Triton (cpu tensor?)")
        launched = _gpu.launched + 1  # one, whatever the interpreter does
        run(self, *_each(_held, args), **kwargs)
        _gpu.launched = launched

    patch.setattr(GridExecutor, "__call__", launch)
