"""Default keys: what other code relies on is that they are distinct, plain and documented."""

from __future__ import annotations

import ast
from itertools import pairwise
from pathlib import Path

from agility_rl import keys

CONSTANTS = {name: value for name, value in vars(keys).items() if name.isupper()}


def test_keys_are_distinct_lower_case_strings() -> None:
    assert CONSTANTS
    assert len(set(CONSTANTS.values())) == len(CONSTANTS)
    assert all(value == value.lower() and value.isidentifier() for value in CONSTANTS.values())


def test_a_key_is_named_as_its_constant() -> None:
    assert {name: value for name, value in CONSTANTS.items() if value != name.lower()} == {}


def test_no_key_collides_with_what_torchrl_writes() -> None:
    written_by_torchrl = {"next", "done", "terminated", "truncated", "reward", "state_value", "advantage", "_reset"}
    assert not written_by_torchrl & set(CONSTANTS.values())


def test_every_key_says_its_shape() -> None:
    body = ast.parse(Path(keys.__file__).read_text(encoding="utf-8")).body
    for statement, following in pairwise(body):
        if isinstance(statement, ast.Assign):
            name = statement.targets[0].id
            assert isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant), name
            text = str(following.value.value)
            assert "``[*B" in text and any(kind in text for kind in ("float32", "int64", "bool")), f"{name}: {text}"
