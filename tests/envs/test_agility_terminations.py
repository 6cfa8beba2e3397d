"""When an episode on the course has failed."""

from __future__ import annotations

from collections.abc import Callable

import torch

from agility_rl.envs import agility_terminations as terminations
from agility_rl.envs.agility_state import AgilityState
from agility_rl.envs.state import LocomotionState

Make = Callable[..., AgilityState]
NAMES = {"body_contact", "thigh_contact", "tilted", "sunk", "lost", "diverged"}


def held(state: AgilityState, row: int = 0) -> set[str]:
    return {name for name, failed in terminations.AGILITY_TERMINATIONS.items() if bool(failed(state)[row])}


def test_names_of_the_notes(on_course: Make) -> None:
    assert set(terminations.AGILITY_TERMINATIONS) == NAMES
    assert held(on_course(1)) == set()


def test_contacts_above_one_newton(on_course: Make, neutral: Callable[..., LocomotionState]) -> None:
    one = torch.tensor([[0.0, 1.1, 0.0, 0.0], [0.9, 0.9, 0.9, 0.9]])
    for link, name in (("hip", "body_contact"), ("thigh", "thigh_contact")):
        state = on_course(2, robot=neutral(2, **{f"{link}_contact": one}))
        assert held(state, 0) == {name} and held(state, 1) == set()
    state = on_course(2, robot=neutral(2, trunk_contact=torch.tensor([1.1, 0.9])))
    assert held(state, 0) == {"body_contact"} and held(state, 1) == set()
    assert held(on_course(1, robot=neutral(1, calf_contact=torch.full((1, 4), 50.0)))) == set()


def test_tilt_depth_distance_and_divergence(on_course: Make, neutral: Callable[..., LocomotionState]) -> None:
    for angle in ("roll", "pitch"):
        state = on_course(2, robot=neutral(2, **{angle: torch.tensor([-1.51, 1.49])}))
        assert held(state, 0) == {"tilted"} and held(state, 1) == set()
    deep = on_course(2, position=torch.tensor([[0.0, 0.0, -0.26], [0.0, 0.0, -0.24]]))
    assert held(deep, 0) == {"sunk"} and held(deep, 1) == set()
    far = on_course(2, goal_distance=torch.tensor([4.1, 3.9]))
    assert held(far, 0) == {"lost"} and held(far, 1) == set()
    assert held(on_course(1, robot=neutral(1, unstable=torch.tensor([True])))) == {"diverged"}
