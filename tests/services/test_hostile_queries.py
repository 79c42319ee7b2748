"""Queries with hostile parameters, to every node that answers any: messages, or an error that names the fault."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beamsplat.common.errors import UserError
from beamsplat.common.messages.codec import decode, encode, schema_of
from beamsplat.services.nodes import NODES
from tests.services.mapping.session import maps

NUMBERS = st.one_of(
    st.sampled_from(["0", "-0.0", "inf", "-inf", "nan", "1e999", "1e308", "-1e308", "1e-320", "", " ", "0x10", "1e-12"]),
    st.floats().map(repr),
    st.floats(0.1, 1000.0).map(repr),
    st.integers().map(str),
    st.text(max_size=20),
)  # fmt: skip
POINTS = st.lists(NUMBERS, max_size=4).map(",".join)
SOUND = {"from": "1,2,0.5", "focal_px": "300", "error_px": "2"}
SOUND_VIEW = {
    "position": "0,0,0.4",
    "quaternion": "-0.5,0.5,-0.5,0.5",
    "width_px": "32",
    "height_px": "24",
    "focal_px": "30",
}
NAMES = [*SOUND, *SOUND_VIEW, "id"]
PARAMETERS = st.one_of(
    st.dictionaries(st.one_of(st.sampled_from([*NAMES, "set"]), st.text(max_size=8)), st.one_of(NUMBERS, POINTS)),
    st.tuples(st.sampled_from(list(SOUND)), NUMBERS).map(lambda change: {**SOUND, change[0]: change[1]}),
    POINTS.map(lambda point: {**SOUND, "from": point}),
    st.tuples(st.sampled_from(list(SOUND_VIEW)), st.one_of(NUMBERS, POINTS)).map(
        lambda change: {**SOUND_VIEW, change[0]: change[1]}),
)  # fmt: skip


def mapper():
    node = maps.make_node(half_steps=1, full_steps=1)
    maps.feed(node, range(2))
    return node


PREPARED = {"mapping": mapper}  # node -> one that can answer


QUERIES = [("mapping", name) for name in ("keyframe", "poses", "render", "snapshot", "state")]


def test_no_query_of_a_node_is_left_out():
    classes = [service.load(kind) for service in NODES.values() for kind in service.kinds]
    assert sorted({(c.name, query) for c in classes for query in c.queries()}) == QUERIES


@pytest.fixture(scope="module")
def nodes():
    return {name: make() for name, make in PREPARED.items()}


def answers(node, query, parameters):
    """Encoded and decoded, as on the wire."""
    return [decode(schema_of(m), encode(m)) for m in getattr(node, f"on_query_{query}")(parameters)]


@pytest.mark.parametrize(("name", "query"), QUERIES)
def test_any_parameters_give_messages_or_an_error_that_names_one_of_them(nodes, name, query):
    @given(PARAMETERS)
    @settings(max_examples=300, deadline=None)
    def check(parameters):
        fault = ""
        try:
            assert answers(nodes[name], query, parameters)
        except UserError as error:
            fault = str(error)
        if fault:
            assert fault.startswith(f"{query}: ")
            assert not parameters or any(ascii(parameter)[1:-1][:60] in fault for parameter in parameters)
            assert len(fault) < 400

    check()


@pytest.mark.parametrize("value", ["0", "-1", "inf", "-inf", "nan", "1e400", "1e-300", "wide", ""])
@pytest.mark.parametrize("parameter", ["focal_px", "error_px", "from"])
def test_a_bad_number_is_refused_with_its_name_and_value(nodes, parameter, value):
    if parameter == "from":
        value = f"0,{'1e7' if value in ('0', '-1', '1e-300') else value},0"
    with pytest.raises(UserError) as caught:
        answers(nodes["mapping"], "snapshot", {**SOUND, parameter: value})
    assert f"snapshot: {parameter}={value}: expected" in str(caught.value)


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"from": "0,0,0"}, "snapshot: the parameter focal_px is missing"),
        ({"focal_px": "300"}, "snapshot: the parameter from is missing"),
        ({"from": "0,0", "focal_px": "300"}, "from=0,0: expected 3 numbers X,Y,Z"),
        ({**SOUND, "focal": "3"}, "unknown parameter focal=3: its parameters are from, focal_px, error_px"),
    ],
)
def test_missing_and_unknown_parameters_are_named(nodes, parameters, words):
    with pytest.raises(UserError, match=words):
        answers(nodes["mapping"], "snapshot", parameters)


def test_an_empty_map_is_an_error_and_no_silence():
    node = maps.make_node()
    for query in node.queries():
        with pytest.raises(UserError, match="the map is still empty"):
            answers(node, query, SOUND_VIEW if query == "render" else {})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"quaternion": "0,0,0,0"}, "quaternion=0,0,0,0: expected a quaternion that is not zero"),
        ({"quaternion": "0,0,1"}, "quaternion=0,0,1: expected 4 numbers X,Y,Z,W"),
        ({"position": "0,nan,0"}, "position=0,nan,0: expected a number from -1e\\+06 to 1e\\+06"),
        ({"width_px": "15"}, "width_px=15: expected a number from 16 to 2048"),
        ({"height_px": "1e6"}, "height_px=1e6: expected a number from 16 to 2048"),
        ({"focal_px": "0"}, "focal_px=0: expected a number from 0.64 to 3200"),
        ({"focal_px": "1e4"}, "focal_px=1e4: expected a number from 0.64 to 3200"),
    ],
)
def test_a_bad_view_is_refused_with_its_name_and_value(nodes, change, words):
    with pytest.raises(UserError, match=f"render: {words}"):
        answers(nodes["mapping"], "render", {**SOUND_VIEW, **change})


def test_a_camera_needs_all_its_parameters(nodes):
    for left in ("position", "quaternion", "width_px", "height_px", "focal_px"):
        given = {name: value for name, value in SOUND_VIEW.items() if name != left}
        with pytest.raises(UserError, match=f"render: the parameter {left} is missing"):
            answers(nodes["mapping"], "render", given)


def test_sound_parameters_give_finite_gaussians(nodes):
    for error_px in ("0.001", "1", "1000000"):
        chunks = answers(nodes["mapping"], "snapshot", {**SOUND, "error_px": error_px})
        assert [c.anchor_id for c in chunks] == [0]
        assert all(math.isfinite(c.cell_m) for c in chunks)
        assert chunks[0].count > 0
