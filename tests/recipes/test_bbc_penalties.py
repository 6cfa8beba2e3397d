"""What PPO holds a controller to: the policy it started from, and its own image in a mirror."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest
import torch

from agility_rl.behaviours import JUMP
from agility_rl.go2.mirror import mirror_joints

Module = Callable[[str], ModuleType]


def test_an_anchor_holds_the_policy_to_the_one_it_started_from(module: Module, tmp_path: Path) -> None:
    penalties, setup, presets = module("bbc_penalties"), module("bbc_setup"), module("bbc_presets")
    imitation = replace(presets.SMOKE.imitation, anchor=2.0)
    first = setup.build(presets.SMOKE)
    setup.save_policy(first, presets.SMOKE, tmp_path)
    first.env.close()
    parts = setup.build(replace(presets.SMOKE, imitation=imitation, init_from=tmp_path))
    batch = parts.rollout.collect(parts.bbc.privileged_policy()).flatten()[:32]
    penalties.hold(parts, batch)
    parts.bbc.load_state_dict(parts.anchor.state_dict())
    assert penalties.distance_to_anchor(parts, batch, None) == 0.0
    linear = [layer for layer in parts.bbc.actor.modules() if isinstance(layer, torch.nn.Linear)]
    with torch.no_grad():
        linear[-1].bias += 0.3  # moves every mean action by as much
    distance = penalties.distance_to_anchor(parts, batch, None)
    torch.testing.assert_close(distance, torch.tensor(0.09))
    straight = (batch["command"][:, 2].abs() <= 0.4).float().mean()
    assert 0.0 < straight < 1.0
    torch.testing.assert_close(penalties.distance_to_anchor(parts, batch, 0.4), 0.09 * straight)
    jumping = (batch["skill"] == JUMP).float().mean()
    assert 0.0 < jumping < 1.0
    torch.testing.assert_close(penalties.distance_to_anchor(parts, batch, None, 0.5), 0.09 * (1.0 - 0.5 * jumping))
    distance.backward()
    assert all(parameter.grad is None for parameter in parts.anchor.parameters())
    assert any(parameter.grad is not None for parameter in parts.bbc.actor.parameters())
    with pytest.raises(ValueError, match="anchor holds on to the policy of --init-from"):
        setup.build(replace(presets.SMOKE, imitation=imitation))
    parts.env.close()


def test_asymmetry_is_what_the_mirror_image_does_otherwise(module: Module) -> None:
    penalties, setup, presets = module("bbc_penalties"), module("bbc_setup"), module("bbc_presets")
    parts = setup.build(presets.SMOKE)
    batch = parts.rollout.collect(parts.bbc.privileged_policy()).flatten()[:64]
    all_of_them = torch.ones(5, dtype=torch.bool)
    linear = [layer for layer in parts.bbc.actor.modules() if isinstance(layer, torch.nn.Linear)]
    assert penalties.asymmetry(parts, batch, all_of_them) > 0.0
    with torch.no_grad():
        linear[-1].weight.zero_()  # the same action whatever it sees, alike on both sides
        linear[-1].bias.copy_(torch.tensor([0.1, 0.2, 0.3, -0.1, 0.2, 0.3] * 2))
    assert penalties.asymmetry(parts, batch, all_of_them) == 0.0
    with torch.no_grad():
        linear[-1].bias[1] += 0.6  # one thigh of twelve joints: it and its image miss by 0.6 each
    distance = penalties.asymmetry(parts, batch, all_of_them)
    torch.testing.assert_close(distance, torch.tensor(2 * 0.36 / 12))
    others = torch.tensor([False, True, True, True, True])
    share = (batch["skill"] != 0).float().mean()
    assert 0.0 < share < 1.0
    torch.testing.assert_close(penalties.asymmetry(parts, batch, others), distance * share)
    distance.backward()
    gradient = linear[-1].bias.grad
    # 4 * 0.6 / 12 pulls the thigh that sticks out down, and its image up
    torch.testing.assert_close(gradient[[1, 4]], torch.tensor([0.2, -0.2]))
    torch.testing.assert_close(mirror_joints(gradient), -gradient)
    parts.env.close()
