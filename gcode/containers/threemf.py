"""Sliced 3MF packages (.gcode.3mf): a zip archive with the G-code of each plate.

`Metadata/plate_N.gcode` is the G-code, `Metadata/plate_N.gcode.md5` its MD5 in hexadecimal digits
(upper case from the slicers seen; the case found is kept), which the printer checks. Nothing is
ever unpacked to names of the archive.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import io
import lzma
import re
import shutil
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from stillpath.gcode.containers.limits import check_unpacked, largest_unpacked
from stillpath.gcode.errors import GcodeError

__all__ = ["ThreeMf"]

_PLATE = re.compile(r"Metadata/plate_([1-9]\d{0,3})\.gcode")
_SLICE_INFO = "Metadata/slice_info.config"
_LARGEST_INFO_BYTES = 1 << 22
_OF_ULTIMAKER = "/3D/model.gcode"
_DIGEST = re.compile(rb"\s*([0-9A-Fa-f]{32})")
_LARGEST_DIGEST_BYTES = 1 << 10
_COPY_BYTES = 1 << 20
_MOST_MEMBERS = 10_000
_LARGEST_DIRECTORY_BYTES = 1 << 22
_BROKEN = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    struct.error,
    NotImplementedError,
    RuntimeError,
    ValueError,
    OverflowError,
    IndexError,
)
"""What zipfile raises for damaged, encrypted and newer archives."""


class ThreeMf:
    """The parts of a package needed to write it again with another text of one plate.

    Attributes
    ----------
    delay_s : float
        How much longer the plate takes to print with the new text.

    Parameters
    ----------
    source : Path
        The file; read again when another is written.
    text : BinaryIO
        Receives the G-code.
    progress : callable
        Is given the share of the plate that was read, now and then.
    plate : int, optional
        Which plate; needed if several are sliced.

    Raises
    ------
    GcodeError
        The archive is damaged, encrypted or unpacks to more than is sane, or has no such plate.
    """

    def __init__(
        self, source: Path, text: BinaryIO, progress: Callable[[float], None], plate: int | None
    ) -> None:
        self.delay_s = 0.0
        self._source = source
        with _reading(source) as archive:
            _check(archive, largest_unpacked(source))
            self._name = _chosen(archive.namelist(), plate)
            size = max(archive.getinfo(self._name).file_size, 1)
            digest = hashlib.md5(usedforsecurity=False)
            with archive.open(self._name) as member:
                while data := member.read(_COPY_BYTES):
                    text.write(data)
                    digest.update(data)
                    progress(member.tell() / size)
            _check_digest(archive, f"{self._name}.md5", digest.hexdigest())

    def write(self, text: BinaryIO, target: BinaryIO, progress: Callable[[float], None]) -> None:
        """Write a package around a text; its other members and plates are kept as they are."""
        digest, size = _md5(text)
        with _reading(self._source) as archive, zipfile.ZipFile(target, "w") as made:
            made.comment = archive.comment
            for info in archive.infolist():
                ours = info.filename == self._name
                with made.open(_like(info, size if ours else info.file_size), "w") as member:
                    if ours:
                        while data := text.read(_COPY_BYTES):
                            member.write(data)
                            progress(text.tell())
                    elif info.filename == f"{self._name}.md5":
                        with archive.open(info) as original:
                            member.write(_renewed(original.read(_LARGEST_DIGEST_BYTES), digest))
                    elif info.filename == _SLICE_INFO and _is_small(info):
                        member.write(_retimed(archive.read(info), self._name, self.delay_s))
                    else:
                        with archive.open(info) as original:
                            shutil.copyfileobj(original, member, _COPY_BYTES)

    def write_plain(self, text: BinaryIO, target: BinaryIO) -> None:
        """Write plain G-code: the text as it is."""
        shutil.copyfileobj(text, target, _COPY_BYTES)


class _Bounded(io.BufferedReader):
    """A file that limits single reads to the largest plausible directory."""

    def read(self, size: int | None = -1, /) -> bytes:
        most = _LARGEST_DIRECTORY_BYTES
        data = super().read(most + 1 if size is None or size < 0 else min(size, most + 1))
        if len(data) > most:
            raise GcodeError(
                f"the 3MF package's directory has more than {most >> 20} MiB: that is no sliced "
                "print"
            )
        return data


@contextlib.contextmanager
def _reading(source: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive; what is wrong with it becomes a `GcodeError`."""
    try:
        with (
            source.open("rb", buffering=0) as raw,
            _Bounded(raw) as file,
            warnings.catch_warnings(),
            zipfile.ZipFile(file) as archive,
        ):
            # Of names that occur twice, which are refused.
            warnings.simplefilter("ignore", UserWarning)
            yield archive
    except GcodeError:
        raise
    except _BROKEN as error:
        raise _broken(error) from None
    except OSError as error:
        # A damaged directory makes zipfile seek before the beginning.
        if error.errno != errno.EINVAL:
            raise
        raise _broken(error) from None


