"""Sliced 3MF packages, kinds by magic, and names that ask for a kind."""

from __future__ import annotations

import hashlib
import io
import os
import signal
import subprocess
import sys
import tempfile
import textwrap
import warnings
import zipfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stillpath.gcode.containers.opening import open_text, rewriting
from stillpath.gcode.containers.sniff import Kind, sniff
from stillpath.gcode.errors import GcodeError
from tests.checkout import PYTHONPATH
from tests.gcode.container_files import binary, members, package, refused, rewritten, text_of

TEXT = b"G28\nG1 X10 Y5 F6000\r\n\nG1X20"
NEW = b"; stamp\n" + TEXT * 100


@pytest.mark.parametrize("upper", [True, False])
def test_a_new_text_and_its_digest(tmp_path: Path, upper: bool):
    file = package({2: TEXT}, upper=upper)
    assert text_of(file, tmp_path) == TEXT
    made = rewritten(file, NEW, tmp_path)
    digest = hashlib.md5(NEW).hexdigest().encode()
    changed = {
        "Metadata/plate_2.gcode": NEW,
        "Metadata/plate_2.gcode.md5": digest.upper() if upper else digest + b"\n",
    }
    assert members(made) == members(file) | changed
    assert list(members(made)) == list(members(file))
    with zipfile.ZipFile(io.BytesIO(file)) as old, zipfile.ZipFile(io.BytesIO(made)) as new:
        assert new.comment == old.comment
        for a, b in zip(old.infolist(), new.infolist(), strict=True):
            assert (a.date_time, a.compress_type, a.external_attr) == (
                b.date_time,
                b.compress_type,
                b.external_attr,
            )


def test_an_unchanged_text_makes_the_same_file(tmp_path: Path):
    file = package({1: TEXT})
    assert rewritten(file, TEXT, tmp_path) == file


def test_a_plate_is_chosen(tmp_path: Path):
    file = package({1: b"G28\n", 3: TEXT, 12: b"T0\n"})
    refused(file, tmp_path, r"several sliced plates \(1, 3, 12\): say which")
    refused(file, tmp_path, "no sliced plate 2; there is 1, 3, 12", plate=2)
    assert text_of(file, tmp_path, plate=3) == TEXT
    made = members(rewritten(file, NEW, tmp_path, plate=3))
    assert made["Metadata/plate_3.gcode"] == NEW
    assert made["Metadata/plate_1.gcode"] == b"G28\n"
    assert made["Metadata/plate_12.gcode.md5"] == members(file)["Metadata/plate_12.gcode.md5"]


@pytest.mark.parametrize("content", [TEXT, binary(TEXT)])
def test_what_is_no_package_has_no_plates(tmp_path: Path, content: bytes):
    path = tmp_path / "part.gcode"
    path.write_bytes(content)
    with pytest.raises(GcodeError, match="has no plates"), open_text(path, plate=1):
        pass


def test_packages_that_are_refused(tmp_path: Path):
    refused(package({}), tmp_path, "no sliced plate")
    wrapped = package({}, more={"part.gcode": TEXT})
    refused(wrapped, tmp_path, "ZIP archive with 'part.gcode' in it.*unpack")
    ultimakers = package({}, more={"/3D/model.gcode": TEXT, "/Metadata/thumbnail.png": b"x"})
    refused(ultimakers, tmp_path, r"UltiMaker Format Package.*let Cura save a G-code file")
    for name in ("../evil.gcode", "/etc/x", "a/../../x", "C:\\x", "..\\x"):
        refused(package({1: TEXT}, more={name: b"x"}), tmp_path, "leads out of it")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        twice = io.BytesIO(package({1: TEXT}))
        with zipfile.ZipFile(twice, "a") as archive:
            archive.writestr("Metadata/plate_1.gcode", b"M112\n")
    refused(twice.getvalue(), tmp_path, "same name")
    refused(package({1: bytes(1 << 27)}), tmp_path, "unpacks to more than 64 MiB")
    crowd = package({1: TEXT}, more={f"m{k}": b"" for k in range(10_001)})
    refused(crowd, tmp_path, "members, more than 10000")
    file = bytearray(package({1: TEXT}))
    with zipfile.ZipFile(io.BytesIO(bytes(file))) as archive:
        assert archive.namelist()[2] == "Metadata/plate_1.gcode"
    names = {f"{k:03}" + 60_000 * "n": b"" for k in range(80)}
    refused(package({1: TEXT}, more=names), tmp_path, "directory has more than 4 MiB")
    encrypted = [k for k in range(len(file)) if file[k : k + 4] == b"PK\1\2"][2] + 8
    file[encrypted] |= 1
    refused(bytes(file), tmp_path, "cannot be read .*encrypted")


