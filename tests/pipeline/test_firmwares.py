"""The whole pipeline for machines that run something else than Klipper."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from stillpath.gcode.firmware.registry import adapter
from stillpath.models.errors import ModelError
from stillpath.models.store import load_machine
from stillpath.pipeline.compensate import compensate_file
from stillpath.pipeline.measuring.reference_shaper import cached_shaper
from stillpath.pipeline.options import Options
from stillpath.pipeline.simulate import plan_file, simulate_file
from tests.compensating import compensated
from tests.fuzz.machines import machine_of
from tests.gcode.cutting import ender3_with
from tests.gcode.prints import polygon
from tests.gcode.states import differences, tagged

KINDS = ("marlin", "reprapfirmware")

LIMITS = {"marlin": "M204 P1200 T1500", "reprapfirmware": "M204 P1200 T1500"}
BODY = (
    "G28\nG90\nM83\nG1 X50 Y50 Z5 F6000\nG1 X60 Y50 F6000\nG4 P10\nG1 X120 Y100 F6000\n"
    + "\n".join(polygon(6, 15))
    + "\nG1 E-1 F2100\nG1 Z5.4 F600\nG1 X60 Y60 F9000\nG1 Z5 F600\nG1 E1 F2100\n{limits}\n"
    + "M106 S100\nG91\nM83\nG1 X20 Y5 E1 F3000\nG1 X-20 Y15 E1\nG90\n{relative}"
    + "G1 X100 Y90 E1\nM82\nG92 E0\nG1 X60 Y70 E2\nG1 X80 Y100 E4\nG1 E3 F2100\nM400\nG1 X5 Y5\n"
)


def body(kind: str) -> bytes:
    # Marlin's G90 makes E absolute.
    relative = "M83\n" if kind == "marlin" else ""
    return BODY.format(limits=LIMITS[kind], relative=relative).encode()


@pytest.mark.parametrize(
    ("kind", "beside_a_rest"),
    [
        *((kind, b"") for kind in KINDS),
        ("reprapfirmware", b" G91\nG1 X3 Y4 F6000\nG90"),
        ("reprapfirmware", b" M204 P700"),
    ],
)
def test_the_written_file_beats_the_shaper_and_keeps_the_state(
    kind: str, beside_a_rest: bytes, tmp_path: Path, cache: Path
) -> None:
    machine = ender3_with(kind)
    hop = b"G1 Z5.4 F600"
    data = tagged(body(kind).replace(hop, hop + beside_a_rest))
    result, written = compensated(data, tmp_path, cache, machine)
    assert result.put_back == []
    assert result.pieces >= 1
    assert differences(data, written, machine) == []
    if beside_a_rest:  # what a line sets beside its move is the file's own, not a stream's
        lead = written[: written.index(hop + beside_a_rest.split(b"\n")[0])]
        assert lead.rindex(b"stream off") > lead.rindex(b"stream on")
    if kind == "reprapfirmware":  # limits hold when read, so they wait for the move before them
        assert written.count(b"\nG1\nM201 X") == written.count(b"\nM201 X") > 2 * result.pieces
    rms = {c.name: c.extruding.contour_rms_um for c in result.channels}
    assert rms["after"] < 0.6 * min(rms["before"], rms["shaper"])
    # Marlin starts each stretch with a slow step, and lines that end at a rest stand for some
    # milliseconds. RepRapFirmware waits before each stretch, where the sliced file may not stop.
    waits_s = result.pieces * adapter(machine).restart_s
    late_s = result.time_s - result.original_time_s
    assert abs(late_s) < 9e-3 * result.original_time_s + waits_s
    assert result.filament_error_mm < 1e-2
    # The lines that the printer reads, not those of the fit behind them.
    in_streams = re.findall(rb"; stillpath: stream on\n(.*?); stillpath: stream off", written, re.S)
    lines = sum(len(re.findall(rb"^G1 .*[XY]", text, re.M)) for text in in_streams)
    assert result.segments == pytest.approx(lines, rel=0.02)
    assert result.peak_segments_per_s > result.segments_per_s > 20.0


@pytest.mark.parametrize("kind", ["klipper", *KINDS])
def test_a_fan_is_switched_where_the_file_says(kind: str, tmp_path: Path, cache: Path) -> None:
    """A straight line at one speed would be a single segment."""
    machine = ender3_with(kind)
    fans = [(x, f"G1 X{x} E.2\nM106 S{x}\n") for x in range(55, 150, 5)]
    text = "G28\nG90\nM83\nG1 X50 Y50 Z1 F6000\nG1 X50 Y60 F3000\n"
    text += "".join(line for _, line in fans) + "G1 X200 E1\nG1 Y80 E1\n"
    result, written = compensated(text, tmp_path, cache, machine)
    assert result.put_back == []
    x_mm, seen = 0.0, {}
    for line in written.decode().splitlines():
        if line.startswith("M106"):
            seen[int(line.removeprefix("M106 S"))] = x_mm
        elif found := re.match(r"G1 .*?X([\d.]+)", line):
            x_mm = float(found[1])
    assert list(seen) == [x for x, _ in fans]
    assert list(seen.values()) == pytest.approx(list(seen), abs=0.3)


@pytest.mark.parametrize("kind", KINDS)
def test_a_move_of_less_than_a_step_alone(kind: str, tmp_path: Path, cache: Path) -> None:
    """Seen by fuzzing: of a wipe that the motors round away nothing is left but its filament."""
    lines = ("G28", "G90", "M83", "G1 X78.802 Y50 F6000", "G4 P1", "G1 X78.800 Y50 E-.17", "G4 P1")
    data = tagged("\n".join([*lines, "G1 X90 E1", ""]).encode())
    _, written = compensated(data, tmp_path, cache, ender3_with(kind))
    assert differences(data, written, ender3_with(kind)) == []


def test_a_turn_that_the_shaper_makes_shorter_than_marlins_least_move(
    tmp_path: Path, cache: Path
) -> None:
    """Seen by fuzzing: nothing of .1 mm there and back was left to write."""
    text = "G1 X100 Y100 E0\nM221 S95\nG1 Y100.1\nG1 Y100.0\n"
    result, _ = compensated(text, tmp_path, cache, ender3_with("marlin"), method="shaper:ei")
    (piece,) = result.put_back
    assert piece.reason == "line 3: all moves round to zero at the resolution of a file"


def test_marlins_g90_is_followed_by_m83(tmp_path: Path, cache: Path) -> None:
    _, written = compensated(body("marlin"), tmp_path, cache, ender3_with("marlin"))
    stream = written.decode().partition("stream on")[2]
    ours = re.findall(r"^G90\nM83\nG1 X", stream, re.MULTILINE)
    assert ours
    assert not re.search(r"^G90\nG1 X", stream, re.MULTILINE)


@pytest.mark.parametrize("kind", KINDS)
def test_plan_and_simulate_agree(kind: str, tmp_path: Path, cache: Path) -> None:
    source = tmp_path / "in.gcode"
    source.write_bytes(body(kind))
    machine = ender3_with(kind)
    planned = plan_file(source, tmp_path / "motion.npz", machine)
    simulated = simulate_file(source, machine, cache_dir=cache)
    assert simulated.time_s == pytest.approx(planned.time_s)
    assert [c.name for c in simulated.channels] == ["before", "shaper"]
    assert cached_shaper(machine, cache, 1e-3).label == simulated.best_shaper


def test_what_a_firmware_cannot_execute_is_refused(tmp_path: Path, cache: Path) -> None:
    machine = ender3_with("marlin")
    firmware = machine.firmware.model_copy(update={"variant": "bugfix"})
    source, target = tmp_path / "in.gcode", tmp_path / "out.gcode"
    source.write_bytes(body("marlin"))
    with pytest.raises(ModelError, match=r"ender3 cannot execute .*; install release 2\.1\.2"):
        compensate_file(
            source,
            target,
            machine.model_copy(update={"firmware": firmware}),
            Options(),
            cache_dir=cache,
        )
    assert list(tmp_path.iterdir()) == [source]


def test_a_dialect_that_the_machine_does_not_read_is_refused(tmp_path: Path) -> None:
    source = tmp_path / "in.gcode"
    source.write_bytes(body("marlin"))
    with pytest.raises(ModelError, match=r"ender3 runs Klipper and reads every file as Klipper"):
        plan_file(source, tmp_path / "m.npz", load_machine("ender3"), dialect="marlin")
    plan_file(source, tmp_path / "m.npz", ender3_with("marlin"), dialect="prusa")


def test_a_file_for_another_firmware_is_doubted(tmp_path: Path, cache: Path) -> None:
    foreign = b"; gcode_flavor = reprapfirmware\nM566 X600 Y600 Z30 E300\n"
    source, data = tmp_path / "in.gcode", foreign + body("reprapfirmware")
    source.write_bytes(data)
    marlin, motion = ender3_with("marlin"), tmp_path / "m.npz"
    (warning,) = plan_file(source, motion, marlin).warnings
    assert "written for reprapfirmware (gcode_flavor = reprapfirmware; " in warning
    assert "ender3 reads it as Marlin does" in warning
    assert "--" not in warning
    assert plan_file(source, motion, marlin, dialect="marlin").warnings == []
    assert plan_file(source, motion, ender3_with("reprapfirmware")).warnings == []
    assert simulate_file(source, marlin, cache_dir=cache).warnings[0] == warning
    assert warning in compensated(data, tmp_path, cache, marlin)[0].warnings


def test_files_of_prusas_printers_are_doubted(tmp_path: Path) -> None:
    """Neither an MK4 nor an MK3 can execute what is written for a Marlin machine."""
    source, motion = tmp_path / "in.gcode", tmp_path / "m.npz"
    marlin = ender3_with("marlin")
    source.write_bytes(b"; printer_model = MK4S\nM555 X1\n" + body("marlin"))
    (warning,) = plan_file(source, motion, marlin).warnings
    assert "if the printer runs Prusa's own firmware" in warning
    assert "set variant to prusa in its machine" in warning
    source.write_bytes(b'; printer_model = MK3SMMU3\nM862.3 P "MK3S"\n' + body("marlin"))
    (warning,) = plan_file(source, motion, marlin).warnings
    assert "set board to avr in the machine" in warning
    avr = marlin.firmware.model_copy(update={"board": "avr"})
    assert plan_file(source, motion, marlin.model_copy(update={"firmware": avr})).warnings == []
    assert plan_file(source, motion, load_machine("ender3")).warnings == []


def test_klipper_reads_marlins_flavour(tmp_path: Path) -> None:
    source = tmp_path / "in.gcode"
    source.write_bytes(b"; gcode_flavor = marlin2\nM205 X8 Y8\nM900 K.05\n" + body("marlin"))
    assert plan_file(source, tmp_path / "m.npz", load_machine("ender3")).warnings == []


def test_a_rest_with_a_feedrate_that_marlin_passes_over(tmp_path: Path, cache: Path) -> None:
    """It has the file's F, not the stream's."""
    lines = ("G28", "G90", "M83", "G1 X50 Y50 F3000", "G1 X90 E1", "G1 E-1 F0", "G1 X60 Y60")
    data = tagged("\n".join([*lines, "G1 E1 F-5", "G1 X90 E1", ""]).encode())
    result, written = compensated(data, tmp_path, cache, ender3_with("marlin"))
    assert result.put_back == []
    assert differences(data, written, ender3_with("marlin")) == []


def test_behind_m200_no_line_of_ours_counts_in_millimetres(tmp_path: Path, cache: Path) -> None:
    """Cubic ones are counted there, and moves stay as sliced, behind an object's mark too."""
    sliced = b"; printing object b\nG1 X90 Y90 F6000\nG1 X95 E3.1 F1200\n"
    text = b"G28\nG90\nM82\nG1 Z0.2 F600\n; printing object a\nG1 X40 Y50 F6000\nG1 X70 E1 F3600\n"
    text += b"G1 Y80 E2\nG1 X40 E3\nM400\nM200 D1.75\n"
    _, written = compensated(text + sliced, tmp_path, cache, ender3_with("marlin"))
    assert b"; stillpath: stream off" in written
    assert sliced in written


