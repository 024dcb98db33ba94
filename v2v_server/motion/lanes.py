"""Vector code that numba's own loops do not become: sums of absolute differences, and the warp of one cell.

Both are integer arithmetic in LLVM's vector types, which every processor executes exactly, with its own instructions.
"""

# mypy: allow-untyped-defs, allow-untyped-calls, allow-untyped-decorators
from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

BLOCK_PX = 8
"""Side of the block that is compared."""
CELL_PX = 4
"""Side of the cell that is warped."""
WEIGHT_BITS = 6
FINE_BITS = 4
"""Fraction bits of a grey level that is written."""
_REACH = 8  # px of a row that are loaded for a cell: CELL_PX and the reach of the cubic, and one more
_ROWS = CELL_PX + 3
_KEPT_BITS = 3  # fraction bits of a row's sums
_SHARE_BITS = 8
_untyped: Any = intrinsic  # its type counts the typing context as an argument of the call
_INT8, _INT16, _INT32, _INT64 = ir.IntType(8), ir.IntType(16), ir.IntType(32), ir.IntType(64)


@_untyped
def block_difference(typing_context: Any, first: Any, at: Any, second: Any, to: Any, pitch: Any) -> Any:
    """Return the sum of absolute differences of two blocks of BLOCK_PX x BLOCK_PX uint8.

    Args:
        first, second: 1-D arrays, pictures with rows ``pitch`` apart.
        at, to: int64, the place of each block's first pixel. It is not checked.
    """

    def generate(context, builder, signature, args):
        one, other = (context.make_array(signature.args[i])(context, builder, args[i]).data for i in (0, 2))
        wide = ir.VectorType(_INT32, BLOCK_PX * BLOCK_PX)
        blocks = [
            builder.zext(_rows(builder, data, start, args[4], BLOCK_PX, BLOCK_PX), wide)
            for data, start in ((one, args[1]), (other, args[3]))
        ]
        magnitude = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(wide, (wide, ir.IntType(1))), "llvm.abs.v64i32"
        )
        total = cgutils.get_or_insert_function(
            builder.module, ir.FunctionType(_INT32, (wide,)), "llvm.vector.reduce.add.v64i32"
        )
        apart = builder.call(magnitude, [builder.sub(*blocks), ir.IntType(1)(0)])
        return builder.sext(builder.call(total, [apart]), _INT64)

    return types.int64(first, at, second, to, pitch), generate


