"""Message types made at run time."""

from __future__ import annotations

import math

import pytest

from agility_rl.record.messages import message_type


def test_every_kind_round_trips() -> None:
    fields = {"d": "double", "i": "int64", "b": "bool", "s": "string", "list": "double[]", "names": "string[]"}
    kind = message_type("Everything", fields)
    message = kind(d=math.nan, i=-(2**62), b=True, s="trot", list=[0.1, math.inf], names=["a", "b"])
    again = kind.FromString(message.SerializeToString())
    assert math.isnan(again.d) and again.i == -(2**62) and again.b and again.s == "trot"
    assert list(again.list) == [0.1, math.inf] and list(again.names) == ["a", "b"]
    assert kind.DESCRIPTOR.full_name == "agility_rl.Everything"


def test_the_same_name_may_have_other_fields() -> None:
    first, second = message_type("Twice", {"a": "double"}), message_type("Twice", {"b": "int64"})
    assert first(a=0.5).a == 0.5 and second(b=3).b == 3
    assert message_type("Twice", {"a": "double"}) is first


def test_an_unknown_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="field 'x' has kind 'float32'; expected one of double"):
        message_type("Wrong", {"x": "float32"})
