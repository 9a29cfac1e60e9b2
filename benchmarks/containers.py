"""How fast binary G-code and 3MF packages are packed and unpacked, in CPU seconds of one core.

    ./run python benchmarks/containers.py FILE.gcode

The text is written into an empty container of each kind and read again.
"""

from __future__ import annotations

import argparse
import io
import struct
import tempfile
import time
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

from stillpath.gcode.containers.bgcode import Encoding
from stillpath.gcode.containers.compression import Compression
from stillpath.gcode.containers.opening import open_text, rewriting

_PRINT = b"G28\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file", type=Path)
    text = parser.parse_args().file.read_bytes()
    print("| container | packed, share | write MB/s | read MB/s |\n|---|---|---|---|")
    for name, container in containers():
        measure(container, text[:4096])  # compiles
        size, write_s, read_s = measure(container, text)
        speeds = [len(text) / 1e6 / seconds for seconds in (write_s, read_s)]
        print(f"| {name} | {size / len(text):.2f} | {speeds[0]:.0f} | {speeds[1]:.0f} |")


def containers() -> Iterator[tuple[str, bytes]]:
    for encoding in (Encoding.ASCII, Encoding.MEATPACK_COMMENTS):
        for compression in Compression:
            name = f"bgcode, {compression.name.lower()}, {encoding.name.lower()}"
            yield name, binary(compression, encoding)
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("Metadata/plate_1.gcode", _PRINT)
    yield "3mf, deflate", made.getvalue()


def binary(compression: Compression, encoding: Encoding) -> bytes:
    """A file of one block, which holds no text but tells how text is packed."""
    block = struct.pack("<HHI", 1, compression, 0)
    data = zlib.compress(b"") if compression is Compression.DEFLATE else b""
    if compression is not Compression.NONE:
        block += struct.pack("<I", len(data))
    block += struct.pack("<H", encoding) + data
    return struct.pack("<4sIH", b"GCDE", 1, 1) + block + struct.pack("<I", zlib.crc32(block))


def measure(container: bytes, text: bytes) -> tuple[int, float, float]:
    """Size of the container around a text; CPU seconds of writing and of reading it."""
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder, "source"), Path(folder, "target")
        source.write_bytes(container)
        with open_text(source) as opened:
            began = time.process_time()
            with rewriting(opened, target, name=target) as made:
                made.write(text)
            written = time.process_time()
        with open_text(target):
            read = time.process_time()
        return target.stat().st_size, written - began, read - written


if __name__ == "__main__":
    main()
