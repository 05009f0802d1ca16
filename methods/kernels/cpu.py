"""Functions shared by the numba backends, and how all of theirs are compiled.

The process that compiles a function runs a different copy than processes that load it from the
cache: LLVM has optimised one of them twice. Where it may choose how to round, the copies can differ
in the last bit, and a training is then not repeatable. So `fastmath` allows "contract" only where
there is one way to contract, as in a sum of products, and "reassoc" only where both copies were
seen to give the same bits in all cases of the kernel.
"""

import math
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba import types
from numba.core import cgutils
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.extending import intrinsic
from numba.np.arrayobj import make_array
from torch import Tensor
from torch.nn import functional

from bench.provenance import digest
from methods.kernels.types import PARALLEL

f32, f64, i32, u32 = np.float32, np.float64, np.int32, np.uint32

u64 = np.uint64
"""Type of an index that cannot count from the end; numba tests every other computed index."""

ROWS = 6
"""Rows that `six` computes together: 6 x 16 sums fill 12 of the 16 vector registers of AVX2."""

TALL = 12 if get_host_cpu_features().get("avx512f") else ROWS
"""Rows that `tall` computes together: AVX-512 has 32 registers, each as wide as 16 sums."""

FAST = {"contract", "reassoc", "nsz", "arcp"}
"""Flags of fastmath: reordering and fused multiply-adds are allowed; assuming that there is no NaN
is not."""

FOLDER = "machine-code-"  # begins the names of the folders in which it is kept

LANES = 16  # outputs that both compute together

WORDS = 16  # numbers of 32 bits in a cache line

# e^x = 2^n e^r with n the whole number nearest to x / ln 2. ln 2 in two parts: n times the first is
# exact. e^r = 1 + r + r^2 (E0 + r (E1 + r (E2 + r (E3 + r E4)))), |r| <= ln 2 / 2: a minimax fit,
# off by less than 4e-9 before rounding.
PER_LN2, LN2_HIGH = f32(1 / math.log(2)), f32(0.693359375)
LN2_LOW = f32(math.log(2) - 0.693359375)
E0, E1, E2 = f32(0.4999999345167996), f32(0.16666520689635406), f32(0.04166838736699141)
E3, E4 = f32(0.00836870984251644), f32(0.0013814612983532846)
WHOLE = f32(1.5 * 2**23)
"""Adding it rounds a float32 below 2^22 to a whole number, which its last bits then hold."""

ONE_BITS = u32(0x3F800000)  # of 1.0; n added to its exponent makes 2^n

EDGE = f32(87)  # beyond this exponent, `exp` is held: e^87 is a little below the largest float32


def follow_torch_threads() -> None:
    """Run the kernels on as many threads as torch uses, up to those that numba has started."""
    threads = torch.get_num_threads()
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))
    if torch.get_num_threads() != threads:  # numba changed it on starting its threads
        torch.set_num_threads(threads)


def check_float32(*tensors: Tensor) -> None:
    """Raise ValueError unless all are of float32, in which these kernels compute."""
    if wrong := {tensor.dtype for tensor in tensors} - {torch.float32}:
        raise ValueError(
            f"backend 'cpu' computes with float32, got {wrong}: use backend='reference'"
        )


def arrays(*tensors: Tensor) -> list[np.ndarray]:
    """The numbers of each tensor, as numpy sees them; contiguous, so a copy of one that is not."""
    return [tensor.detach().contiguous().numpy() for tensor in tensors]


def flat(*tensors: Tensor) -> list[np.ndarray]:
    """As `arrays`, each in one dimension."""
    return [array.reshape(-1) for array in arrays(*tensors)]


def whole_lanes(tensor: Tensor) -> Tensor:
    """The last dimension filled up with zeros to a multiple of `LANES`."""
    idle = -tensor.shape[-1] % LANES
    return functional.pad(tensor, (0, idle)) if idle else tensor


class _Kept(FunctionCache):
    """The machine code of a function, in a folder that is named after the digest of all files that
    it comes from; numba's own cache looks at one file. Folders of other code are removed."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        sources = digest(function)
        self._folder = Path(self.cache_path) / f"{FOLDER}{sources[:16]}"
        names = str(self._folder), self._impl.filename_base
        self._cache_file = IndexDataCacheFile(*names, sources)

    def save_overload(self, *compiled: Any) -> None:
        """As numba's, unless a process with other code removes the folder at this moment."""
        if not self._folder.exists():
            for other in Path(self.cache_path).glob(f"{FOLDER}*"):
                shutil.rmtree(other, ignore_errors=True)
        with suppress(FileNotFoundError):
            self._folder.mkdir(exist_ok=True)
            super().save_overload(*compiled)


