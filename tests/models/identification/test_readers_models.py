"""Models of python-control and MATLAB, and the loading rules with their messages."""

from __future__ import annotations

import io
import json
from typing import Any

import control
import numpy as np
import pytest
import scipy.io
import scipy.signal
import scipy.sparse
from hypothesis import assume, given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from stillpath.models.errors import ModelError
from stillpath.models.identification.readers import ReadSettings, read_content
from stillpath.models.identification.readers.matlab import matlab_variables
from stillpath.models.identification.types import PlantModel
from stillpath.models.plants import (
    PairsSpec,
    PolePair,
    ZeroPair,
    frequency_response,
)

F_HZ = np.linspace(0.1, 200.0, 150)
DT_S = 1e-3
PAIRS = PairsSpec(
    poles=(PolePair(f_hz=47, zeta=0.035), PolePair(f_hz=95, zeta=0.06)),
    zeros=(ZeroPair(f_hz=62, zeta=-0.1),),
)
TAZ = (
    '{"num": [0.0874, -0.3415, 0.5118, -0.3481, 0.09063], '
    '"den": [1.0, -4.54, 8.283, -7.583, 3.479, -0.639], "dt": 0.001}'
)


def read(document: Any, **known: Any) -> PlantModel:
    text = document if isinstance(document, str) else json.dumps(document)
    (model,) = read_content(text.encode(), "model.json", settings=ReadSettings(**known))
    assert isinstance(model, PlantModel)
    return model


def mat(**variables: Any) -> bytes:
    out = io.BytesIO()
    scipy.io.savemat(out, variables)
    return out.getvalue()


def system(discrete: bool) -> control.StateSpace:
    """The pair plant, realised by python-control."""
    plant = control.tf(1, 1)
    for zero in PAIRS.zeros:
        w = 2 * np.pi * zero.f_hz
        plant = plant * control.tf([1 / w**2, 2 * zero.zeta / w, 1], [1])
    for pole in PAIRS.poles:
        w = 2 * np.pi * pole.f_hz
        plant = plant * control.tf([1], [1 / w**2, 2 * pole.zeta / w, 1])
    state = control.tf2ss(plant)
    return control.sample_system(state, DT_S, "foh") if discrete else state


def response(plant: Any, discrete: bool) -> np.ndarray:
    at = np.exp(2j * np.pi * F_HZ * DT_S) if discrete else 2j * np.pi * F_HZ
    return np.asarray(plant(at))


def pairs_of(roots: np.ndarray) -> list[list[float]]:
    return [[float(r.real), float(r.imag)] for r in roots]


@pytest.mark.parametrize("discrete", [False, True])
@pytest.mark.parametrize("form", ["tf", "zpk", "ss"])
@pytest.mark.parametrize("container", ["json", "mat", "struct"])
def test_python_control_and_matlab(discrete: bool, form: str, container: str) -> None:
    state = system(discrete)
    dt = DT_S if discrete else 0
    fields: dict[str, Any]
    if form == "tf":
        plant = control.tf(state)
        num, den = np.real(plant.num[0][0]), np.real(plant.den[0][0])
        fields = {"num": num, "den": den, "dt": dt}
    elif form == "zpk":
        zeros = state.zeros()[np.abs(state.zeros()) < 1e5]
        poles = state.poles()
        leading = np.real(np.prod(0j + dt / DT_S - poles) / np.prod(0j + dt / DT_S - zeros))
        fields = {"z": zeros, "p": poles, "k": leading, "Ts": dt}
    else:
        fields = {"A": state.A, "B": state.B, "C": state.C, "D": state.D, "Ts": dt}
    if container == "json":
        plain = {
            name: pairs_of(value) if name in "zp" else np.asarray(value).tolist()
            for name, value in fields.items()
        }
        model = read(plain)
    else:
        content = mat(**fields) if container == "mat" else mat(y=fields, other=3.0)
        (one,) = read_content(content, "model.mat")
        assert isinstance(one, PlantModel)
        model = one
        assert model.axis == ("y" if container == "struct" else None)
    assert model.spec.sampling_s == (DT_S if discrete else None)
    expected = response(state, discrete)
    np.testing.assert_allclose(frequency_response(model.spec, F_HZ), expected, rtol=2e-5)


def test_ways_of_writing_numbers() -> None:
    poles = [[-20.0, 300.0], [-20.0, -300.0]]
    for written in (
        poles,
        [{"re": a, "im": b} for a, b in poles],
        [{"real": a, "imag": b} for a, b in poles],
        ["-20+300j", "-20 - 300i"],
    ):
        spec = read({"zeros": [], "poles": written, "gain": 20**2 + 300**2}).spec
        np.testing.assert_allclose(sorted(spec.roots().poles.imag), [-300, 300])
    nested = read({"num": [[[1.0]]], "den": [[[0.01, 1.0]]], "dt": None})
    np.testing.assert_allclose(nested.spec.roots().poles, [-100])


