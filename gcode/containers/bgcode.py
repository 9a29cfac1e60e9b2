"""Binary G-code: a header, then blocks of metadata, thumbnails and G-code.

Source: libbgcode, doc/specifications.md (26beabf): layout, numbers, checksum. All G-code blocks of
a file have the same compression and encoding, and nothing stands between them: Prusa's firmware
asks for that (Prusa-Firmware-Buddy, src/common/gcode/gcode_reader_binary.cpp, c9097bb), so they are
written as the first one of the file came. How metadata looks as comments was observed on the
output of libbgcode's converter (0.2).
"""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import BinaryIO

from stillpath.gcode.containers.compression import Compression, compress, decompress
from stillpath.gcode.containers.limits import BLOCK_BYTES, check_unpacked, largest_unpacked
from stillpath.gcode.containers.meatpack import Unpacker, pack
from stillpath.gcode.errors import GcodeError
from stillpath.gcode.slicers.facts import SlicerFacts, facts_in
from stillpath.gcode.slicers.retiming import retimed

__all__ = ["BinaryGcode", "Block", "BlockType", "Encoding", "read_blocks"]

_VERSION = 1
_CHECKSUMS = (0, 1)
_PIECE_BYTES = 1 << 16
"""Text per block, as slicers have it."""
_KEPT_BYTES, _KEPT_BLOCKS = 1 << 26, 1000
"""Metadata and thumbnails, packed or unpacked, that are held in memory."""
_THUMBNAIL_TAGS = ("thumbnail", "thumbnail_JPG", "thumbnail_QOI")
_BASE64_COLUMNS = 78


class BlockType(IntEnum):
    """Numbers of the format."""

    FILE_METADATA = 0
    GCODE = 1
    SLICER_METADATA = 2
    PRINTER_METADATA = 3
    PRINT_METADATA = 4
    THUMBNAIL = 5


_TIMED = (BlockType.PRINT_METADATA, BlockType.PRINTER_METADATA)
"""Both hold the slicer's time; printers show that of `PRINTER_METADATA`."""


class Encoding(IntEnum):
    """Numbers of the format, for G-code blocks."""

    ASCII = 0
    MEATPACK = 1
    MEATPACK_COMMENTS = 2


@dataclass(frozen=True, slots=True)
class Block:
    """A block of a file; `raw` are its bytes from header to checksum."""

    place: str
    type: BlockType
    compression: int
    size: int
    parameters: tuple[int, ...]
    data: bytes
    raw: bytes

    def content(self) -> bytes:
        """Return the data decompressed.

        Raises
        ------
        GcodeError
            The compression is unknown or the data damaged.
        """
        try:
            how = Compression(self.compression)
        except ValueError:
            raise GcodeError(
                f"{self.place} has the unknown compression {self.compression} "
                "(0 none, 1 deflate, 2 and 3 heatshrink); export plain G-code instead"
            ) from None
        try:
            return decompress(self.data, how, self.size)
        except ValueError as error:
            raise GcodeError(f"{self.place} is damaged: its data {error}") from None