@pytest.mark.parametrize("kind", ["klipper", *KINDS])
@pytest.mark.parametrize(
    ("before", "behind"),
    [
        ("", "G92 E0\nG1 E-1 F1800\n"),  # Simplify3D
        ("", "G1 E2.5 F1800\nG92 E0.5\nG92 X{x} Y50\n;MESH:NONMESH\nG1 E-.5\n;MESH:{name}\n"),
        ("G10\n", "G1 Z6 F600\nG1 Z5 F600\nG11\nG92 E0\n"),  # Cura, with the firmware's retraction
        ("", "G92 E0\nG10\nG1 Z6\nG1 Z5\nG11\nG1 E-1\n;MESH:NONMESH\nG1 Z6\nG1 Z5\n;MESH:{name}\n"),
    ],
)
def test_absolute_filament_behind_an_objects_mark(
    kind: str, before: str, behind: str, tmp_path: Path, cache: Path
) -> None:
    """A G92 of the file counts there, and G10 does not, for it leaves E and F as they are."""
    machine = ender3_with(kind)
    draws = load_machine("ender3").firmware.retraction
    firmware = machine.firmware.model_copy(update={"retraction": draws})
    machine = machine.model_copy(update={"firmware": firmware})
    text = "G28\nG90\nM82\nM220 S80\nM221 S90\nG1 X50 Y50 Z5 F3000\n"
    for name, x in (("a", 60), ("b", 90), ("a", 60)):
        text += before + f";MESH:{name}\n" + behind.format(name=name, x=x - 20)
        text += f"G1 X{x} Y50 F6000\nG1 X{x + 20} E1 F3000\nG1 Y70 E2\nG1 X{x} Y55 E3\n"
        text += f"G1 X{x - 20} Y50 F6000\n"
    data = tagged(text.encode())
    result, written = compensated(data, tmp_path, cache, machine)
    assert result.put_back == []
    assert written.count(b"; stillpath: stream on") >= 3
    assert differences(data, written, machine) == []


