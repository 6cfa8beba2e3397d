"""A teacher that copies a script before it learns by itself, as a dog is led over a course before it runs alone.

Behaviours that are drawn anew for every decision are none: who is told to jump for a tenth of a second does not jump.
To find by chance that a bar is to be jumped takes longer than two cores have time for.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn import functional as F
from tsc_config import CloningConfig
from tsc_guide import Guide, Sprint
from tsc_script import Script, read
from tsc_setup import Components

from agility_rl import keys
from agility_rl.behaviours import FASTEST_CANTER
from agility_rl.training.seeding import permutation

READ = (keys.OBSTACLE, keys.HEADING_ERROR, keys.PLACE)
"""What a script or the guide reads."""


def clone(parts: Components, cfg: CloningConfig, fastest_canter: float = FASTEST_CANTER) -> dict[str, float]:
    """Copy a script in several roll-outs; returns the losses of the last minibatch.

    Where the script says nothing, the teacher is held to what it did before: to its parameters as the environment
    applies them, clipped to [-1, 1]. A script of ``own`` alone brings back means that have left that range.

    Source: ours; robots that the teacher drives are labelled too, as in DAgger (Ross et al. 2011, arXiv:1011.0686).

    Raises:
        ValueError: if the script is none.
    """
    script = read(cfg.script, "--cloning.script", fastest_canter)
    actor = parts.teacher.trained_actor()
    networks = actor[:-1]  # up to the distribution
    before = copy.deepcopy(networks).requires_grad_(False)
    allowed = parts.teacher.actor.network.mask == 0.0
    optimizer = torch.optim.Adam(actor.parameters(), lr=cfg.learning_rate, fused=True)
    policy = led(parts, script, round(cfg.scripted * parts.env.num_robots))
    losses: dict[str, Tensor] = {}
    for _ in range(cfg.iterations):
        batch = parts.learner.rollout.collect(policy).select(*actor.in_keys, *READ).flatten()
        label = targets(script.decide(batch.select(*READ))[keys.ACTION], before(batch.clone()), cfg.smoothing, allowed)
        for _ in range(cfg.epochs):
            for rows in permutation(len(batch), parts.generator).chunk(cfg.minibatches):
                losses = imitation(networks(batch[rows]), label[rows])
                optimizer.zero_grad(set_to_none=True)
                torch.stack(tuple(losses.values())).sum().backward()
                optimizer.step()
    return {name: value.item() for name, value in losses.items()}


def targets(told: TensorDictBase, before: TensorDictBase, smoothing: float, allowed: Tensor) -> TensorDictBase:
    """What a teacher shall say: probabilities of the behaviours [M, 5] and their parameters [M, 5, 6].

    Args:
        told: ``behaviour`` int64 [M], -1 where the script says nothing, and ``parameters`` [M, 5, 6] of the script.
        before: ``logits`` [M, 5] and ``loc`` [M, 5, 6] of the teacher before it copies.
        smoothing: share of the script's choice that is spread over the allowed behaviours.
        allowed: bool [5].

    Example:
        >>> told = TensorDict({"behaviour": torch.tensor([2, -1]), "parameters": torch.ones(2, 5, 6)}, [2])
        >>> before = TensorDict({"logits": torch.zeros(2, 5), "loc": torch.zeros(2, 5, 6)}, [2])
        >>> label = targets(told, before, 0.0, torch.ones(5, dtype=torch.bool))
        >>> [[round(share, 3) for share in row] for row in label["behaviour"].tolist()]
        [[0.0, 0.0, 1.0, 0.0, 0.0], [0.2, 0.2, 0.2, 0.2, 0.2]]
    """
    silent = told[keys.BEHAVIOUR] < 0
    chosen = F.one_hot(told[keys.BEHAVIOUR].clamp(min=0), len(allowed)) * (1.0 - smoothing)
    wanted = torch.where(silent[:, None], before["logits"].softmax(-1), chosen + smoothing * allowed / allowed.sum())
    applied = before["loc"].clamp(-1.0, 1.0)
    parameters = torch.where(silent[:, None, None], applied, told[keys.PARAMETERS])
    return TensorDict({keys.BEHAVIOUR: wanted, keys.PARAMETERS: parameters}, told.batch_size)


def imitation(said: TensorDictBase, label: TensorDictBase) -> dict[str, Tensor]:
    """Cross-entropy of the behaviours, and squared error of all their parameters.

    Args:
        said: ``logits`` [M, 5] and ``loc`` [M, 5, 6] of the teacher.
        label: see :func:`targets`.

    Example:
        >>> said = TensorDict({"logits": torch.zeros(1, 5), "loc": torch.zeros(1, 5, 6)}, [1])
        >>> label = TensorDict({"behaviour": torch.eye(5)[2:3], "parameters": torch.ones(1, 5, 6)}, [1])
        >>> {name: round(float(loss), 4) for name, loss in imitation(said, label).items()}
        {'behaviour': 1.6094, 'parameters': 1.0}
    """
    return {
        "behaviour": F.cross_entropy(said["logits"], label[keys.BEHAVIOUR]),
        "parameters": F.mse_loss(said["loc"], label[keys.PARAMETERS]),
    }


def led(parts: Components, script: Script | Guide | Sprint, number: int) -> Callable[[TensorDictBase], TensorDictBase]:
    """The teacher as a policy in whose place a script drives the first robots."""
    own = parts.teacher.privileged_policy()

    def act(td: TensorDictBase) -> TensorDictBase:
        td = own(td)
        if number:
            told = script.decide(TensorDict({key: td[key][:number] for key in READ}, [number]))[keys.ACTION]
            says = (told[keys.BEHAVIOUR] >= 0).nonzero()[:, 0]
            for key in (keys.BEHAVIOUR, keys.PARAMETERS):
                td[keys.ACTION, key][says] = told[key][says]
        return td

    return act
