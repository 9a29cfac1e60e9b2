"""Marks of every style the reference knows; over the corpus, counts by other means."""

from __future__ import annotations

import gzip
import re
from collections import Counter
from pathlib import Path

import pytest

from stillpath.gcode import _slots as at
from stillpath.gcode.interpreter import Interpreter
from stillpath.gcode.slicers.features import Feature, feature_of, feature_title
from stillpath.gcode.slicers.marks import Mark, MarkKind, read_mark
from stillpath.models.machine import Machine

K = MarkKind


@pytest.mark.parametrize(
    ("comment", "kind", "text"),
    [
        # PrusaSlicer, SuperSlicer, Orca, Creality
        (";LAYER_CHANGE", K.LAYER, ""),
        (";Z:.2", K.Z, ".2"),
        (";HEIGHT:0.15", K.HEIGHT, "0.15"),
        (";WIDTH:0.449999", K.WIDTH, "0.449999"),
        (";TYPE:External perimeter", K.FEATURE, "External perimeter"),
        ("; printing object a b.stl id:0 copy 0", K.OBJECT, "a b.stl id:0 copy 0"),
        ("; stop printing object a b.stl id:0 copy 0", K.OBJECT, ""),
        ("; process Process1", K.OBJECT, "Process1"),  # Simplify3D
        (";WIPE_START", K.WIPE_START, ""),
        (";WIPE_END", K.WIPE_END, ""),
        (";COLOR_CHANGE,T0,#FF0000", K.COLOR_CHANGE, ""),
        (";PAUSE_PRINT", K.PAUSE, ""),
        (";CUSTOM_GCODE", K.CUSTOM, ""),
        # Bambu, Orca on Bambu
        ("; CHANGE_LAYER", K.LAYER, ""),
        ("; Z_HEIGHT: 0.4", K.Z, "0.4"),
        ("; LAYER_HEIGHT: 0.2", K.HEIGHT, "0.2"),
        ("; LINE_WIDTH: 0.42", K.WIDTH, "0.42"),
        ("; FEATURE: Outer wall", K.FEATURE, "Outer wall"),
        ("; OBJECT_ID: 15", K.OBJECT, "15"),
        ("; WIPE_START", K.WIPE_START, ""),
        ("; PAUSE_PRINTING", K.PAUSE, ""),
        # Cura
        (";LAYER:-3", K.LAYER, ""),
        (";TYPE:WALL-OUTER", K.FEATURE, "WALL-OUTER"),
        (";MESH:part.stl", K.OBJECT, "part.stl"),
        (";MESH:NONMESH", K.OBJECT, ""),
        # ideaMaker
        (";LAYER:0", K.LAYER, ""),
        (";Z:0.300", K.Z, "0.300"),
        (";PRINTING:part.stl", K.OBJECT, "part.stl"),
        # KISSlicer
        ("; BEGIN_LAYER_OBJECT z=0.263 z_thickness=0.263", K.LAYER, "0.263"),
        ("; 'Loop Path', 1.0 [feed mm/s], 22.5 [head mm/s]", K.FEATURE, "Loop Path"),
        # Simplify3D
        ("; layer 1, Z = 0.180", K.LAYER, "0.180"),
        ("; feature outer perimeter", K.FEATURE, "outer perimeter"),
        # Kiri:Moto
        (";; --- layer 0 (0.250 @ 0.25) ---", K.LAYER, "0.25"),
        ("; feature shells", K.FEATURE, "shells"),
        # Ours
        ("; Processed by stillpath 1.0 machine=x", K.STAMP, ""),
        ("; STILLPATH_OFF", K.OFF, ""),
        (";stillpath_on", K.ON, ""),
        ("; stillpath off for this bridge", K.OFF, ""),
        ("; Stillpath on", K.ON, ""),
        ("; stillpath: stream on", K.STAMP, ""),
        (";stillpath: stream off, line 7 of the original", K.STAMP, ""),
        ("; stillpath, held back: M204 P500", K.STAMP, ""),
        ("; stillpath advise: as the file came", K.STAMP, ""),
    ],
)
@pytest.mark.parametrize("end", ["", "\r", " \r\n"])
def test_every_style(comment: str, kind: MarkKind, text: str, end: str) -> None:
    assert read_mark(comment + end) == Mark(kind, text)


@pytest.mark.parametrize(
    "comment",
    [
        ";",
        "; just words",
        "; stillpath is fine with this bridge",
        ";LAYER_COUNT:25",
        "; layer_height = 0.2",
        "; LAYER_HEIGHT: thick",
        "; 'Destring Suck'",
        "; END_LAYER_OBJECT z=0.263",
        ";PRINTING_ID: 0",
        "; total layer number: 25",
        "; machine_start_gcode = ;LAYER_CHANGE\\nG28",
    ],
)
def test_other_comments_mark_nothing(comment: str) -> None:
    assert read_mark(comment) is None


