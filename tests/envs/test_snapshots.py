"""Robots that go on from where others were: taken out of a state and put into another."""

from __future__ import annotations

import pytest
import torch

from agility_rl import keys
from agility_rl.envs import AgilityEnv
from agility_rl.envs.agility import COURSE_RANDOMIZATION
from agility_rl.envs.snapshots import SHARED, per_robot, with_rows


def state(first: float) -> dict[str, object]:
    """Three robots, numbered from ``first``."""
    number = first + torch.arange(3.0)
    return {
        "simulator": {"state": number[:, None].double(), "parameters": {}},
        "arena": {"leg": number.long(), "start_weights": number, "difficulty": first},
        "generator": number,
    }


def test_what_all_share_stays_where_it_is() -> None:
    snapshot = per_robot(state(0.0), 3)
    names = {name if isinstance(name, str) else name[-1] for name in snapshot.keys(True, True)}
    assert names == {"state", "leg"} and not names & set(SHARED)
    after = with_rows(state(10.0), torch.tensor([2, 0]), snapshot[torch.tensor([1, 1])])
    assert after["simulator"]["state"].tolist() == [[1.0], [11.0], [1.0]] and after["simulator"]["parameters"] == {}
    assert after["arena"]["leg"].tolist() == [1, 11, 1] and after["arena"]["difficulty"] == 10.0
    assert after["arena"]["start_weights"].tolist() == after["generator"].tolist() == [10.0, 11.0, 12.0]


def test_a_snapshot_of_something_else_is_refused() -> None:
    snapshot = per_robot({"arena": {"leg": torch.arange(3)}}, 3)
    with pytest.raises(ValueError, match="the snapshot holds no 'simulator': it is of an environment with other"):
        with_rows({"simulator": {"state": torch.zeros(3, 1)}}, torch.tensor([0]), snapshot)


def test_a_snapshot_is_not_changed_by_what_it_is_put_into() -> None:
    snapshot, rows = per_robot(state(0.0), 3), torch.tensor([0, 1, 2])
    after = with_rows(state(10.0), rows, snapshot)
    after["arena"]["leg"] += 5
    assert snapshot["arena", "leg"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("robots", [1, 5, 6, 7])  # as many as obstacles, or behaviours: what all share has such sizes
def test_a_course_tells_its_robots_from_what_they_share(robots: int) -> None:
    env = AgilityEnv(
        robots,
        lambda td: td.set(keys.ACTION, torch.zeros(robots, 12)),
        simulator_options={"num_threads": 1},
        randomization=COURSE_RANDOMIZATION,
        misjudgement=1.0,
        depth={},
    )
    env.reset()
    snapshot, state = env.snapshot(), env.state_dict()
    names = {name[-1] if isinstance(name, tuple) else name for name in snapshot.keys(True, True)}
    assert snapshot.batch_size == (robots,) and not names & set(SHARED)
    assert {"state", "ground_friction", "yaw", "leg", "history", "frames", "unknown", "step_count"} <= names
    everyone = torch.arange(robots)
    assert with_rows(state, everyone, snapshot)["arena"]["start_weights"] is state["arena"]["start_weights"]
    env.close()
