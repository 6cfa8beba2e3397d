"""Copying a script: the losses by hand, who drives, and that a teacher does as the script when it has copied it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from agility_rl import keys
from agility_rl.behaviours import skill_index
from agility_rl.deploy.artifact import Artifact
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.modules.hybrid_actor import FORBIDDEN

Module = Callable[[str], ModuleType]


@pytest.fixture
def smoke(module: Module, untrained: Path, tmp_path: Path) -> Any:
    cfg = module("tsc_config").PRESETS["smoke"]
    env = replace(cfg.env, num_threads=1)
    return replace(cfg, runs=tmp_path, bbc=untrained, env=env, reward=replace(cfg.reward, imitation=0.0))


def test_losses_by_hand(module: Module) -> None:
    cloning, allowed = module("tsc_cloning"), torch.tensor([True, True, False])
    logits = torch.tensor([[0.0, math.log(3.0), FORBIDDEN]])
    said = TensorDict({"logits": logits, "loc": torch.zeros(1, 3, 1)}, [1])
    parameters = torch.tensor([[[2.0], [1.0], [2.0]]])
    told = TensorDict({keys.BEHAVIOUR: torch.tensor([1]), keys.PARAMETERS: parameters}, [1])
    losses = cloning.imitation(said, cloning.targets(told, said, 0.2, allowed))
    # choices of 1/4 and 3/4, labels of 0.1 and 0.9; what is not allowed has no share of either
    assert losses["behaviour"].item() == pytest.approx(0.1 * math.log(4.0) + 0.9 * math.log(4.0 / 3.0))
    assert losses["parameters"].item() == pytest.approx((4.0 + 1.0 + 4.0) / 3.0)
    told[keys.BEHAVIOUR] = torch.tensor([-1])  # it says nothing: entropy of what was said before, and no error
    losses = cloning.imitation(said, cloning.targets(told, said, 0.2, allowed))
    assert losses["behaviour"].item() == pytest.approx(0.25 * math.log(4.0) + 0.75 * math.log(4.0 / 3.0))
    assert losses["parameters"].item() == 0.0
    far = said.clone().set("loc", torch.tensor([[[3.0], [-0.5], [-2.0]]]))  # held to what is applied of it
    kept = cloning.targets(told, far, 0.2, allowed)[keys.PARAMETERS]
    assert kept.flatten().tolist() == [1.0, -0.5, -1.0]


def test_the_script_drives_its_share(module: Module, smoke: Any) -> None:
    cloning, parts = module("tsc_cloning"), module("tsc_setup").build(smoke)
    script = module("tsc_script").Script.parse("jump:1.5")
    td = cloning.led(parts, script, 3)(parts.env.reset())
    told = script.decide(td.select(*cloning.READ))[keys.ACTION]
    chosen = td[keys.ACTION]
    assert torch.equal(chosen[keys.BEHAVIOUR][:3], told[keys.BEHAVIOUR][:3])
    assert torch.equal(chosen[keys.PARAMETERS][:3], told[keys.PARAMETERS][:3])
    assert (chosen[keys.PARAMETERS][3:] != told[keys.PARAMETERS][3:]).all()
    parts.env.close()


def test_the_guide_leads_by_where_robots_stand(module: Module, smoke: Any) -> None:
    parts = module("tsc_setup").build(replace(smoke, place=True))
    cloning = replace(smoke.cloning, script="guide", scripted=1.0)
    losses = module("tsc_cloning").clone(parts, cloning)
    assert all(math.isfinite(loss) for loss in losses.values())
    decider = module("deciders").load_script("guide", smoke.bbc)
    assert set(decider.behaviours) == {"pace", "trot", "canter", "jump"}
    td = parts.env.reset()
    led = module("tsc_cloning").led(parts, module("tsc_script").read("guide"), parts.env.num_robots)(td.clone())
    told = decider.decide(td.clone())[keys.ACTION]
    assert torch.equal(led[keys.ACTION, keys.BEHAVIOUR], told[keys.BEHAVIOUR])
    assert torch.equal(led[keys.ACTION, keys.PARAMETERS], told[keys.PARAMETERS])
    parts.env.close()


def test_a_teacher_does_what_it_has_copied(module: Module, smoke: Any) -> None:
    parts = module("tsc_setup").build(replace(smoke, env=replace(smoke.env, num_robots=32)))
    own = replace(smoke.cloning, script="trot:1.4,tunnel=walk:0.4", iterations=10, epochs=20, learning_rate=3e-3)
    losses = module("tsc_cloning").clone(parts, own)
    assert losses["parameters"] < 0.05
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        td = parts.teacher.privileged_policy()(parts.env.reset())
    expected = module("tsc_script").Script.parse(own.script).decide(td.clone())[keys.ACTION]
    assert torch.equal(td[keys.ACTION, keys.BEHAVIOUR], expected[keys.BEHAVIOUR])
    speed = td[keys.ACTION, keys.PARAMETERS][td[keys.ACTION, keys.BEHAVIOUR] == skill_index("trot")][:, 2, 0]
    torch.testing.assert_close(speed, torch.full_like(speed, 0.8), atol=0.2, rtol=0.0)  # 1.4 m/s of 0.5 to 1.5
    parts.env.close()


def test_a_teacher_is_corrected_before_some_obstacles_and_keeps_the_rest(module: Module, smoke: Any) -> None:
    cloning, robots = module("tsc_cloning"), replace(smoke.env, num_robots=32)
    parts = module("tsc_setup").build(replace(smoke, env=robots))
    tunnel = list(OBSTACLES).index("tunnel")

    def says() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        torch.manual_seed(0)
        with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
            td = parts.teacher.privileged_policy()(seen.clone())
        return td[keys.OBSTACLE].argmax(-1) == tunnel, td["logits"].softmax(-1), td["loc"]

    own = replace(smoke.cloning, script="trot:1.4", iterations=4, epochs=10, learning_rate=3e-3)
    cloning.clone(parts, own)
    seen = parts.env.reset()
    _, before, parameters = says()
    losses = cloning.clone(parts, replace(own, script="own,tunnel=walk:0.4", iterations=8))
    there, after, corrected = says()
    assert 0 < there.sum() < 32 and losses["parameters"] < 0.05
    assert (after[there].argmax(-1) == skill_index("walk")).all()
    assert (after[~there].argmax(-1) == skill_index("trot")).all()
    assert (after - before)[~there].abs().mean() < 0.1 and (corrected - parameters)[~there].abs().mean() < 0.1
    parts.env.close()


def test_own_needs_a_teacher(module: Module, smoke: Any) -> None:
    recipe = module("tsc_teacher")
    cfg = replace(smoke, cloning=replace(smoke.cloning, script="own,tunnel=walk:0.4"))
    with pytest.raises(ValueError, match=r"keeps what a teacher does; give it by --init-from"):
        recipe.train(cfg)
    with pytest.raises(ValueError, match="leaves decisions to a teacher, and there is none"):
        module("deciders").load_script("own,tunnel=walk:0.4", smoke.bbc)
    first = recipe.train(replace(smoke, iterations=1))
    calm = replace(smoke.ppo, initial_std=0.12, min_std=0.1)
    second = recipe.train(replace(cfg, name="second", iterations=1, init_from=first, ppo=calm))
    states = [Artifact.load(run / "policy").state for run in (first, second)]
    name = next(name for name in states[0] if name.endswith("parameters_head.std"))
    assert states[0][name].mean() > 0.17 and states[1][name].max() < 0.15, "it begins with less to try"


def test_a_bad_script_is_refused_before_anything_is_trained(module: Module, smoke: Any) -> None:
    cfg = replace(smoke, cloning=replace(smoke.cloning, script="gallop:1.0"))
    with pytest.raises(ValueError, match=r"--cloning.script: expected BEHAVIOUR:SPEED"):
        module("tsc_teacher").train(cfg)
    assert not (cfg.runs / cfg.name).exists()


def test_a_script_may_only_choose_what_the_teacher_may(module: Module, smoke: Any) -> None:
    recipe, only = module("tsc_teacher"), replace(smoke, behaviours=("canter",))
    with pytest.raises(ValueError, match=r"--cloning.script leap chooses .*trot.*, which --behaviours leaves out"):
        recipe.train(only)
    run = recipe.train(replace(only, iterations=1, cloning=replace(smoke.cloning, script="canter:1.2")))
    assert Artifact.load(run / "policy").manifest["network"]["allowed"] == [skill_index("canter")]