def test_a_text_that_is_not_what_the_digest_says_is_refused(tmp_path: Path):
    file = package({1: TEXT, 2: NEW})
    changed = io.BytesIO()
    with zipfile.ZipFile(changed, "w") as archive:
        for name, content in members(file).items():
            archive.writestr(name, b"G1 X9\n" + content if name.endswith("1.gcode") else content)
    right, other = (hashlib.md5(data).hexdigest() for data in (TEXT, b"G1 X9\n" + TEXT))
    words = f"plate_1.gcode.md5 says {right}, and .*{other}.*export the sliced file again"
    refused(changed.getvalue(), tmp_path, words, plate=1)
    assert text_of(changed.getvalue(), tmp_path, plate=2) == NEW


def test_what_stands_beside_a_plate_may_be_long_or_endless(tmp_path: Path):
    info = b"<plate>" * 300_000 + b'<metadata key="index" value="1"/>'
    beside = {"Metadata/slice_info.config": info, "Metadata/plate_2.gcode.md5": b" " * 5_000_000}
    made = members(rewritten(package({1: TEXT}, more=beside), NEW, tmp_path))
    assert made["Metadata/plate_1.gcode"] == NEW
    assert {name: made[name] for name in beside} == beside
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sliced = hashlib.md5(TEXT, usedforsecurity=False).hexdigest().upper().encode()
        digest = {"Metadata/plate_1.gcode.md5": sliced + b" " * 5_000_000}
        plate = io.BytesIO()
        with zipfile.ZipFile(plate, "w") as archive:
            archive.writestr("Metadata/plate_1.gcode", TEXT)
            archive.writestr(*digest.popitem())
    made = members(rewritten(plate.getvalue(), NEW, tmp_path))
    told = made["Metadata/plate_1.gcode.md5"]
    assert told.strip().decode() == hashlib.md5(NEW, usedforsecurity=False).hexdigest().upper()
    assert len(told) < 2000


def test_damage_is_told(tmp_path: Path):
    file = package({1: TEXT * 500})
    for cut in range(4, len(file) - len(b"sliced"), 13):
        refused(file[:cut], tmp_path, "cannot be read")
    damaged = bytearray(file)
    damaged[file.index(b"plate_1.gcode") + 40] ^= 255
    refused(bytes(damaged), tmp_path, "cannot be read")


@given(st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(0, 255)), min_size=1, max_size=8))
def test_mutated_packages_are_text_or_an_error(changes: list[tuple[int, int]]):
    file = bytearray(package({1: TEXT}))
    for place, value in changes:
        file[4 + place % (len(file) - 4)] = value
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            text_of(bytes(file), folder)
            rewritten(bytes(file), NEW, folder)
        except GcodeError:
            pass


@pytest.mark.parametrize("name", ["x", "x.gcode", "x.bgcode", "x.gcode.3mf", ".8_0.gcode.pp"])
def test_the_magic_counts_and_not_the_name(tmp_path: Path, name: str):
    path = tmp_path / name
    for content, kind in ((TEXT, Kind.TEXT), (binary(TEXT), Kind.BGCODE)):
        path.write_bytes(content)
        assert sniff(path) is kind
        target = tmp_path / f"out{path.suffix}"
        with open_text(path) as container, rewriting(container, target, name=target) as made:
            made.write(container.text.read())
        assert target.read_bytes() == content


