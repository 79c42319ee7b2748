"""Queries to a node: answers as a stream, bad parameters as an error, and a node that is not there."""

import pytest

from beamsplat.common.errors import UserError
from beamsplat.common.messages import Answer
from beamsplat.common.zenoh.queries import ask, command, reply


def count(parameters):
    """Answer with the numbers up to `to`."""
    for number in range(int(parameters["to"])):
        yield Answer(stamp_ns=number, text=f"number {number}")


def half(parameters):
    yield Answer(stamp_ns=0, text="first")
    raise ValueError("no second")


@pytest.fixture
def client(make_bus):
    """A session beside a node `depth` that answers `count` and `half`, and a control request."""
    node = make_bus("depth")
    handlers = {
        "count": count,
        "half": half,
        "control/reached": lambda p: iter([Answer(stamp_ns=0, text=p["x"])]),
    }
    node.answer_queries(lambda name, query: reply(query, handlers[name](dict(query.parameters))))
    node.announce(("count", "half"))
    return make_bus("page").session


def test_answers_arrive_in_order_as_messages(client, robot):
    answers = list(ask(client, robot, "depth", "count", {"to": "3"}, 5.0))
    assert [a.text for a in answers] == ["number 0", "number 1", "number 2"]
    assert [a.stamp_ns for a in answers] == [0, 1, 2]


def test_a_bad_parameter_is_an_error_and_the_node_answers_the_next_query(client, robot):
    with pytest.raises(UserError, match=r"depth rejected count: invalid literal for int.*'many'"):
        list(ask(client, robot, "depth", "count", {"to": "many"}, 5.0))
    assert len(list(ask(client, robot, "depth", "count", {"to": "1"}, 5.0))) == 1


def test_an_error_after_the_first_answer_comes_after_it(client, robot):
    answers = ask(client, robot, "depth", "half", {}, 5.0)
    assert next(answers).text == "first"
    with pytest.raises(UserError, match="no second"):
        next(answers)


def test_a_query_that_no_node_answers_names_node_and_query(client, robot):
    for node, name in (("depth", "other"), ("fusion", "count")):
        with pytest.raises(UserError, match=f"no answer from node '{node}' to the query '{name}'"):
            list(ask(client, robot, node, name, {}, 0.1))


def test_a_control_request_goes_to_one_process(client, robot):
    instance = f"{0:016x}"  # of the first bus that the test made
    assert command(client, robot, ("depth", instance), "reached", {"x": "4"}, 5.0) == "4"
    with pytest.raises(UserError, match="no answer"):
        command(client, robot, ("depth", "f" * 16), "reached", {"x": "4"}, 0.1)


class Query:
    """The part of a Zenoh query that `reply` uses."""

    key_expr = "k"

    def __init__(self):
        self.errors = []

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        pass

    def reply_err(self, payload):
        self.errors.append(payload)


def test_bad_input_and_faults_of_the_node_become_error_replies(caplog):
    """Neither may stop the node; a fault is returned and logged with its traceback, bad input is not."""

    def raises(error):
        raise error
        yield

    query = Query()
    assert reply(query, raises(ValueError("bad"))) == ""
    assert query.errors == [b"bad"]
    assert caplog.text == ""
    query = Query()
    assert reply(query, raises(ZeroDivisionError("by zero"))) == "ZeroDivisionError: by zero"
    assert query.errors == [b"fault in this node: ZeroDivisionError: by zero; its log has the details"]
    assert "Traceback" in caplog.text
