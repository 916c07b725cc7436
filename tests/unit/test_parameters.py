"""Validated parameters: every complaint names the plugin, the property and what it may be."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest

from envmap_integrator.system.parameters import Parameters

pytestmark = pytest.mark.usefixtures("variant")


def parameters(**values) -> Parameters:
    props = mi.Properties("plugin")
    props.set_id("ours")
    for name, value in values.items():
        props[name] = value
    return Parameters(props)


@pytest.mark.parametrize(
    ("method", "arguments", "value"),
    [
        ("integer", (4, 1, 8), 8),
        ("power_of_two", (4, 1, 8), 8),
        ("number", (0.5, 0.0), 2),
        ("number", (None, 0.0), 0.25),
        ("flag", (False,), True),
        ("choice", ("near", ("near", "far")), "far"),
        ("text", (), "words"),
    ],
)
def test_values_are_returned_and_defaults_where_there_are_none(method, arguments, value):
    default = arguments[0] if arguments else ""
    assert getattr(parameters(x=value), method)("x", *arguments) == value
    assert getattr(parameters(), method)("x", *arguments) == default


def test_names_points_and_rotations():
    ours = parameters(ids=" a,b, ", p=[1, 2, 3], q="1, 2,3.5", turn=mi.ScalarTransform4f())
    assert ours.names("ids") == ("a", "b")
    assert ours.names("others") == ()
    assert ours.point("p") == (1, 2, 3)
    assert ours.point("q") == (1, 2, 3.5)
    assert ours.point("r") is None
    assert (ours.rotation("turn") == np.eye(3)).all()
    assert (ours.rotation("other") == np.eye(3)).all()


def test_numbers_are_floats():
    assert isinstance(parameters(x=2).number("x", 0.5, 0.0), float)


@pytest.mark.parametrize(
    ("error", "method", "arguments", "value", "message"),
    [
        (TypeError, "integer", (4, 1), 2.5, "must be an integer, not 2.5"),
        (TypeError, "integer", (4, 1), True, "must be an integer, not True"),
        (ValueError, "integer", (4, 1), 0, "must be at least 1 and at most 2147483647, not 0"),
        (ValueError, "integer", (4, 1, 8), 9, "must be at least 1 and at most 8, not 9"),
        (ValueError, "power_of_two", (4, 1, 8), 6, "must be a power of two, not 6"),
        (TypeError, "number", (0.5, 0.0), "much", "must be a number, not 'much'"),
        (TypeError, "number", (0.5, 0.0), False, "must be a number, not False"),
        (ValueError, "number", (0.5, 0.0), -1.0, "must be at least 0, not -1.0"),
        (ValueError, "number", (0.5, 0.0), float("nan"), "must be at least 0, not nan"),
        (ValueError, "number", (0.5, 0.0), float("inf"), "must be .*, not inf"),
        (TypeError, "flag", (False,), 1, "must be true or false, not 1"),
        (ValueError, "choice", ("a", ("a", "b")), "c", 'must be "a" or "b", not \'c\''),
        (TypeError, "text", (), 3, "must be a string, not 3"),
        (ValueError, "names", (), ", ", "must list ids, not ', '"),
        (ValueError, "point", (), "1, 2", "must be three numbers, not '1, 2'"),
        (ValueError, "point", (), "1, 2, nan", "must be three numbers, not '1, 2, nan'"),
        (ValueError, "point", (), 3, "must be three numbers, not 3"),
        (ValueError, "rotation", (), 3, "must rotate, without stretching or shearing, not 3"),
    ],
)
def test_wrong_values_are_named(error, method, arguments, value, message):
    with pytest.raises(error, match=f'^plugin "ours": "x" {message}$'):
        getattr(parameters(x=value), method)("x", *arguments)


def test_a_plugin_without_id_is_called_by_its_type():
    assert Parameters(mi.Properties("plugin")).owner == "plugin"


def test_unknown_properties_are_left_to_mitsuba():
    with pytest.raises(RuntimeError, match="patchs"):
        mi.load_dict({"type": "one_level_path", "patchs": 100})
