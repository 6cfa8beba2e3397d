"""Robots that begin where others were shortly before they failed: which moments, by hand; and in the engine."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from agility_rl import keys
from agility_rl.envs import AgilityEnv
from agility_rl.training import rewind
from agility_rl.training.rewind import Rewind
from agility_rl.training.rollout import Rollout

N, DT = 6, 0.04


class Clock:
    """An environment in which a snapshot says when it was taken, and of whom."""

    num_robots = N

    def __init__(self) -> None:
        self.now, self.placed = 0, TensorDict()

    def snapshot(self) -> TensorDict:
        return TensorDict({"step": torch.full((N,), self.now), "robot": torch.arange(N)}, [N])

    def restore(self, rows: Tensor, snapshot: TensorDictBase) -> TensorDict:
        self.placed = TensorDict({"rows": rows, "from": snapshot}, [len(rows)])
        return TensorDict({}, [N])


def watched(one: Rewind, clock: Clock, steps: int) -> None:
    """A roll-out of so many steps, in which the policy counts them too."""
    act = one.watching(lambda td: td)
    for clock.now in range(steps):
        act(TensorDict({"memory": {"count": torch.full((N,), clock.now)}}, [N]))


def ends(steps: int, *where: tuple[int, int]) -> Tensor:
    """Bool ``[T, N, 1]``, set at those steps and robots."""
    flags = torch.zeros(steps, N, 1, dtype=torch.bool)
    for step, robot in where:
        flags[step, robot] = True
    return flags


def test_what_is_kept_lies_so_long_before_the_failure_and_in_the_same_episode(generator: torch.Generator) -> None:
    clock, steps = Clock(), 100
    one = Rewind(clock, 2, DT, generator)
    least, most = (seconds / DT for seconds in rewind.BACK)
    lags = []
    for _ in range(40):
        watched(one, clock, steps)
        failed = ends(steps, (90, 3), (50, 5), (15, 4), (60, 4), (12, 3), (70, 0))
        one.remember(failed, failed | ends(steps, (45, 4)))  # another episode of 4 ended without failing
        assert one.kept is not None
        newest, one.kept = one.kept, None
        found = dict(zip(newest["robot"].tolist(), newest["step"].tolist(), strict=True))
        assert set(found) == {3, 5}, "15 and 12 come too early, 60 too soon after 45, and 0 is rewound itself"
        assert found[3] > 12 and all(step % one.apart == 0 for step in found.values())
        lags += [90 - found[3], 50 - found[5]]
    assert least <= min(lags) < least + one.apart and most - one.apart < max(lags) <= most + one.apart / 2


def test_nobody_begins_elsewhere_before_enough_has_failed(
    generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rewind, "LEAST", 3)
    monkeypatch.setattr(rewind, "CAPACITY", 4)
    clock = Clock()
    one = Rewind(clock, 2, DT, generator)
    course = AgilityEnv(N, stand, simulator_options={"num_threads": 1})
    rollout = Rollout(course, 1, **KEPT)
    rollout.collect(course.rand_action)
    for robot in (3, 4, 5, 3, 4):
        watched(one, clock, 100)
        failed = ends(100, (80, robot))
        one.remember(failed, failed)
        one.begin(rollout)
        assert one.kept is not None and clock.placed.is_empty() == (len(one.kept) < 3)
    assert one.kept["robot"].tolist() == [4, 5, 3, 4], "the newest"
    assert clock.placed["rows"].tolist() == [0, 1] and set(clock.placed["from", "robot"].tolist()) <= {3, 4, 5}
    course.close()


def test_what_the_policy_remembered_then_comes_back_too(
    generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rewind, "LEAST", 1)
    clock, count = Clock(), ("memory", "count")
    one = Rewind(clock, 2, DT, generator, carried=[count])
    course = AgilityEnv(N, stand, simulator_options={"num_threads": 1})
    rollout = Rollout(course, 1, **KEPT)
    rollout.collect(course.rand_action)
    assert rollout.carrier is not None
    rollout.carrier[count] = torch.full((N,), -1)
    watched(one, clock, 100)
    failed = ends(100, (80, 3), (90, 4))
    one.remember(failed, failed)
    one.begin(rollout)
    assert rollout.carrier[count].tolist() == [*clock.placed["from", "step"].tolist(), -1, -1, -1, -1]
    course.close()


def stand(td: TensorDictBase) -> TensorDictBase:
    """A controller that does nothing."""
    return td.set(keys.ACTION, torch.zeros(*td.shape, 12))


def topple(td: TensorDictBase) -> TensorDictBase:
    """A controller under which robots fall within a second or two."""
    return td.set(keys.ACTION, 2.0 * torch.sin(3.0 * td[keys.HISTORY][:, -1, :12] + 1.0))


KEPT = {
    "keep": [keys.PLACE, keys.HISTORY],
    "keep_next": ["reward"],
    "value": lambda td: torch.zeros(*td.shape, 1),
}


ENGINES = [
    pytest.param({"name": "batch", "num_threads": 1}, id="batch"),
    pytest.param({"name": "warp", "device": "cpu"}, id="warp", marks=pytest.mark.slow),
]


@pytest.fixture(params=ENGINES)
def env(request: pytest.FixtureRequest) -> Iterator[AgilityEnv]:
    env = AgilityEnv(N, topple, decision_steps=2, seed=3, simulator_options=request.param)
    yield env
    env.close()


def test_in_the_engine_they_fail_again_as_the_others_did(
    env: AgilityEnv, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A rewound robot sees what the other saw then, and with the same decisions falls after as long a time."""
    monkeypatch.setattr(rewind, "LEAST", 1)
    monkeypatch.setattr(rewind, "BACK", (0.2, 1.0))
    env.decisions.noise = (1.0, 1.0)
    steps = 100
    one, rollout = Rewind(env, 1, DT, generator), Rollout(env, steps, **KEPT)

    def decide(td: TensorDictBase) -> TensorDictBase:
        decision = {"behaviour": torch.full((N,), 2), "parameters": torch.zeros(N, 5, 6)}
        return td.set(keys.ACTION, TensorDict(decision, [N]))

    batch = rollout.collect(one.watching(decide)).clone()
    failed, done = batch["next", "terminated"], batch["next", "done"]
    end, robot = failed[:, 1:, 0].nonzero()[-1].tolist()
    only = torch.zeros_like(failed)
    only[end, robot + 1] = True
    one.remember(only, done)
    assert one.kept is not None and len(one.kept) == 1
    others = rollout.carrier.clone()  # type: ignore[union-attr]
    one.begin(rollout)
    now = rollout.carrier
    assert now is not None and torch.equal(now[keys.HISTORY][1:], others[keys.HISTORY][1:])
    seen = batch[keys.HISTORY][:, robot + 1]
    moment = (seen == now[keys.HISTORY][0]).flatten(1).all(-1).nonzero()[:, 0]
    assert len(moment) == 1 and moment.item() % one.apart == 0
    again = rollout.collect(decide)
    ahead = end - moment.item()
    torch.testing.assert_close(again[keys.PLACE][: ahead + 1, 0], batch[keys.PLACE][moment.item() : end + 1, robot + 1])
    assert again["next", "terminated"][: ahead + 1, 0, 0].nonzero()[:, 0].tolist() == [ahead]


def test_saved_snapshots_come_back(generator: torch.Generator) -> None:
    clock = Clock()
    one, other = Rewind(clock, 2, DT, generator), Rewind(clock, 2, DT, generator)
    assert one.state_dict() == {}
    watched(one, clock, 100)
    failed = ends(100, (80, 3), (90, 4))
    one.remember(failed, failed)
    other.load_state_dict(one.state_dict())
    assert one.kept is not None and other.kept is not None and bool((one.kept == other.kept).all())
    other.load_state_dict({})
    assert other.kept is None


@pytest.mark.parametrize("count", [0, N])
def test_somebody_must_go_on(count: int, generator: torch.Generator) -> None:
    with pytest.raises(ValueError, match=f"expected 1 to 5 of 6 robots, got {count}"):
        Rewind(Clock(), count, DT, generator)
