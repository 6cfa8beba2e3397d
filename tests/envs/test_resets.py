"""Resets by mask are TorchRL's, and nobody asks whether anyone is done."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import step_mdp

from agility_rl import keys
from agility_rl.envs import AgilityEnv, LocomotionEnv
from agility_rl.envs.resets import MaskedResets, masked_reset

OPTIONS = {"num_threads": 1}
Build = Callable[[], MaskedResets]


def locomotion() -> MaskedResets:
    return LocomotionEnv(4, simulator_options=OPTIONS, episode_length=0.2, resample_period=0.1, observation_noise=1.0)


def course() -> MaskedResets:
    def stand(td: TensorDictBase) -> TensorDictBase:
        return td.set("action", torch.zeros(*td.shape, 12))

    return AgilityEnv(4, stand, simulator_options=OPTIONS, episode_length=0.2, depth={})


def decide(env: MaskedResets) -> torch.Tensor | TensorDict:
    """Any action."""
    if isinstance(env, LocomotionEnv):
        return torch.zeros(4, 12)
    return TensorDict({keys.BEHAVIOUR: torch.full((4,), 2), keys.PARAMETERS: torch.zeros(4, 5, 6)}, [4])


def run(build: Build, begin_anew: Callable[[MaskedResets, TensorDictBase], TensorDictBase]) -> list[TensorDictBase]:
    """What is seen in 25 steps; the first two robots' episodes end three steps before the others'."""
    env = build()
    env.set_seed(0)
    carrier, seen = env.reset(), []
    for step in range(25):
        if step == 3:
            carrier = masked_reset(env, carrier.set("done", torch.tensor([[False], [False], [True], [True]])))
        carrier = step_mdp(env.step(carrier.set(keys.ACTION, decide(env))))
        done = carrier["done"].clone()
        if bool(done.any()):  # without, there is one draw of random numbers less where nobody asks
            carrier = begin_anew(env, carrier)
        seen.append(carrier.clone().set("was_done", done))
    env.close()
    return seen


@pytest.mark.parametrize("build", [locomotion, course])
def test_it_is_what_torchrl_does(build: Build) -> None:
    one, other = run(build, EnvBase.maybe_reset), run(build, masked_reset)
    ended = torch.stack([seen["was_done"] for seen in one])[..., 0].sum(1).tolist()
    assert {0, 2} <= set(ended), "some of them, and nobody"
    for a, b in zip(one, other, strict=True):
        names = set(a.keys(True, True))
        assert names == set(b.keys(True, True))
        assert not [name for name in names if not torch.equal(a[name], b[name])]


def test_who_is_not_done_stays_as_he_is() -> None:
    env = locomotion()
    observed = step_mdp(env.step(env.reset().set(keys.ACTION, torch.zeros(4, 12))))
    before, root = observed.clone(), env.simulator.root_position.clone()
    assert masked_reset(env, observed) is observed
    assert not [name for name in before.keys(True, True) if not torch.equal(before[name], observed[name])]
    torch.testing.assert_close(env.simulator.root_position, root, atol=0, rtol=0)
    env.close()


def test_a_cpu_is_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """It knows at once, and a reset of nobody would be for nothing."""
    env, resets = locomotion(), []
    reset = env._reset
    monkeypatch.setattr(env, "_reset", lambda *args, **options: resets.append(1) or reset(*args, **options))
    carrier = env.reset()
    for _ in range(3):
        carrier = env.step_and_maybe_reset(carrier.set(keys.ACTION, torch.zeros(4, 12)))[1]
    assert len(resets) == 1
    env.close()
