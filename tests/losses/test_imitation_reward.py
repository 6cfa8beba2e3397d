"""The imitation reward as a transform: by hand, on batches of any shape, and inside an environment."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

from agility_rl import keys
from agility_rl.envs import AgilityEnv
from agility_rl.losses import ImitationReward
from agility_rl.modules import Discriminator


def told(values: list[float]) -> TensorDictModule:
    """A discriminator that says given numbers."""
    return TensorDictModule(
        lambda motion: torch.tensor(values)[:, None], in_keys=[keys.MOTION], out_keys=[keys.DISCRIMINATOR_LOGIT]
    )


def after(*shape: int) -> TensorDict:
    motion = torch.randn(*shape, 2, 49, generator=torch.Generator().manual_seed(0))
    skill = torch.zeros(*shape, dtype=torch.int64)
    return TensorDict({keys.MOTION: motion, keys.SKILL: skill, "reward": torch.ones(*shape, 1)}, shape)


def test_by_hand() -> None:
    # 1 - (D - 1)^2 / 4: for 1, -1, 2, 4: 1, 0, 0.75, below 0
    found = ImitationReward(told([1.0, -1.0, 2.0, 4.0]), 0.2)(after(4))
    torch.testing.assert_close(found["reward"][:, 0], torch.tensor([1.2, 1.0, 1.15, 1.0]))


@pytest.mark.parametrize("num_skills", [None, 5])
def test_a_batch_is_judged_row_by_row(num_skills: int | None) -> None:
    transform = ImitationReward(Discriminator(num_skills=num_skills), 3.0)
    batch = after(3, 2)
    added = transform.reward(batch)
    assert added.shape == (3, 2, 1) and added.min() >= 0.0 and added.max() <= 3.0 and added.std() > 0.0
    assert not added.requires_grad
    torch.testing.assert_close(transform(batch.clone())["reward"], 1.0 + added)
    torch.testing.assert_close(transform.reward(batch[1, 1:]), added[1, 1:])


def test_an_environment_pays_in_every_step_what_a_batch_is_paid_at_once() -> None:
    def stand(td: TensorDictBase) -> TensorDictBase:
        return td.set("action", torch.zeros(*td.shape, 12))

    def make() -> AgilityEnv:
        return AgilityEnv(4, stand, decision_steps=2, seed=1, simulator_options={"num_threads": 1})

    judge = TensorDictModule(
        lambda motion: motion.mean((1, 2)).tanh()[:, None], in_keys=[keys.MOTION], out_keys=[keys.DISCRIMINATOR_LOGIT]
    )
    transform = ImitationReward(judge, 0.4)
    env, plain = TransformedEnv(make(), transform), make()
    check_env_specs(env)
    rollouts = []
    for world in (env, plain):
        world.set_seed(1)
        torch.manual_seed(0)
        rollouts.append(world.rollout(5, break_when_any_done=False)["next"])
    paid, unpaid = rollouts
    torch.testing.assert_close(paid[keys.MOTION], unpaid[keys.MOTION])
    added = transform.reward(unpaid)
    assert added.max() > 0.0 and added.std() > 0.0
    torch.testing.assert_close(paid["reward"], unpaid["reward"] + added)
    env.close()
    plain.close()