_PURGE = "G28\nG1 X50 Y50 Z.3 F6000\nG92 E0\nG1 X90 E9 F1000\nG1 X90 Y90 E18\nG1 E-1 F2400\n"
_PART = "G1 E1 F2400\nG1 X60 Y90 E1.5 F3000\nG1 X60 Y60 E1.5\nG1 X90 Y60 E1.5\n"


def test_filament_fed_before_the_file_says_a_mode_stays_as_sliced(
    tmp_path: Path, cache: Path
) -> None:
    """RepRapFirmware begins with the mode of config.g, which a stream could not give back."""

    def written(text: str, kind: str = "reprapfirmware") -> tuple[str, bool]:
        result, found = compensated(text, tmp_path, cache, machine_of(kind), method="shaper:mzv")
        assert result.pieces > len(result.put_back)
        return found.decode(), any("says M82 or M83" in w for w in result.warnings)

    text, warned = written(f"{_PURGE}M83\n{_PART}")
    before, _, after = text.partition("\nM83\n")
    assert warned
    assert before.endswith(_PURGE.rstrip())
    assert "M82" not in before
    assert "stream on" in after
    assert written(f"if true\n  M83\n{_PURGE}M83\n{_PART}")[1]
    for text in (f"M83\n{_PURGE}{_PART}", f"; M83\nG28\nG90 M83\n{_PURGE}{_PART}"):
        found, warned = written(text)
        assert not warned
        assert "stream on" in found.partition("G1 E-1 F2400")[0]
    found, warned = written(f"{_PURGE}M83\n{_PART}", "marlin")
    assert not warned
    assert "stream on" in found.partition("G1 E-1 F2400")[0]


@pytest.mark.parametrize(
    ("kind", "start"), [("reprapfirmware", _PURGE), ("klipper", "START_PRINT BED=60\n")]
)
def test_a_file_that_says_no_mode_stays_as_sliced(
    tmp_path: Path, cache: Path, kind: str, start: str
) -> None:
    """With Klipper the start macro may have M83: relative E was spread over moves as absolute."""
    text = start + _PART
    result, found = compensated(text, tmp_path, cache, machine_of(kind), method="shaper:mzv")
    assert result.pieces == 0
    assert text in found.decode()