def test_the_name_of_the_output_may_ask_for_plain_text(tmp_path: Path):
    source, target = tmp_path / "part.gcode.3mf", tmp_path / "part.gcode"
    source.write_bytes(package({1: TEXT}))
    with open_text(source) as container, rewriting(container, target, name=target) as made:
        made.write(NEW)
    assert target.read_bytes() == NEW


@pytest.mark.parametrize(
    ("content", "source", "target"),
    [
        (TEXT, "a.gcode", "b.bgcode"),
        (TEXT, "a.gcode", "b.gcode.3mf"),
        (binary(TEXT), "a.bgcode", "b.3mf"),
        (package({1: TEXT}), "a.3mf", "b.bgcode"),
    ],
)
def test_the_name_cannot_ask_for_more(tmp_path: Path, content: bytes, source: str, target: str):
    path, made = tmp_path / source, tmp_path / target
    path.write_bytes(content)
    with (
        open_text(path) as container,
        pytest.raises(GcodeError, match="choose another name"),
        rewriting(container, made, name=made),
    ):
        pass
    assert not made.exists()


@pytest.mark.parametrize("content", [binary(TEXT * 9000), package({1: TEXT * 9000})])
def test_nothing_is_left_of_a_killed_writer(tmp_path: Path, content: bytes):
    source = tmp_path / "part.any"
    source.write_bytes(content)
    program = """
        import os, signal, sys
        from pathlib import Path
        from stillpath.gcode.containers.opening import open_text, rewriting
        from stillpath.pipeline.files import replacing

        def die(done):
            if done > 0.5:
                os.kill(os.getpid(), signal.SIGKILL)

        source = Path(sys.argv[1])
        with replacing(source) as target, open_text(source, folder=source.parent) as container:
            with rewriting(container, target, name=source, progress=die) as made:
                made.write(b"; stamp" + container.text.read())
    """
    code = textwrap.dedent(program)
    done = subprocess.run(
        [sys.executable, "-c", code, str(source)], env={**os.environ, "PYTHONPATH": PYTHONPATH}
    )
    assert done.returncode == -signal.SIGKILL
    assert source.read_bytes() == content
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bgcode", "3mf"])
def test_memory_does_not_grow_with_the_file(tmp_path: Path, kind: str):
    program = """
        import resource, sys
        from pathlib import Path
        from stillpath.gcode.containers.opening import open_text, rewriting

        source, size = Path(sys.argv[1]), int(sys.argv[2])
        first, second = source.with_name("first"), source.with_name("second")
        lines = b"".join(
            b"G1 X%d.%03d Y%d E.%05d\\n" % (k % 251, k % 997, k % 241, k * 7919 % 99991)
            for k in range(40_000)
        )
        with open_text(source) as container, rewriting(container, first, name=first) as made:
            while made.tell() < size:
                made.write(lines)
        with open_text(first) as container, rewriting(container, second, name=second) as made:
            made.write(b"; stamp\\n")
            while data := container.text.read(1 << 20):
                made.write(data)
        with open_text(second) as container:
            assert container.text.seek(0, 2) >= size
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10)
    """
    source = tmp_path / "part.any"
    source.write_bytes(binary(TEXT, compression=1) if kind == "bgcode" else package({1: TEXT}))
    peak_mib = []
    for size in (1_000_000, 20_000_000):
        done = subprocess.run(
            [sys.executable, "-c", textwrap.dedent(program), str(source), str(size)],
            env={**os.environ, "PYTHONPATH": PYTHONPATH, "TMPDIR": str(tmp_path)},
            capture_output=True,
            text=True,
            check=True,
        )
        peak_mib.append(int(done.stdout))
    assert peak_mib[1] < peak_mib[0] + 10, peak_mib
