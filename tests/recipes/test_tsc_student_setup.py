"""What a student's training is made of, before it learns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import torch

Module = Callable[[str], ModuleType]


def test_the_target_of_byol_begins_as_the_student_that_was_loaded(
    module: Module, untrained: Path, untrained_teacher: Path, make_student: Callable[..., Path], tmp_path: Path
) -> None:
    recipe, setup = module("tsc_student"), module("tsc_student_setup")
    cfg = recipe.PRESETS["smoke"]
    cfg = replace(cfg, teacher=untrained_teacher, bbc=untrained, runs=tmp_path, env=replace(cfg.env, num_threads=1))
    cfg = replace(cfg, init_from=make_student(own_estimator=True, seed=7))
    parts = setup.build(*setup.resolve(cfg))
    loss = parts.representation.loss
    before = loss.target_network_params.data.clone()
    recipe.begin(parts, cfg)
    online, target = loss.network_params.data, loss.target_network_params.data
    assert bool((online == target).all()) and not bool((before == target).all())
    began = target.clone()
    with torch.no_grad():
        for weight in loss.parameters():
            weight.add_(float(weight.requires_grad))
    parts.representation.average.step()
    moved = 0
    for name, value in online.items(True, True):
        if not torch.equal(value, began[name]):  # what learns
            moved += 1
            torch.testing.assert_close(target[name], 0.99 * began[name] + 0.01 * value)
    assert moved > 10
    parts.env.close()