class BinaryGcode:
    """The parts of a binary file needed to write it again with another text.

    Metadata and thumbnails are kept byte for byte, but for the slicer's print time if the print
    takes longer.

    Attributes
    ----------
    delay_s : float
        How much longer the print takes with the new text.

    Parameters
    ----------
    source : Path
        The file; only read, and only while constructing.
    text : BinaryIO
        Receives the G-code, at its present position.
    progress : callable
        Is given the share of the file that was read, now and then.

    Raises
    ------
    GcodeError
        The file is damaged (the message names the block), of an unknown version, compression or
        encoding, or unpacks to more than is sane.
    """

    def __init__(self, source: Path, text: BinaryIO, progress: Callable[[float], None]) -> None:
        self.delay_s = 0.0
        self._before: list[Block] = []
        self._after: list[Block] = []
        first: Block | None = None
        unpacker, kept, written = Unpacker(), 0, 0
        largest, size = largest_unpacked(source), source.stat().st_size
        with source.open("rb") as file:
            self._checked = _read_file_header(file)
            for block in read_blocks(file, checked=self._checked):
                if block.type is not BlockType.GCODE:
                    (self._before if first is None else self._after).append(block)
                    kept += max(len(block.raw), block.size)
                    check_unpacked(kept, _KEPT_BYTES)
                    self._check_count(block.place)
                    continue
                first = first or block
                written += text.write(_text_of(block, unpacker))
                check_unpacked(written, largest)
                progress(file.tell() / size)
        if first is None:
            raise GcodeError("the binary file holds no G-code block; slice and export it again")
        self._compression = Compression(first.compression)
        self._encoding = Encoding(first.parameters[0])

    def _check_count(self, place: str) -> None:
        if len(self._before) + len(self._after) > _KEPT_BLOCKS:
            raise GcodeError(
                f"up to {place} the binary file has more than {_KEPT_BLOCKS} blocks of metadata "
                "and thumbnails: no slicer made it; export it again"
            )

    def write(self, text: BinaryIO, target: BinaryIO, progress: Callable[[float], None]) -> None:
        """Write a binary file around a text, packed as the original was.

        Raises
        ------
        GcodeError
            The text holds a byte that MeatPack cannot carry, or a line of more than 16 MiB.
        """
        target.write(_file_header(checked=self._checked))
        target.writelines(self._renewed(block) for block in self._before)
        for piece in _pieces(text):
            target.write(self._gcode_block(piece))
            progress(text.tell())
        target.writelines(self._renewed(block) for block in self._after)

    def facts(self) -> SlicerFacts:
        """Return the facts in the metadata of the file."""
        return facts_in(self._head(thumbnails=False), self._tail())

    def write_plain(self, text: BinaryIO, target: BinaryIO) -> None:
        """Write plain G-code, with metadata and thumbnails as comments around the text."""
        target.write(self._head())
        last = b"\n"
        while data := text.read(_PIECE_BYTES):
            target.write(data)
            last = data[-1:]
        target.write(b"" if last == b"\n" else b"\n")
        target.write(self._tail())

    def _gcode_block(self, text: bytes) -> bytes:
        data = text if self._encoding is Encoding.ASCII else pack(text)
        return self._block(BlockType.GCODE, self._compression, (self._encoding,), data)

    def _block(
        self,
        type: BlockType,  # noqa: A002
        compression: Compression,
        parameters: tuple[int, ...],
        data: bytes,
    ) -> bytes:
        packed = compress(data, compression)
        block = struct.pack("<HHI", type, compression, len(data))
        if compression is not Compression.NONE:
            block += struct.pack("<I", len(packed))
        block += struct.pack(f"<{len(parameters)}H", *parameters) + packed
        return block + struct.pack("<I", zlib.crc32(block)) if self._checked else block

    def _renewed(self, block: Block) -> bytes:
        """Return the bytes of a block, with the print's new time."""
        content = self._content(block)
        if block.type not in _TIMED or content == block.content():
            return block.raw
        return self._block(block.type, Compression(block.compression), block.parameters, content)

    def _content(self, block: Block) -> bytes:
        content = block.content()
        timed = block.type in _TIMED and self.delay_s != 0.0
        return retimed(content, self.delay_s) if timed else content

    def _head(self, *, thumbnails: bool = True) -> bytes:
        facts = dict(self._metadata(BlockType.FILE_METADATA))
        line = b"; generated by " + facts.get(b"Producer", b"an unknown slicer")
        if b"Produced on" in facts:
            line += b" on " + facts[b"Produced on"]
        parts = [line, b"\n\n\n", *self._comments(BlockType.PRINTER_METADATA)]
        if thumbnails:
            parts += [_thumbnail(b) for b in self._before if b.type is BlockType.THUMBNAIL]
        return b"".join([*parts, b"\n"])

    def _tail(self) -> bytes:
        return b"".join(
            [
                b"\n",
                *self._comments(BlockType.PRINT_METADATA),
                b"\n; prusaslicer_config = begin\n",
                *self._comments(BlockType.SLICER_METADATA),
                b"; prusaslicer_config = end\n\n",
            ]
        )

    def _comments(self, type: BlockType) -> Iterator[bytes]:  # noqa: A002
        return (b"; %s = %s\n" % entry for entry in self._metadata(type))

    def _metadata(self, type: BlockType) -> Iterator[tuple[bytes, bytes]]:  # noqa: A002
        for block in [*self._before, *self._after]:
            if block.type is type:
                for line in self._content(block).splitlines():
                    key, equals, value = line.partition(b"=")
                    if equals:
                        yield key, value


