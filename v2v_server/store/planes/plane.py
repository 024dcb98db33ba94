"""How a plane is stored, and what reading it is asked for: the class of all planes.

    store file of the luma       as without planes; a reader that needs no plane reads nothing else
    store file of each plane     of its bytes, arranged as pictures
    footer                       msgpack {name: [version, offset, bytes]}
    its length, check and magic  4 + 8 + 8 bytes

A plane has one cell for every square of ``cell_px`` pixels of the stored rows, and some values in each cell. A plane of
another version is treated as missing. A block in which every value is zero takes no space and no time.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, TypeAlias

import msgpack
import numpy as np
import numpy.typing as npt

from v2v_protocol.errors import ProtocolError, UsageError, VideoError
from v2v_protocol.persisted import reader
from v2v_server.store.format import BLOCK_ROWS, Head, check, group_frames_for
from v2v_server.video.decode import ClipRequest, Cut, DecodedClip, DecodedPicture
from v2v_server.video.picture import SDR, PixelRect, Signal

_MAGIC = b"V2VPLAN1"
_SUFFIX = struct.Struct("<IQ8s")
_LARGEST_FOOTER_BYTES = 1 << 16


class Stored(Protocol):
    """What a plane reads of an open store file: a :class:`v2v_server.store.store_file.StoreFile`, see there."""

    head: Head

    @property
    def planes(self) -> frozenset[str]:
        """Return the names of the planes that the file has."""

    def plane(
        self, name: str, start: int, count: int, cells: PixelRect, wanted: npt.NDArray[np.int64] | None = None
    ) -> npt.NDArray[Any]:
        """Read a part of a plane: [n, values, rows, columns]."""

    def pictures(self, request: ClipRequest) -> Iterator[DecodedPicture]:
        """Yield the frames of the only cut of a request in 8 bits."""


Files: TypeAlias = Sequence[tuple[Stored, range]]
"""Open store files that together hold a clip, and the frames of the clip that each one holds."""


@dataclass(frozen=True, slots=True)
class Plane:
    """A kind of plane. A subclass says what it is for; its ``PLANE`` says how it is stored.

    Attributes:
        version: to be raised when the same pictures get other values.
        dtype: of a value, in little-endian order.
        values: values of a cell; together at most 32 bytes.
        cell_px: side of a cell, pixels.
        serves: the array, or the field of the spec, whose streams read it; empty if every suitable file has it.
        remedy: what to do about a file without it; empty if a clip can be read without it.
    """

    version: int
    dtype: str
    values: int
    cell_px: int
    serves: str = ""
    remedy: str = ""

    def is_wanted(self, request: ClipRequest, signal: Signal) -> bool:
        """Return whether clips of this signal are to be read with the plane."""
        return False

    def is_worth_storing(self, request: ClipRequest) -> bool:
        """Return whether clips of 8 bits read the plane, so that a cache stores it."""
        return self.is_wanted(request, SDR)

    def is_part_of(self, signal: Signal) -> bool:
        """Return whether every file of this signal has the plane."""
        return False

    def asked(self, cut: Cut) -> Cut:
        """Return a cut of whole pictures with what the plane is made from."""
        return cut

    def maker(self) -> Callable[[DecodedPicture], npt.NDArray[Any]]:
        """Return a function of one usable picture after the other that returns its array, [values, rows, columns]."""
        raise NotImplementedError

    def read(self, files: Files, request: ClipRequest) -> Sequence[Any]:
        """Return what a clip has of the plane, for each cut; None for one that does not ask for it.

        Raises:
            UsageError, VideoError: see :meth:`v2v_server.store.store_file.StoreFile.plane`.
        """
        raise NotImplementedError

    def narrowed(self, cut: Cut, value: Any) -> Cut:
        """Return the cut to read with this value of the plane."""
        return cut

    def added(self, clip: DecodedClip, value: Any) -> DecodedClip:
        """Return the clip with this value of the plane."""
        raise NotImplementedError

    def shape(self, rows: int, width_px: int) -> tuple[int, int, int]:
        """Return the shape of a frame's array: values, rows and columns of cells."""
        return self.values, -(-rows // self.cell_px), -(-width_px // self.cell_px)

    @property
    def _cell_bytes(self) -> int:
        return self.values * np.dtype(self.dtype).itemsize

    @property
    def _band(self) -> int:
        """Rows of cells in a row of blocks."""
        return BLOCK_ROWS // self._cell_bytes

    def head(self, luma: Head) -> Head:
        """Return the head of the plane's store file."""
        _, rows, columns = self.shape(luma.rows, luma.width_px)
        rows = -(-rows // self._band) * BLOCK_ROWS
        return replace(
            luma, height_px=rows, width_px=columns, top=0, rows=rows, group=group_frames_for(rows, columns), index=b""
        )

    def to_picture(self, array: npt.NDArray[Any]) -> npt.NDArray[np.uint8]:
        """Arrange the bytes of one frame as a picture whose rows of blocks hold all bytes of some rows of cells.

        Args:
            array: [values, rows, columns].

        Raises:
            UsageError: the number of values or the dtype is another one.
        """
        if array.shape[0] != self.values or array.dtype != np.dtype(self.dtype):
            raise UsageError(f"a plane of {array.dtype}{list(array.shape)}: give {self.values} values of {self.dtype}")
        _, rows, columns = array.shape
        bands = -(-rows // self._band)
        padded = np.zeros((self.values, bands * self._band, columns), self.dtype)
        padded[:, :rows] = array
        parts = padded.view(np.uint8).reshape(self.values, bands, self._band, columns, -1)
        picture = np.zeros((bands, BLOCK_ROWS, columns), np.uint8)
        used = picture[:, : self._cell_bytes * self._band]
        used[...] = parts.transpose(1, 0, 4, 2, 3).reshape(used.shape)
        return picture.reshape(-1, columns)

    def window(self, cells: PixelRect) -> PixelRect:
        """Return the part of the picture that holds some cells (top, left, rows, columns)."""
        top, left, rows, columns = cells
        first, end = top // self._band, (top + rows - 1) // self._band + 1
        return first * BLOCK_ROWS, left, (end - first) * BLOCK_ROWS, columns

    def from_pictures(self, pictures: npt.NDArray[np.uint8], cells: PixelRect) -> npt.NDArray[Any]:
        """Return the cells of a window of frames: [n, values, rows, columns]."""
        count, size = len(pictures), np.dtype(self.dtype).itemsize
        top, _, rows, columns = cells
        bands = pictures.reshape(count, -1, BLOCK_ROWS, columns)[:, :, : self._cell_bytes * self._band]
        parts = bands.reshape(count, bands.shape[1], self.values, size, self._band, columns)
        array = np.empty((count, self.values, bands.shape[1], self._band, columns), self.dtype)
        into = array.view(np.uint8).reshape(*array.shape, size)
        for value in range(self.values):
            for byte in range(size):
                into[:, value, ..., byte] = parts[:, :, value, byte]
        first = top % self._band
        return array.reshape(count, self.values, -1, columns)[:, :, first : first + rows]


class PlanePlace(NamedTuple):
    """Version of a plane, and where its store file lies."""

    version: int
    offset: int
    bytes: int


_read_places = reader(Mapping[str, PlanePlace])


def pack_footer(places: Mapping[str, PlanePlace]) -> bytes:
    """Return the end of a file with planes."""
    body = msgpack.packb(dict(places))
    return body + _SUFFIX.pack(len(body), check(body, 0), _MAGIC)


def read_footer(path: str, file: int) -> dict[str, PlanePlace]:
    """Return the places of the planes of an open store file, by name; empty if it has none.

    Raises:
        VideoError: the footer is damaged.
        OSError: it cannot be read.
    """
    end = os.fstat(file).st_size - _SUFFIX.size
    suffix = os.pread(file, _SUFFIX.size, max(0, end))
    if len(suffix) < _SUFFIX.size or not suffix.endswith(_MAGIC):
        return {}
    length, expected, _ = _SUFFIX.unpack(suffix)
    body = os.pread(file, length, end - length) if length <= min(_LARGEST_FOOTER_BYTES, end) else b""
    try:
        if len(body) != length or check(body, 0) != expected:
            raise ValueError("damaged")
        places: dict[str, PlanePlace] = _read_places(msgpack.unpackb(body))
        if any(place.offset + place.bytes > end - length for place in places.values()):
            raise ValueError(f"a plane ends behind byte {end - length}")
        return places
    except (ValueError, ProtocolError) as error:
        raise VideoError(
            path, None, f"the store file is corrupt (its list of planes: {error}): re-create it with v2v-prepare"
        ) from error
