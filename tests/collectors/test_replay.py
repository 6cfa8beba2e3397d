from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase

from agility_rl.collectors import EASICollector, ParameterSpace, ReplayCollector, RobotLog, Windows, cut_windows
from agility_rl.collectors.replay import MATCHED
from agility_rl.collectors.windows import predict
from agility_rl.modules import TransitionDiscriminator
from agility_rl.simulation import BatchSimulator

Simulate = Callable[..., BatchSimulator]
SPACE = ParameterSpace()


def replaying(simulator: BatchSimulator, windows: Windows, seed: int = 0, num_windows: int = 6) -> ReplayCollector:
    generator = torch.Generator().manual_seed(seed)
    return ReplayCollector(simulator, SPACE, windows, num_windows=num_windows, generator=generator)


def closeness(td: TensorDictBase) -> TensorDictBase:
    """A critic that knows the robot."""
    miss = (td["next", "measurement"] - td[MATCHED]).abs().clamp_max(0.5)
    return td.set("transition_logit", -miss.sum(-1, keepdim=True))


def test_transitions_are_the_log_s_own_but_for_what_follows(simulate: Simulate, log: RobotLog) -> None:
    windows, individuals = cut_windows(log, 3, skip=1), torch.rand(4, 6)
    td = replaying(simulate(8), windows).collect(individuals)
    rows = torch.randperm(len(windows), generator=torch.Generator().manual_seed(0))[:6]
    assert td.shape == (4, 12)
    assert torch.equal(td["individual"][2, 5], individuals[2])
    expected = predict(simulate(4), SPACE, individuals, windows.take(rows))[:, :, 1:]
    assert torch.equal(td["next", "measurement"], expected.flatten(1, 2))
    whole = log.transitions()
    first = (3 * rows[:, None] + torch.tensor([1, 2])).flatten()  # rows of the log; the first of each window is skipped
    for j in range(4):
        assert torch.equal(td["measurement"][j], whole["measurement"][first])
        assert torch.equal(td["action"][j], whole["action"][first])
        assert torch.equal(td[MATCHED][j], whole["next", "measurement"][first])
    assert bool(td["collector", "mask"].all())


def test_the_robot_s_transitions_match_themselves(simulate: Simulate, log: RobotLog) -> None:
    collector = replaying(simulate(1), cut_windows(log, 1))
    expected = log.transitions()
    assert len(collector.real) == len(expected) == 119
    for key in ("measurement", "action", ("next", "measurement")):
        assert torch.equal(collector.real[key], expected[key])
    assert torch.equal(collector.real[MATCHED], expected["next", "measurement"])


@pytest.mark.parametrize(("steps", "skip"), [(1, 0), (5, 1)])
def test_a_critic_that_knows_the_robot_ranks_the_truth_first(
    simulate: Simulate, log: RobotLog, steps: int, skip: int
) -> None:
    truth = SPACE.normalize(SPACE.nominal)
    off = torch.cat((torch.eye(6), -torch.eye(6))).double()
    individuals = torch.cat((truth[None], truth + 0.15 * off))
    collector = replaying(simulate(13), cut_windows(log, steps, skip=skip), num_windows=60 // steps)
    scores = collector.score(closeness, collector.collect(individuals))
    assert scores.argmax() == 0, "every gain shows, dampings too"


def test_it_resumes_bit_for_bit_and_threads_do_not_matter(simulate: Simulate, log: RobotLog) -> None:
    windows, individuals = cut_windows(log, 4, skip=1, noise=1.0), torch.rand(3, 6)
    first = replaying(simulate(3), windows)
    before = first.collect(individuals)
    second = replaying(simulate(3, num_threads=2), windows, seed=9)
    second.load_state_dict(first.state_dict())
    one, two = first.collect(individuals), second.collect(individuals)
    assert all(torch.equal(one[key], two[key]) for key in one.keys(True, True))
    assert not torch.equal(one["measurement"], before["measurement"]), "every generation draws its own windows"


def test_who_diverges_in_one_window_has_no_score(simulate: Simulate, log: RobotLog) -> None:
    space = ParameterSpace(("hip_stiffness", "hip_torque_limit"))
    individuals = torch.full((3, 2), 0.5).double()
    individuals[1] = 8.0  # 3 ** 15 x nominal: no integrator holds such springs
    generator = torch.Generator().manual_seed(0)
    collector = ReplayCollector(simulate(3), space, cut_windows(log, 2), num_windows=59, generator=generator)
    td = collector.collect(individuals)
    assert bool(td.isfinite().all())
    assert td["collector", "mask"].all(-1).tolist() == [True, False, True]
    assert not bool(td["collector", "mask"][1].any())
    scores = ReplayCollector.score(closeness, td)
    assert scores[1] == -math.inf and bool(scores[[0, 2]].isfinite().all())
    sampled = ReplayCollector.sample(td, torch.Generator().manual_seed(0), 5)
    assert sampled.shape == (10,)


def test_scores_and_batches_are_those_of_the_other_collector(simulate: Simulate, log: RobotLog) -> None:
    collector = replaying(simulate(4), cut_windows(log, 2))
    td = collector.collect(torch.rand(4, 6))
    critic = TransitionDiscriminator.from_transitions(collector.real, clip=3.0, matched_key=MATCHED)
    critic.rescale(td)
    assert torch.equal(collector.score(critic, td), EASICollector.score(critic, td))
    samples: list[Any] = [
        kind.sample(td, torch.Generator().manual_seed(3), 4) for kind in (ReplayCollector, EASICollector)
    ]
    assert torch.equal(samples[0]["action"], samples[1]["action"])
    assert collector.num_steps == 12
    assert replaying(simulate(4), cut_windows(log, 2), num_windows=999).num_windows == 59, "no more than the log has"


def test_errors(simulate: Simulate, log: RobotLog) -> None:
    windows = cut_windows(log, 2)
    with pytest.raises(ValueError, match="num_windows must be at least 1, got 0"):
        replaying(simulate(2), windows, num_windows=0)
    with pytest.raises(ValueError, match=r"expected \[\*B, 6\]"):
        replaying(simulate(2), windows).collect(torch.rand(2, 5))