def read_blocks(file: BinaryIO, *, checked: bool) -> Iterator[Block]:
    """Yield the blocks of a file from its position to its end, verified.

    Raises
    ------
    GcodeError
        A block is damaged, cut off, too large, or of an unknown type.
    """
    number = 0
    while True:
        number += 1
        place = f"block {number} (at byte {file.tell()})"
        header = file.read(8)
        if not header:
            return
        header += _exactly(file, 8 - len(header), place)
        kind, compression, size = struct.unpack("<HHI", header)
        stored = size
        if kind not in set(BlockType):
            raise GcodeError(
                f"{place} is of type {kind}, and only 0 to {max(BlockType)} are known: the file is "
                "damaged or of a newer kind; export it again, or as plain G-code"
            )
        if compression != Compression.NONE:
            header += _exactly(file, 4, place)
            (stored,) = struct.unpack("<I", header[8:])
        if max(size, stored) > BLOCK_BYTES:
            raise GcodeError(
                f"{place} says it holds {max(size, stored)} bytes, more than the {BLOCK_BYTES} "
                "that are allowed: the file is damaged; export it again"
            )
        count = 3 if kind == BlockType.THUMBNAIL else 1
        parameters = _exactly(file, 2 * count, place)
        data = _exactly(file, stored, place)
        raw = header + parameters + data
        if checked:
            raw += _checksum(file, raw, place)
        values = struct.unpack(f"<{count}H", parameters)
        yield Block(place, BlockType(kind), compression, size, values, data, raw)


def _read_file_header(file: BinaryIO) -> bool:
    """Read the header of a file; return whether its blocks have checksums."""
    _, version, checksum = struct.unpack("<4sIH", _exactly(file, 10, "the header"))
    if version != _VERSION:
        raise GcodeError(
            f"the binary file is of version {version}, and only {_VERSION} is known; "
            "export plain G-code instead"
        )
    if checksum not in _CHECKSUMS:
        raise GcodeError(
            f"the binary file has checksums of type {checksum}, and only 0 (none) and 1 (CRC32) "
            "are known: it is damaged or of a newer kind; export plain G-code instead"
        )
    return bool(checksum)


def _file_header(*, checked: bool) -> bytes:
    return struct.pack("<4sIH", b"GCDE", _VERSION, _CHECKSUMS[checked])


def _checksum(file: BinaryIO, block: bytes, place: str) -> bytes:
    stored = _exactly(file, 4, place)
    found, said = zlib.crc32(block), int.from_bytes(stored, "little")
    if found != said:
        raise GcodeError(
            f"{place} is damaged: its CRC32 is {found:08x} and should be {said:08x}; copy or "
            "export the file again"
        )
    return stored


def _exactly(file: BinaryIO, count: int, place: str) -> bytes:
    data = file.read(count)
    if len(data) < count:
        raise GcodeError(
            f"the binary file ends inside {place}: it was cut off; copy or export it again"
        )
    return data


def _text_of(block: Block, unpacker: Unpacker) -> bytes:
    (encoding,) = block.parameters
    if encoding not in set(Encoding):
        raise GcodeError(
            f"{block.place} has the unknown encoding {encoding} (0 text, 1 and 2 "
            "MeatPack); export plain G-code instead"
        )
    data = block.content()
    if encoding == Encoding.ASCII:
        return data
    try:
        return unpacker.push(data)
    except ValueError as error:
        raise GcodeError(f"{block.place} is damaged: it {error}") from None


def _pieces(text: BinaryIO) -> Iterator[bytes]:
    """Cut a text at line ends into pieces of one block each."""
    rest = b""
    # A line that is longer than a block makes a longer block; doubling keeps that cheap.
    while data := text.read(max(_PIECE_BYTES - len(rest), len(rest))):
        piece, newline, rest = (rest + data).rpartition(b"\n")
        if newline:
            yield piece + newline
        if len(rest) > BLOCK_BYTES // 2:
            raise GcodeError(
                f"a line of more than {BLOCK_BYTES >> 21} MiB cannot be written as binary G-code; "
                "write plain G-code instead"
            )
    if rest:
        yield rest


def _thumbnail(block: Block) -> bytes:
    form, width, height = block.parameters
    if form >= len(_THUMBNAIL_TAGS):
        return b""
    tag = _THUMBNAIL_TAGS[form]
    image = base64.b64encode(block.content()).decode("ascii")
    columns = range(0, len(image), _BASE64_COLUMNS)
    lines = [
        "",
        ";",
        f"; {tag} begin {width}x{height} {len(image)}",
        *(f"; {image[k : k + _BASE64_COLUMNS]}" for k in columns),
        f"; {tag} end",
        ";",
        "",
    ]
    return "\n".join(lines).encode("ascii")