def test_own_documents_and_axes() -> None:
    own = json.loads(PAIRS.model_dump_json())
    assert read(own).spec == PAIRS
    models = read_content(json.dumps({"x": own, "y": own}).encode(), "m.json")
    assert [m.axis for m in models] == ["x", "y"]


def test_repair_counts_the_decimals_of_matlab_files_too() -> None:
    taz = json.loads(TAZ)
    content = mat(num=taz["num"], den=taz["den"], Ts=0.001)
    with pytest.raises(ModelError, match="repair_rounding"):
        read_content(content, "taz.mat")
    (model,) = read_content(content, "taz.mat", settings=ReadSettings(repair_rounding=True))
    assert isinstance(model, PlantModel)
    assert model.spec == read(TAZ, repair_rounding=True).spec


def test_repair_refuses_more_than_rounding() -> None:
    with pytest.raises(ModelError, match="times the rounding of the coefficients"):
        read('{"num": [0.50], "den": [1, -0.900000], "dt": 0.001}', repair_rounding=True)
    with pytest.raises(ModelError, match="no rounding to repair"):
        read('{"num": [1], "den": [2, 0, -2], "dt": 0.001}', repair_rounding=True)


def test_dc_gain_far_off_needs_a_word() -> None:
    document = {"num": [1.3], "den": [0.01, 1.0]}
    with pytest.raises(ModelError, match=r"DC gain 1\.3 is more than 15% .*give it as dc_gain"):
        read(document)
    for kind in (
        document,
        {"zeros": [], "poles": [-100.0], "gain": 130.0},
        {"A": [[-100.0]], "B": [[1.0]], "C": [[130.0]], "D": 0},
        {"kind": "fir", "taps": [0.65, 0.65], "dt_s": 0.001},
    ):
        model = read(kind, dc_gain=1.3)
        assert model.notes[0] == "DC gain divided by the stated 1.3 (steps per mm)"
        np.testing.assert_allclose(frequency_response(model.spec, [0.0]), 1.0, rtol=1e-12)


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"num": [1], "den": [1, 2, -3]}, r"unstable plant: pole s = 1"),
        ({"num": [1], "den": [1, 2, 0]}, "model has an integrator"),
        ({"zeros": [], "poles": [[-1, 3]], "gain": 1}, "lacks its complex conjugate"),
        ({"num": [1, 0, 1], "den": [1, 1]}, "improper"),
        ({"num": [1], "den": [1, 1], "dt": True}, "does not say its sampling time"),
        ({"num": [1], "den": ["a", 1]}, "den is .* not made of numbers"),
        ({"num": [[1], [2]], "den": [1, 1]}, "not made of numbers"),
        ({"num": [], "den": []}, "num has no coefficients"),
        ({"num": ["1+2j"], "den": [1, 1]}, "complex coefficients"),
        ({"A": [[1, 2]], "B": [1], "C": [1], "D": 0}, "do not fit together"),
        ({"A": "no", "B": [1], "C": [1]}, "A is not a matrix"),
        ({"num": [1]}, "it needs num and den"),
        ({"A": [[-1e303]], "B": [[1]], "C": [[1]]}, "too large, too small"),
        ({"x": [1]}, "axis x is not an object"),
        ("[1, 2]", "a JSON model is an object"),
        ('{"num": [NaN], "den": [1, 1]}', "NaN is not a finite number"),
        ('{"num": [1e999], "den": [1, 1]}', "num"),
        ('{"num": [1', "not a JSON model"),
        ('{"a":' * 100_000, "not a JSON model"),
    ],
)
def test_models_that_cannot_be_read_say_why(document: Any, message: str) -> None:
    with pytest.raises(ModelError, match=message) as caught:
        read(document)
    assert str(caught.value).startswith("model.json: ")


def test_sampling_time_may_be_told() -> None:
    document = {"num": [0.1], "den": [1, -0.9], "dt": True}
    assert read(document, sampling_s=0.002).spec.sampling_s == 0.002
    assert read({**document, "dt": 0.001}, sampling_s=0.002).spec.sampling_s == 0.001
    document.pop("dt")
    assert read(document, sampling_s=0.002).spec.sampling_s == 0.002
    continuous = {"num": [1], "den": [0.01, 1], "dt": 0}
    assert read(continuous, sampling_s=0.002).spec.sampling_s is None


