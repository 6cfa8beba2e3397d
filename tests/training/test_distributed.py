"""What several processes agree on: two of them, by gloo, against one that holds everything."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch

from agility_rl.training import distributed
from agility_rl.training.seeding import Seeds

WORKER = """
import math, sys
import torch
from tensordict import TensorDict
from torchrl.objectives import ClipPPOLoss
from agility_rl.modules import Critic, GaussianActor
from agility_rl.training import distributed
from agility_rl.training.ppo import PPOUpdate
from agility_rl.training.seeding import Seeds, seed_everything

def experience(rows):
    generator = torch.Generator().manual_seed(0)
    batch = TensorDict({"observation": torch.rand(6, 8, 2, generator=generator)}, [6, 8])
    batch["action"] = torch.randn(6, 8, 1, generator=generator)
    batch["action_log_prob"] = -torch.rand(6, 8, generator=generator)
    batch["advantage"] = torch.randn(6, 8, 1, generator=generator)
    batch["value_target"] = torch.randn(6, 8, 1, generator=generator)
    batch["state_value"] = torch.zeros(6, 8, 1)
    batch["skill"] = torch.randint(3, (6, 8), generator=generator)
    return batch[:, rows].contiguous()

def updated(rows):
    torch.manual_seed(0)
    actor = GaussianActor(2, 1, in_keys=["observation"], hidden=(16,), initial_std=0.5)
    critic = Critic(2, in_keys=["observation"], hidden=(16,))
    distributed.share([actor, critic])
    optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=1e-2)
    loss = ClipPPOLoss(actor, critic, entropy_coeff=0.01, loss_critic_type="l2")
    update = PPOUpdate(loss, optimizer, epochs=3, minibatches=1, max_grad_norm=0.1,
        divergence=lambda sample: sample["observation"].mean(), groups=("skill", 3))
    metrics = update(experience(rows), torch.Generator().manual_seed(1))
    return torch.cat([p.detach().flatten() for p in distributed.optimized(optimizer)]), metrics["kl"]

alone, kl_alone = updated(slice(None))
before = distributed.rank()
with distributed.processes():
    rank = distributed.rank()
    assert before == rank
    assert distributed.size() == 2
    value = torch.tensor([1.0, 2.0]) + 2.0 * rank
    assert distributed.total(value).tolist() == [4.0, 6.0] and value.tolist() == [1.0 + 2.0 * rank, 2.0 + 2.0 * rank]
    assert distributed.average(value).tolist() == [2.0, 3.0]
    mean, deviation = distributed.moments(value, torch.tensor([0, rank]), 2)  # of 1, 2 and 3; of 4 alone
    torch.testing.assert_close((mean, deviation), (torch.tensor([2.0, 0.0]), torch.tensor([1.0, 1.0])))
    assert distributed.anyone(rank == 1) and not distributed.anyone(False)
    mine = {"a": 1.0, "b": math.nan, "c": 7.0} if rank else {"a": 0.0, "b": 4.0}
    found = distributed.average_metrics(mine)
    assert found == {"a": 0.5, "b": 4.0, "c": 7.0}, found
    assert math.isnan(distributed.average_metrics({"a": math.nan})["a"])
    module = torch.nn.Linear(2, 1)
    torch.nn.init.constant_(module.weight, float(rank + 1))
    distributed.share([module])
    assert module.weight.tolist() == [[1.0, 1.0]]
    buffers = torch.nn.BatchNorm1d(2)
    buffers.running_mean.fill_(rank + 1.0)
    distributed.share([buffers])
    assert buffers.running_mean.tolist() == [1.0, 1.0]
    (module.weight.sum() * (rank + 1)).backward()
    distributed.average_gradients(module.parameters())
    assert module.weight.grad.tolist() == [[1.5, 1.5]] and module.bias.grad is None
    together, kl = updated(slice(0, 4) if rank == 0 else slice(4, 8))
    torch.testing.assert_close(together, alone, atol=1e-6, rtol=1e-5)
    torch.testing.assert_close(kl, kl_alone)
    draws = distributed.total(torch.rand(1, generator=seed_everything(3).generator("environment")) * (1 - 2 * rank))
    assert draws.abs() > 1e-6, "each has random numbers of its own"
print("agreed")
"""


def test_two_processes_update_as_one_with_all_the_experience(tmp_path: Path, repository: Path) -> None:
    script = tmp_path / "worker.py"
    script.write_text(textwrap.dedent(WORKER))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(repository)}
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--nproc-per-node=2",
        f"--master-port={port}",
        str(script),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment)
    assert done.returncode == 0 and done.stdout.count("agreed") == 2, done.stderr


def test_alone_everything_stays_what_it_is() -> None:
    with distributed.processes():
        assert (distributed.rank(), distributed.size()) == (0, 1)
    value = torch.randn(5)
    assert distributed.total(value) is value and distributed.average(value) is value
    together = torch.stack(distributed.moments(value, torch.zeros(5, dtype=torch.int64), 1))[:, 0]
    torch.testing.assert_close(together, torch.stack((value.mean(), value.std())))
    distributed.wait()


def test_the_first_process_draws_what_a_single_one_draws() -> None:
    alone, first, second = Seeds(4), Seeds(4, rank=0), Seeds(4, rank=1)
    assert alone.integer("environment") == first.integer("environment") != second.integer("environment")


@pytest.mark.parametrize("flag", [True, False])
def test_anyone_alone(flag: bool) -> None:
    assert distributed.anyone(flag) is flag