@_untyped
def warp_cell(
    typing_context: Any, first: Any, at: Any, first_x: Any, first_y: Any, second: Any, to: Any, second_x: Any,
    second_y: Any, weights: Any, pitch: Any, share: Any, out: Any, place: Any, out_pitch: Any, mirrored: Any,
) -> Any:  # fmt: skip
    """Write the weighted mean of two cells, each read between pixels by a separable cubic.

    Args:
        first, second: 1-D uint8 arrays, pictures with rows ``pitch`` apart.
        at, to: int64, the pixel above and left of the place where each is read.
        first_x .. second_y: int64, rows of ``weights``: the fraction of a pixel of each place.
        weights: [fractions, 4] int16, in 2**-WEIGHT_BITS.
        share: int64, weight of the second cell, in 2**-8.
        out: 1-D uint16 array with rows ``out_pitch`` apart, written at ``place``: grey levels in 2**-FINE_BITS. Nothing
            is checked.
        mirrored: boolean, whether each row is written from right to left.
    """

    def generate(context, builder, signature, args):
        data = [
            context.make_array(signature.args[i])(context, builder, args[i]).data if i in (0, 4, 8, 11) else args[i]
            for i in range(15)
        ]
        pixels = ir.VectorType(_INT32, CELL_PX * CELL_PX)

        def constant(value):
            return ir.Constant(pixels, [value] * pixels.count)

        def spread(value, element, count):
            empty = ir.Constant(ir.VectorType(element, count), ir.Undefined)
            filled = builder.insert_element(empty, value, _INT32(0))
            return builder.shuffle_vector(filled, empty, ir.Constant(ir.VectorType(_INT32, count), [0] * count))

        def weight(row, tap):
            place = builder.add(builder.mul(row, _INT64(4)), _INT64(tap))
            return builder.load(builder.gep(data[8], [place]))

        def read(picture, start, x, y):
            rows = builder.zext(
                _rows(builder, picture, start, data[9], _ROWS, _REACH), ir.VectorType(_INT16, 8 * _REACH)
            )
            total = None
            for tap in range(4):
                lanes = [row * _REACH + tap + column for row in range(8) for column in range(CELL_PX)]
                part = builder.shuffle_vector(rows, rows, ir.Constant(ir.VectorType(_INT32, 32), lanes))
                part = builder.mul(part, spread(weight(x, tap), _INT16, 32))
                total = part if total is None else builder.add(total, part)
            shift = WEIGHT_BITS - _KEPT_BITS
            short = ir.VectorType(_INT16, 32)
            total = builder.add(total, ir.Constant(short, [1 << (shift - 1)] * 32))
            total = builder.ashr(total, ir.Constant(short, [shift] * 32))
            # Two taps at a time: neighbouring lanes are multiplied and added, which processors do in one instruction.
            column = None
            for tap in (0, 2):
                odd_even = []
                for each in (tap, tap + 1):
                    lanes = [(row + each) * CELL_PX + place for row in range(CELL_PX) for place in range(CELL_PX)]
                    part = builder.shuffle_vector(total, total, ir.Constant(ir.VectorType(_INT32, 16), lanes))
                    odd_even.append((part, spread(weight(y, each), _INT16, 16)))
                both = [
                    builder.shuffle_vector(
                        one, other, ir.Constant(ir.VectorType(_INT32, 32), [i // 2 + 16 * (i % 2) for i in range(32)])
                    )
                    for one, other in zip(*odd_even, strict=True)
                ]
                wide = ir.VectorType(_INT32, 32)
                product = builder.mul(builder.sext(both[0], wide), builder.sext(both[1], wide))
                halves = [
                    builder.shuffle_vector(
                        product, product, ir.Constant(ir.VectorType(_INT32, 16), list(range(first, 32, 2)))
                    )
                    for first in (0, 1)
                ]
                part = builder.add(*halves)
                column = part if column is None else builder.add(column, part)
            return column

        seen = read(data[0], data[1], data[2], data[3]), read(data[4], data[5], data[6], data[7])
        share = spread(builder.trunc(data[10], _INT32), _INT32, 16)
        mean = builder.add(
            builder.mul(seen[0], builder.sub(constant(1 << _SHARE_BITS), share)), builder.mul(seen[1], share)
        )
        shift = WEIGHT_BITS + _KEPT_BITS + _SHARE_BITS - FINE_BITS
        mean = builder.ashr(builder.add(mean, constant(1 << (shift - 1))), constant(shift))
        for limit, sign in ((0, "<"), (255 << FINE_BITS, ">")):
            outside = builder.icmp_signed(sign, mean, constant(limit))
            mean = builder.select(outside, constant(limit), mean)
        grey = builder.trunc(mean, ir.VectorType(_INT16, 16))
        backwards = [row + CELL_PX - 1 - column for row in range(0, 16, CELL_PX) for column in range(CELL_PX)]
        turned = builder.shuffle_vector(grey, grey, ir.Constant(pixels, backwards))
        grey = builder.select(data[14], turned, grey)
        four = ir.VectorType(_INT16, CELL_PX)
        for row in range(CELL_PX):
            lanes = [row * CELL_PX + column for column in range(CELL_PX)]
            line = builder.shuffle_vector(grey, grey, ir.Constant(ir.VectorType(_INT32, CELL_PX), lanes))
            start = builder.add(data[12], builder.mul(data[13], _INT64(row)))
            builder.store(line, builder.bitcast(builder.gep(data[11], [start]), four.as_pointer()), align=1)
        return context.get_dummy_value()

    return types.none(
        first,
        at,
        first_x,
        first_y,
        second,
        to,
        second_x,
        second_y,
        weights,
        pitch,
        share,
        out,
        place,
        out_pitch,
        mirrored,
    ), generate


def _rows(builder: Any, data: Any, start: Any, pitch: Any, rows: int, length: int) -> Any:
    """Load rows of a picture as one vector of 8 rows; rows beyond those that are read repeat the last one."""
    vector = ir.VectorType(_INT8, length)
    parts = []
    for row in range(rows):
        place = builder.gep(data, [builder.add(start, builder.mul(pitch, _INT64(row)))])
        parts.append(builder.load(builder.bitcast(place, vector.as_pointer()), align=1))
    parts += parts[-1:] * (8 - rows)
    while len(parts) > 1:
        lanes = ir.Constant(ir.VectorType(_INT32, 2 * parts[0].type.count), list(range(2 * parts[0].type.count)))
        parts = [builder.shuffle_vector(*pair, lanes) for pair in zip(parts[::2], parts[1::2], strict=True)]
    return parts[0]
