"""Functions that numba's language lacks and the pixel kernel needs: bit patterns, vector width, alignment, table
look-up.

They only move bits or affect speed; nothing rounds. So a processor without the instructions named below gives the same
bytes, only more slowly.
"""

# mypy: allow-untyped-defs, allow-untyped-calls
from __future__ import annotations

from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

_VECTOR_BYTES = 64  # the widest there are; also a cache line
_LANES = 16  # float32 numbers of a vector
_INT8, _INT32, _INT64, _FLOAT = ir.IntType(8), ir.IntType(32), ir.IntType(64), ir.FloatType()


@intrinsic
def float_of_bits(typing_context: Any, bits: Any) -> Any:
    """Return the float32 with the bit pattern of an int32."""
    return types.float32(types.int32), lambda context, builder, signature, args: builder.bitcast(args[0], _FLOAT)


@intrinsic
def bits_of_float(typing_context: Any, value: Any) -> Any:
    """Return the bit pattern of a float32 as int32."""
    return types.int32(types.float32), lambda context, builder, signature, args: builder.bitcast(args[0], _INT32)


@intrinsic
def use_widest_vectors(typing_context: Any) -> Any:
    """Let LLVM use 512-bit vectors in the calling function if the processor has them; no effect elsewhere.

    For some processors LLVM halves them by default, because a few wide instructions would lower the clock for all
    others. This kernel consists of wide instructions. llvmlite does not support attributes with a value, so ``set.add``
    is used.
    """

    def generate(context, builder, signature, args):
        set.add(builder.function.attributes, '"prefer-vector-width"="512"')
        return context.get_dummy_value()

    return types.none(), generate


@numba.njit(nogil=True, inline="always")
def aligned_rows(rows, length, dtype):
    """Return [rows, length] zeros; every row begins at a multiple of 64 bytes if the size of ``length`` numbers is
    one.
    """
    memory = np.zeros(rows * length + _VECTOR_BYTES, dtype)
    skip = (-memory.ctypes.data % _VECTOR_BYTES) // memory.itemsize
    return memory[skip : skip + rows * length].reshape(rows, length)


@intrinsic
def look_up_by_permutation(typing_context: Any, table: Any, row: Any, coming: Any, levels: Any) -> Any:
    """Compute ``levels[:n] = table[row[:n]]`` by AVX-512; return n, the multiple of 16 that was processed.

    A gather, or sixteen loads and inserts, take longer than permuting the whole table: 256 float32 numbers fill sixteen
    vector registers; eight two-register permutations by the low five bits of a grey level give eight candidates, and
    its upper three bits select one.

    Args:
        table: [256] float32.
        row: [width] uint8.
        coming: [width] uint8, a row that a later call will read; it is prefetched into the cache. The blocks of a row
            are too short for the processor's own prefetching.
        levels: [width or more] float32, written.

    Returns:
        0, with nothing done, if the processor has no AVX-512 or the arrays have other types.
    """
    fits = table.dtype == types.float32 and row.dtype == types.uint8

    def generate(context, builder, signature, args):
        features = context.codegen().magic_tuple()[2].split(",")
        if not fits or "+avx512f" not in features:
            return _INT64(0)
        table, row, coming, levels = (
            context.make_array(kind)(context, builder, value) for kind, value in zip(signature.args, args, strict=True)
        )
        floats, words, bytes_ = (ir.VectorType(element, _LANES) for element in (_FLOAT, _INT32, _INT8))
        permute = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(floats, (floats, words, floats)), "llvm.x86.avx512.vpermi2var.ps.512"
        )
        prefetch = cgutils.get_or_insert_function(
            builder.module,
            ir.FunctionType(ir.VoidType(), (_INT8.as_pointer(), _INT32, _INT32, _INT32)),
            "llvm.prefetch.p0",
        )

        def vector_at(array, position, vector):
            return builder.bitcast(builder.gep(array.data, [position]), vector.as_pointer())

        parts = [
            builder.load(vector_at(table, _INT64(_LANES * part), floats), align=4) for part in range(256 // _LANES)
        ]
        width = builder.extract_value(row.shape, 0)
        done = builder.and_(width, _INT64(-_LANES))
        with cgutils.for_range_slice(builder, _INT64(0), done, _INT64(_LANES)) as (position, _):
            builder.call(prefetch, [builder.gep(coming.data, [position]), _INT32(0), _INT32(3), _INT32(1)])
            grey = builder.load(vector_at(row, position, bytes_), align=1)
            index = builder.zext(grey, words)
            found = [
                builder.call(permute, [low, index, high]) for low, high in zip(parts[::2], parts[1::2], strict=True)
            ]
            for bit in (32, 64, 128):
                is_set = builder.icmp_unsigned("!=", builder.and_(grey, bytes_([bit] * _LANES)), bytes_([0] * _LANES))
                found = [builder.select(is_set, high, low) for low, high in zip(found[::2], found[1::2], strict=True)]
            builder.store(found[0], vector_at(levels, position, floats), align=4)
        return done

    return types.int64(table, row, coming, levels), generate