def is_kept(function: Any) -> bool:
    """Whether there is machine code of `function`, and of the others of its module."""
    kept = getattr(function, "_cache", None)
    return isinstance(kept, _Kept) and kept._folder.exists()


def jit(**options: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """As `numba.njit` with these `options`. The machine code is kept for other processes, until a
    file changes that it may come from: that of the function, or one that this file imports."""

    def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
        dispatcher = numba.njit(**options)(function)
        dispatcher._cache = _Kept(function)
        return dispatcher

    return compiled


@jit(error_model="numpy")
def exp(x):
    """e^x of a float32 to 3 u, for -87 <= x <= 87, and beyond that of the nearer end; NaN of NaN.
    Unlike `math.exp`, it has neither a call nor a branch: loops with it become vectors."""
    x = EDGE if x > EDGE else x
    x = -EDGE if x < -EDGE else x
    shifted = x * PER_LN2 + WHOLE
    n = shifted - WHOLE
    r = (x - n * LN2_HIGH) - n * LN2_LOW
    series = E0 + r * (E1 + r * (E2 + r * (E3 + r * E4)))
    bits = u32(u32(f32(shifted).view(np.uint32) << u32(23)) + ONE_BITS)
    return (f32(1) + (r + r * r * series)) * u32(bits).view(np.float32)


@jit(error_model="numpy")
def sigmoid(x):
    """1 / (1 + e^-x) of a float32."""
    return f32(1) / (f32(1) + exp(-x))


@jit(error_model="numpy")
def slope(direction):
    """Change of t per length along an axis; 0 for a ray that does not move along it."""
    inverse = f32(1) / direction
    return inverse if abs(direction) >= PARALLEL else f32(0)


@jit()
def three(rows, row):
    """The three numbers of a row."""
    return rows[row, 0], rows[row, 1], rows[row, 2]


@jit()
def pack_bf16(low, high):
    """Two float32 rounded to nearest even bfloat16, in the low and high half of a word."""
    return u32(u32(_round_bits(low) >> u32(16)) | u32(_round_bits(high) & u32(0xFFFF0000)))


@jit()
def _round_bits(value):
    """Bits of a float32 after rounding; the upper half is the bfloat16. NaN stays NaN: rounded like
    a number, 0x7FFFFFFF would become -0."""
    bits = f32(value).view(np.uint32)
    tie_to_even = u32(u32(bits >> u32(16)) & u32(1))
    rounded = u32(u32(bits + u32(0x7FFF)) + tie_to_even)
    return rounded if value == value else u32(bits | u32(0x400000))  # the bit of a quiet NaN


@intrinsic
def prefetch(typing, array, at):
    """Ask for the cache line of place `at` of a flat array, without waiting for it."""

    def generate(context, builder, signature, values):
        data = make_array(signature.args[0])(context, builder, values[0]).data
        word, byte = ir.IntType(32), ir.IntType(8).as_pointer()
        fetch = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(ir.VoidType(), [byte, word, word, word]),
            "llvm.prefetch.p0i8",
        )
        # To read, into the second level, of data: the first level has too few lines on their way.
        how = [ir.Constant(word, n) for n in (0, 2, 1)]
        builder.call(fetch, [builder.bitcast(builder.gep(data, [values[1]]), byte), *how])
        return context.get_dummy_value()

    return types.void(array, types.int64), generate


@intrinsic
def add_pair(typing, array, at, weight, first, second):
    """Add weight * (first, second) to the two numbers of a flat array of float32 from place `at`
    on, with one load, sum and store; LLVM by itself makes two of each."""

    def generate(context, builder, signature, values):
        data = make_array(signature.args[0])(context, builder, values[0]).data
        pair, word = ir.VectorType(ir.FloatType(), 2), ir.IntType(32)
        place = builder.bitcast(builder.gep(data, [values[1]]), pair.as_pointer())

        def both(one: ir.Value, other: ir.Value) -> ir.Value:
            vector = ir.Constant(pair, ir.Undefined)
            vector = builder.insert_element(vector, one, ir.Constant(word, 0))
            return builder.insert_element(vector, other, ir.Constant(word, 1))

        more = builder.fmul(both(values[2], values[2]), both(values[3], values[4]))
        builder.store(builder.fadd(builder.load(place, align=4), more), place, align=4)
        return context.get_dummy_value()

    n = types.float32
    return types.void(array, types.uint64, n, n, n), generate


