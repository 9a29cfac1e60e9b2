from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from stillpath.gcode.detection import DIALECTS, detect

# Which firmware a file of the corpus was written for, and whether a person should look.
EXPECTED = {
    "arcwelder_ender3_gear24_absE": ("marlin", False),
    "arcwelder_mk3s_xyzcube": ("marlin", False),
    "cura_ender3_gear24": ("marlin", False),
    "cura_prusa_mk3_reltiveE_tris24": ("marlin", False),
    "cura_um2_ultigcode_hept24f": ("marlin", False),
    "hm_arcs_planes_marlin": ("marlin", True),
    "hm_cnc_inches_g20_numbered": ("marlin", True),
    "hm_dialect_torture": ("klipper", True),
    "hm_laser_grbl": ("marlin", True),
    "hm_no_final_newline": ("marlin", True),
    "klipper_excludeobj_multi": ("klipper", False),
    "ps_ender3_gear24_absE": ("marlin", False),
    "ps_ender3_pauses_hept24f": ("marlin", False),
    "ps_jubilee_rrf_toolchange": ("reprapfirmware", True),
    "ps_mk3s_gyroid_medium": ("marlin", False),
    "ps_mk3s_vase": ("marlin", False),
    "ps_mk3s_xyzcube": ("marlin", False),
    "ps_trilab_rrf_tris24": ("reprapfirmware", False),
    "ps_voron_klipper_ringing": ("klipper", False),
    "slic3r_mach3_hept24f": ("marlin", True),
    "hdr_cura_5.1.0": ("marlin", False),
    "hdr_mks_sample": ("marlin", False),
    "hdr_orca_2.3.0": ("klipper", False),
    "hdr_prusa_2.9.3": ("marlin", True),
    "hdr_qidi_sample": ("marlin", False),
    "hdr_snapmaker_sample": ("marlin", False),
    "hdr_weedo_sample": ("marlin", False),
    "real_bambustudio1.10_k1max": ("klipper", False),
    "real_bambustudio2.3_20mm": ("marlin", False),
    "real_cura4.10_objs": ("klipper", False),
    "real_kisslicer2.0.6": ("marlin", True),
    "real_libbgcode_mini_cube_b_ref": ("prusa", False),
    "real_orcaslicer2.3.0b2": ("klipper", False),
    "real_prusaslicer2.3.3_thumb": ("klipper", False),
    "real_superslicer2.3_arcwelder": ("klipper", False),
}


@pytest.mark.shared
def test_the_firmware_of_every_file_of_the_corpus(shared_dir: Path) -> None:
    found = {}
    for path in sorted((shared_dir / "corpus").glob("*/*.gz")):
        data = gzip.decompress(path.read_bytes())
        result = detect(data[: 1 << 20], data[-(1 << 20) :])
        found[path.name.removesuffix(".gz").rsplit(".", 1)[0]] = (result.dialect, result.doubtful)
        assert result.reasons
    assert found == EXPECTED


@pytest.mark.parametrize(
    ("text", "dialect"),
    [
        ("M620 S0A\nT0\nM621 S0A\n", "bambu"),
        ("; BambuStudio 02.03\n; gcode_flavor = marlin\nM1002 gcode_claim_action : 1\n", "bambu"),
        ('; gcode_flavor = marlin2\nM862.3 P "MK4"\nM555 X1 Y1 W2 H2\n', "prusa"),
        ("; printer_model = COREONEMMU3\nM205 X8 Y8\n", "prusa"),
        ("; printer_model = COREONE_INDX8T\n; gcode_flavor = marlin2\nM900 K0\n", "prusa"),
        ('M862.3 P "COREONEOAK"\n; gcode_flavor = marlin2\n', "prusa"),
        ("; printer_model = MK3SMMU3\nM572 S0\n", "marlin"),
        ("; printer_model = MINI_AERO\nM205 X8 Y8\n", "marlin"),
        ("; printer_model = XLARGE 500\nM205 X8 Y8\n", "marlin"),
        ("set_velocity_limit accel=3000\n", "klipper"),
        ("if move.axes[0].homed\n  G28\nM566 X600\n", "reprapfirmware"),
        ('M593 P"none"\nM572 S0\nM204 P2000 T2000\n', "reprapfirmware"),
        ("G1 X1\n; SET_VELOCITY_LIMIT in a comment is no command\nM205 X8 Y8\n", "marlin"),
    ],
)
def test_single_commands_tell_the_firmware(text: str, dialect: str) -> None:
    assert detect(text.encode()).dialect == dialect


def test_nothing_and_anything() -> None:
    empty = detect(b"")
    assert (empty.certainty, empty.doubtful) == (0.0, True)
    both = detect(b"; gcode_flavor = marlin\nSET_VELOCITY_LIMIT ACCEL=5\nM205 X8\n")
    assert any(reason.startswith("but ") for reason in both.reasons)
    assert detect(bytes(range(256)) * 99).dialect in DIALECTS
