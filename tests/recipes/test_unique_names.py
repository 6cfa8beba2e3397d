from __future__ import annotations

from collections.abc import Callable
from types import ModuleType


def test_alike_names_are_told_apart(module: Callable[[str], ModuleType]) -> None:
    unique_names = module("unique_names").unique_names
    assert unique_names(["a/x.json", "b/x.json", "y.bvh"]) == ["a-x", "b-x", "y"]
    assert unique_names(["x.json", "x.npz", "x.json"]) == ["x", "x-2", "x-3"]
    assert unique_names(["full", "/mine/full.toml"]) == ["full", "mine-full"]