@hypothesis_settings(max_examples=60)
@given(
    st.lists(st.tuples(st.floats(20, 150), st.floats(0.02, 0.3)), min_size=1, max_size=4),
    st.lists(st.tuples(st.floats(20, 150), st.floats(-0.2, 0.3)), max_size=4),
    st.sampled_from([None, "zoh", "foh"]),
    st.integers(0, 2**32 - 1),
)
def test_state_space_in_any_scale_of_its_states(
    poles: list[tuple[float, float]],
    zeros: list[tuple[float, float]],
    hold: str | None,
    seed: int,
) -> None:
    """Companion forms of scipy, with entries up to 1e11, scaled at random.

    Rounding of such a form alone moves roots that lie upon each other, so they are kept apart.
    """
    for roots in (poles, zeros):
        f_hz = np.sort([f for f, _ in roots])
        assume(np.all(f_hz[1:] > 1.05 * f_hz[:-1]))
    s = 2j * np.pi * F_HZ
    num, den, expected = np.ones(1), np.ones(1), np.ones(len(F_HZ), complex)
    for f, z in poles:
        w = 2 * np.pi * f
        den = np.polymul(den, [1 / w**2, 2 * z / w, 1])
        expected /= 1 + 2 * z * s / w + (s / w) ** 2
    for f, z in zeros[: len(poles)]:
        w = 2 * np.pi * f
        num = np.polymul(num, [1 / w**2, 2 * z / w, 1])
        expected *= 1 + 2 * z * s / w + (s / w) ** 2
    a, b, c, d = scipy.signal.tf2ss(num, den)
    if hold:
        a, b, c, d, _ = scipy.signal.cont2discrete((a, b, c, d), DT_S, hold)
        at = np.exp(s * DT_S)[:, None, None] * np.eye(len(a)) - a
        expected = (c @ np.linalg.solve(at, np.broadcast_to(b, (len(F_HZ), *b.shape))) + d)[:, 0, 0]
    scale = np.exp(np.random.default_rng(seed).uniform(-3, 3, len(a)))
    fields = {"A": a * scale[:, None] / scale, "B": b[:, 0] * scale, "C": c[0] / scale, "D": d}
    model = read({**{k: v.tolist() for k, v in fields.items()}, "dt": DT_S if hold else 0})
    peak = np.abs(expected).max()
    np.testing.assert_allclose(
        frequency_response(model.spec, F_HZ) / peak, expected / peak, atol=1e-6
    )


@given(
    st.dictionaries(
        st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,30}", fullmatch=True),
        arrays.arrays(
            st.sampled_from(["f8", "f4", "i2", "u1", "i8", "c16"]),
            arrays.array_shapes(min_dims=1, max_dims=3, max_side=4),
        ),
        min_size=1,
        max_size=4,
    ),
    st.booleans(),
    st.booleans(),
)
def test_matlab_variables_as_scipy(
    variables: dict[str, np.ndarray], compressed: bool, in_struct: bool
) -> None:
    out = io.BytesIO()
    written = {"s": variables} if in_struct else variables
    scipy.io.savemat(out, written, do_compression=compressed, long_field_names=True)
    found = matlab_variables(out.getvalue(), "a.mat")
    expected = scipy.io.loadmat(io.BytesIO(out.getvalue()), squeeze_me=True)
    if in_struct:
        found, expected = found["s"], expected["s"]
    for name in variables:
        reference = expected[name].item() if in_struct else expected[name]
        np.testing.assert_array_equal(found[name], np.asarray(reference, found[name].dtype))


def test_other_matlab_variables_do_not_disturb() -> None:
    content = mat(
        note="made by hand", sparse=scipy.sparse.eye_array(3), many=np.array([1, "a"], object),
        list=[{"a": 1}, {"a": 2}], cell=np.array([[2.5]], object), G={"z": [], "p": -100, "k": 100},
    )  # fmt: skip
    found = matlab_variables(content, "a.mat")
    assert {name for name, value in found.items() if value is None} == {
        "note", "sparse", "many", "list",
    }  # fmt: skip
    assert found["cell"] == 2.5
    (model,) = read_content(content, "a.mat")
    assert isinstance(model, PlantModel)
    assert model.source == "a.mat, G"
    np.testing.assert_allclose(model.spec.roots().poles, [-100])


def test_matlab_refusals() -> None:
    for head in (b"MATLAB 7.3 MAT-file, Platform: GLNXA64" + b" " * 500, b"\x89HDF\r\n\x1a\n" * 9):
        with pytest.raises(ModelError, match=r"HDF5.*-v7"):
            read_content(head, "model.mat")
    with pytest.raises(ModelError, match="no model among the variables other"):
        read_content(mat(other=np.ones(3)), "model.mat")
    with pytest.raises(ModelError, match="damaged MATLAB file"):
        read_content(mat(num=np.ones(3), den=np.ones(3))[:170], "model.mat")
    bomb = io.BytesIO()
    scipy.io.savemat(bomb, {"num": np.zeros((1000, 5000))}, do_compression=True)
    with pytest.raises(ModelError, match="unpacks to more than"):
        read_content(bomb.getvalue(), "model.mat")


@hypothesis_settings(max_examples=30)
@given(
    st.lists(
        st.tuples(st.floats(10, 150), st.floats(0.02, 0.4)),
        min_size=1, max_size=3, unique_by=lambda m: round(m[0]),
    )
)  # fmt: skip
def test_written_models_come_back(modes: list[tuple[float, float]]) -> None:
    spec = PairsSpec(poles=tuple(PolePair(f_hz=f, zeta=z) for f, z in modes))
    assert read(spec.model_dump_json()).spec == spec