def test_numbers_of_marks() -> None:
    assert Mark(K.Z, ".2").value_mm == 0.2
    assert Mark(K.FEATURE, "Outer wall").value_mm is None


@pytest.mark.parametrize(
    ("names", "feature"),
    [
        (("External perimeter", "Outer wall", "WALL-OUTER", "Perimeter Path"), Feature.OUTER_WALL),
        (("Perimeter", "Inner wall", "WALL-INNER", "Loop Path"), Feature.INNER_WALL),
        (("Internal infill", "Sparse infill", "FILL"), Feature.SPARSE_INFILL),
        (("Skirt/Brim", "Skirt", "SKIRT", "Brim"), Feature.SKIRT),
        (("Support material interface", "SUPPORT-INTERFACE"), Feature.SUPPORT_INTERFACE),
        (("Wipe tower", "Prime tower", "PRIME-TOWER"), Feature.PRIME_TOWER),
    ],
)
def test_the_same_feature_by_its_many_names(names: tuple[str, ...], feature: Feature) -> None:
    assert {feature_of(name) for name in names} == {feature}


def test_titles_keep_the_slicers_own_name() -> None:
    assert feature_title("WALL-OUTER") == "outer wall (WALL-OUTER)"
    assert feature_title("Outer wall") == "outer wall"
    assert feature_title("Something new") == "Something new"


# What stands in the files, counted by nothing but line beginnings.
_LAYERS = {
    "cura": rb"^;LAYER:",
    "kiss": rb"^; BEGIN_LAYER_OBJECT z=([\d.]+)",
    "bambu": rb"^; CHANGE_LAYER",
    "prusa": rb"^;LAYER_CHANGE",
}
_FEATURES = rb"^(?:;TYPE:|; FEATURE: |; '(?=[^']* Path'))([^\r\n',]*)"
_CORPUS = [
    ("own/cura_ender3_gear24", "cura"),
    ("own/cura_um2_ultigcode_hept24f", "cura"),
    ("own/klipper_excludeobj_multi", "prusa"),
    ("own/ps_ender3_pauses_hept24f", "prusa"),
    ("own/ps_jubilee_rrf_toolchange", "prusa"),
    ("own/ps_trilab_rrf_tris24", "prusa"),
    ("third_party/real_bambustudio1.10_k1max", "bambu"),
    ("third_party/real_bambustudio2.3_20mm", "bambu"),
    ("third_party/real_cura4.10_objs", "cura"),
    ("third_party/real_kisslicer2.0.6", "kiss"),
    ("third_party/real_libbgcode_mini_cube_b_ref", "prusa"),
    ("third_party/real_orcaslicer2.3.0b2", "prusa"),
    ("third_party/real_prusaslicer2.3.3_thumb", "prusa"),
    ("third_party/real_superslicer2.3_arcwelder", "prusa"),
]


@pytest.mark.shared
@pytest.mark.parametrize(("name", "style"), _CORPUS, ids=[name for name, _ in _CORPUS])
def test_layers_and_features_of_the_corpus(
    shared_dir: Path, golden_machine: Machine, name: str, style: str
) -> None:
    text = gzip.decompress((shared_dir / "corpus" / f"{name}.gcode.gz").read_bytes())
    marked = re.findall(_LAYERS[style], text, re.MULTILINE)
    if style == "kiss":  # one mark per object: those of one height are one layer
        marked = [z for k, z in enumerate(marked) if k == 0 or z != marked[k - 1]]
    counted = Counter(m.decode() for m in re.findall(_FEATURES, text, re.MULTILINE))

    reader = Interpreter(golden_machine, strict_bounds=False)
    blocks = [*reader.push(text), *reader.flush()]
    layers = {int(layer) for block in blocks for layer in block.moves.layer if layer >= 0}
    assert reader.state.i[at.I_LAYER] + 1 == len(marked)
    # Some layers hold no move of their own (a mark before the end G-code, a raft's last).
    assert len(marked) - 3 <= len(layers) <= len(marked)

    assert set(reader.feature_names) == set(counted)
    assert all(feature_of(feature) is not None for feature in reader.feature_names)
    changes: Counter[str] = Counter()
    last = -1
    for block in blocks:
        for number in block.moves.feature:
            if number != last and number >= 0:
                changes[reader.feature_names[number]] += 1
            last = number
    for feature, times in changes.items():
        # A feature may be named again without a change.
        assert times <= counted[feature]
        assert times >= 0.5 * counted[feature], (feature, times, counted[feature])