def _broken(error: Exception) -> GcodeError:
    reason = str(error) or type(error).__name__
    return GcodeError(f"the 3MF package cannot be read ({reason}): copy or export it again")


def _check(archive: zipfile.ZipFile, largest: int) -> None:
    members = archive.infolist()
    if len(members) > _MOST_MEMBERS:
        raise GcodeError(
            f"the 3MF package has {len(members)} members, more than {_MOST_MEMBERS}: "
            "that is no sliced print"
        )
    check_unpacked(sum(info.file_size for info in members), largest)
    names = [info.filename for info in members]
    if len(set(names)) < len(names):
        raise GcodeError("the 3MF package has members of the same name: export it again")
    if _OF_ULTIMAKER in names:
        raise GcodeError(
            "the file is an UltiMaker Format Package (.ufp), which is not read: let Cura save a "
            "G-code file (.gcode), or unpack it and give its 3D/model.gcode"
        )
    for name in names:
        path = PurePosixPath(name.replace("\\", "/"))
        if path.is_absolute() or ".." in path.parts or ":" in name:
            raise GcodeError(
                f"the 3MF package has a member that leads out of it, {name[:80]!r}: "
                "no slicer made it; export it again"
            )


def _chosen(names: list[str], plate: int | None) -> str:
    plates = {int(found[1]): name for name in names if (found := _PLATE.fullmatch(name))}
    inside = next((name for name in names if name.lower().endswith((".gcode", ".bgcode"))), None)
    if not plates and inside is not None:
        raise GcodeError(
            f"the file is a ZIP archive with {inside[:80]!r} in it, and no 3MF package: "
            "unpack it, and give what was in it"
        )
    if not plates:
        raise GcodeError(
            "the package holds no sliced plate (Metadata/plate_N.gcode): slice it, and export the "
            "sliced file"
        )
    listed = ", ".join(str(number) for number in sorted(plates))
    if plate is None:
        if len(plates) > 1:
            raise GcodeError(
                f"the package holds several sliced plates ({listed}): say which one to work on "
                "(option plate); the others stay as they are"
            )
        (plate,) = plates
    if plate not in plates:
        raise GcodeError(f"the package holds no sliced plate {plate}; there is {listed}")
    return plates[plate]


def _check_digest(archive: zipfile.ZipFile, name: str, digest: str) -> None:
    """Refuse G-code that is not what the package's MD5 belongs to: ours would hide that."""
    if name not in archive.namelist():
        return
    with archive.open(name) as member:
        told = _DIGEST.match(member.read(_LARGEST_DIGEST_BYTES))
    if told is not None and told[1].lower() != digest.encode():
        raise GcodeError(
            f"the 3MF package's {name} says {told[1].decode().lower()}, and the MD5 of the plate "
            f"is {digest}: something changed the G-code after it was sliced, and a printer may "
            "refuse the package; export the sliced file again"
        )


def _retimed(info: bytes, name: str, delay_s: float) -> bytes:
    """Return the list of plates with another prediction, in whole seconds, for one of them."""
    found = _PLATE.fullmatch(name)
    number = found[1].encode() if found else b""
    end = 0
    while (begin := info.find(b"<plate>", end)) >= 0 and (
        end := info.find(b"</plate>", begin)
    ) >= 0:
        plate = info[begin:end]
        if re.search(rb'key="index"\s+value="%s"' % number, plate):
            told = re.search(rb'key="prediction"\s+value="(\d{1,18})"', plate)
            if told is None:
                return info
            start = begin + told.start(1)
            seconds = max(round(int(told[1]) + delay_s), 0)
            return info[:start] + b"%d" % seconds + info[start + len(told[1]) :]
    return info


def _md5(text: BinaryIO) -> tuple[str, int]:
    """Return digest and size of a text, and go back to its beginning."""
    digest = hashlib.md5(usedforsecurity=False)
    while data := text.read(_COPY_BYTES):
        digest.update(data)
    size = text.tell()
    text.seek(0)
    return digest.hexdigest(), size


def _is_small(info: zipfile.ZipInfo) -> bool:
    return max(info.file_size, info.compress_size) < _LARGEST_INFO_BYTES


def _like(info: zipfile.ZipInfo, size: int) -> zipfile.ZipInfo:
    """Describe a member of about `size` bytes to be written as the original was."""
    made = zipfile.ZipInfo(info.filename, info.date_time)
    made.compress_type = info.compress_type
    made.external_attr = info.external_attr
    made.create_system = info.create_system
    made.comment = info.comment
    made.file_size = size  # tells whether the fields of large files are needed
    return made


def _renewed(old: bytes, digest: str) -> bytes:
    """Return the digest in the form of the old one; after it, say a line end is kept."""
    form = _DIGEST.match(old)
    lower = form is not None and form[1] != form[1].upper()
    made = digest if lower else digest.upper()
    return made.encode("ascii") + (old[form.end() :] if form else b"")