@jit()
def prefetch_row(array, at, count):
    """Ask for `count` numbers of a flat array of float32, from place `at` on."""
    for k in range(0, count, WORDS):
        prefetch(array, at + k)
    prefetch(array, at + count - 1)


def _product(rows: int):
    """out[r, o] = bias[o] + sum_k a[r, k] w[k, o] for `rows` r and `LANES` o, of flat arrays.

    LLVM does not keep the sums of a loop nest in registers by itself (13 instead of 40 GFLOP/s a
    core), so the loop is written in LLVM's own terms.

    Its arguments: a, the place of a[0, 0], steps to the next r and the next k; w, the place of
    w[0, 0], the step to the next k; bias, its place; out, its place, the step to the next r; how
    many k there are, 1 or more; whether negative results become 0.
    """

    @intrinsic
    def product(
        ctx, a, a_at, a_row, a_step, w, w_at, w_step, bias, b_at, out, out_at, out_row, count, relu
    ):
        def generate(context, builder, signature, values):
            index = ir.IntType(64)
            vector = ir.VectorType(ir.FloatType(), LANES)
            zeros = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
            fma = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(vector, [vector] * 3), f"llvm.fma.v{LANES}f32"
            )

            def pointer(array: int) -> ir.Value:
                data = make_array(signature.args[array])(context, builder, values[array]).data
                return builder.gep(data, [values[array + 1]])

            def lanes(base: ir.Value, at: ir.Value) -> ir.Value:
                return builder.bitcast(builder.gep(base, [at]), vector.as_pointer())

            def splat(number: ir.Value) -> ir.Value:
                nothing = ir.Constant(vector, ir.Undefined)
                one = builder.insert_element(nothing, number, ir.Constant(ir.IntType(32), 0))
                return builder.shuffle_vector(one, nothing, zeros)

            def row(step: ir.Value, r: int) -> ir.Value:
                return builder.mul(step, ir.Constant(index, r))

            a_data, w_data, bias_data, out_data = (pointer(n) for n in (0, 4, 7, 9))
            first = builder.load(lanes(bias_data, ir.Constant(index, 0)), align=4)
            before, loop = builder.block, builder.append_basic_block("k")
            after = builder.append_basic_block("summed")
            builder.branch(loop)

            builder.position_at_end(loop)
            k = builder.phi(index)
            sums = [builder.phi(vector) for _ in range(rows)]
            weight = builder.load(lanes(w_data, builder.mul(k, values[6])), align=4)
            along = builder.gep(a_data, [builder.mul(k, values[3])])
            next_k = builder.add(k, ir.Constant(index, 1))
            k.add_incoming(ir.Constant(index, 0), before)
            k.add_incoming(next_k, loop)
            results = []
            for r, total in enumerate(sums):
                number = splat(builder.load(builder.gep(along, [row(values[2], r)])))
                results.append(builder.call(fma, [number, weight, total]))
                total.add_incoming(first, before)
                total.add_incoming(results[-1], loop)
            builder.cbranch(builder.icmp_signed("<", next_k, values[12]), loop, after)

            builder.position_at_end(after)
            least = [ir.Constant(ir.FloatType(), end) for end in (0.0, -math.inf)]
            floor = splat(builder.select(values[13], *least))
            for r, result in enumerate(results):
                below = builder.fcmp_ordered("<", result, floor)  # NaN is not, and stays
                shown = builder.select(below, floor, result)
                builder.store(shown, lanes(out_data, row(values[11], r)), align=4)
            return context.get_dummy_value()

        n = types.int64
        return types.void(a, n, n, n, w, n, n, bias, n, out, n, n, n, types.boolean), generate

    return product


six, tall, _one = _product(ROWS), _product(TALL), _product(1)


@jit()
def multiply(rows, a, a_at, a_row, a_step, w, width, bias, out, out_at, count, relu):
    """`rows` rows of a matrix, any number, times w [count, width], plus bias [width], which are
    flat: out [rows, width]."""
    size = TALL if rows >= TALL else ROWS if rows >= ROWS else 1
    for left in range(0, width, LANES):
        r = 0
        while r < rows:
            r = min(r, rows - size)  # the last ones overlap: some are computed twice
            at, to = a_at + r * a_row, out_at + r * width + left
            if size == TALL:
                tall(a, at, a_row, a_step, w, left, width, bias, left, out, to, width, count, relu)
            elif size == ROWS:
                six(a, at, a_row, a_step, w, left, width, bias, left, out, to, width, count, relu)
            else:
                _one(a, at, a_row, a_step, w, left, width, bias, left, out, to, width, count, relu)
            r += size
