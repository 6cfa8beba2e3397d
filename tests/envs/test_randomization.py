"""Draws of physical parameters: inside their ranges, described to the networks, and really in the engine."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict

from agility_rl import keys
from agility_rl.envs import LocomotionEnv
from agility_rl.envs.randomization import NOMINAL, Randomization, sample_parameters, uniform
from agility_rl.go2 import features

Build = Callable[..., LocomotionEnv]


def test_ranges_of_the_method_notes(generator: torch.Generator) -> None:
    fields, _ = sample_parameters(2000, Randomization(action_delay=(0.0, 0.02)), generator)
    expected = {
        "ground_friction": (1, 0.6, 2.0),
        "trunk_mass_offset": (1, 0.0, 1.5),
        "trunk_com_offset": (3, -0.1, 0.1),
        "stiffness": (12, 32.0, 48.0),
        "damping": (12, 0.8, 1.2),
        "action_delay": (1, 0.0, 0.02),
    }
    assert set(fields) == set(expected)
    for name, (size, low, high) in expected.items():
        value = fields[name]
        assert value.shape == (2000, size)
        assert value.min() >= low - 1e-5 and value.max() <= high + 1e-5, name
        assert value.max() - value.min() > 0.98 * (high - low), name
        assert value.mean().item() == pytest.approx((low + high) / 2, abs=0.03 * (high - low)), name


def test_joints_are_drawn_apart(generator: torch.Generator) -> None:
    fields, _ = sample_parameters(1, Randomization(), generator)
    assert fields["stiffness"].unique().numel() == fields["damping"].unique().numel() == 12


def test_privileged_layout(generator: torch.Generator) -> None:
    fields, privileged = sample_parameters(3, Randomization(), generator)
    columns = privileged.split([entry.size for entry in features.PRIVILEGED_LAYOUT], -1)
    described = dict(zip((entry.name for entry in features.PRIVILEGED_LAYOUT), columns, strict=True))
    expected = {
        "trunk_mass": fields["trunk_mass_offset"],
        "trunk_com": fields["trunk_com_offset"],
        "ground_friction": fields["ground_friction"],
        "stiffness": fields["stiffness"] / 40.0 - 1.0,
        "damping": fields["damping"] / 1.0 - 1.0,
    }
    assert described.keys() == expected.keys()
    for name, value in expected.items():
        torch.testing.assert_close(described[name], value, atol=1e-6, rtol=0, msg=name)


def test_nominal(generator: torch.Generator) -> None:
    fields, privileged = sample_parameters(2, NOMINAL, generator)
    assert (fields["stiffness"] == 40).all() and (fields["damping"] == 1).all()
    assert "action_delay" not in fields  # without delay the engine takes all substeps at once
    assert privileged.sum().item() == 2.0  # the friction of 1 of both


def test_draws_follow_the_generator() -> None:
    one, other = (sample_parameters(4, Randomization(), torch.Generator().manual_seed(3))[1] for _ in range(2))
    assert torch.equal(one, other)


def test_reversed_interval_is_refused(generator: torch.Generator) -> None:
    with pytest.raises(ValueError, match=r"low <= high, got \(2.0, 1.0\)"):
        uniform((3,), (2.0, 1.0), generator)


def test_resets_draw_anew_for_their_own_rows_and_set_the_engine(build: Build) -> None:
    env = build(4, randomization=Randomization(action_delay=(0.0, 0.02)))
    first = env.reset()
    carrier = env.step(first.clone().set(keys.ACTION, torch.zeros(4, 12)))["next"]
    mask = torch.tensor([True, False, False, True])
    second = env.reset(carrier.set("_reset", mask[:, None]))
    same = (second[keys.PRIVILEGED] == first[keys.PRIVILEGED]).all(-1)
    assert same.tolist() == [False, True, True, False]
    engine, told = env.simulator, second[keys.PRIVILEGED]
    torch.testing.assert_close(engine.parameter("trunk_mass_offset"), told[:, :1])
    torch.testing.assert_close(engine.parameter("trunk_com_offset"), told[:, 1:4])
    torch.testing.assert_close(engine.parameter("ground_friction"), told[:, 4:5])
    torch.testing.assert_close(engine.parameter("stiffness"), 40.0 * (1.0 + told[:, 5:17]))
    torch.testing.assert_close(engine.parameter("damping"), 1.0 + told[:, 17:])
    # and not only in its books: the compiled model's fields of each simulation
    mass = engine.batch.expand("body_mass")[:, engine.model.body("trunk").id] - engine.model.body("trunk").mass
    torch.testing.assert_close(torch.as_tensor(mass).float(), told[:, 0], atol=1e-6, rtol=0)


def test_a_heavier_robot_presses_harder(build: Build) -> None:
    """Total foot force at rest is weight: 15.2064 kg, and 1.5 kg more."""
    heavy = Randomization((1.0, 1.0), (1.5, 1.5), (0.0, 0.0), (1.0, 1.0))
    for ranges, mass in ((None, 15.2064), (heavy, 16.7064)):
        env = build(1, randomization=ranges)
        env.reset()
        forces = []
        for step in range(100):
            env.step(TensorDict({keys.ACTION: torch.zeros(1, 12)}, [1]))
            if step >= 60:
                forces.append(env.simulator.contact_force.sum())
        assert torch.stack(forces).mean().item() == pytest.approx(9.81 * mass, rel=0.05)


def test_an_identified_simulator_takes_the_place_of_the_ranges(generator: torch.Generator) -> None:
    def draw(count: int, source: torch.Generator) -> dict[str, torch.Tensor]:
        return {"stiffness": 20.0 + torch.rand(count, 1, generator=source).expand(-1, 12)}

    fields, privileged = sample_parameters(100, Randomization(draw=draw), generator)
    stiffness = fields["stiffness"]
    assert stiffness.min() >= 20.0 and stiffness.max() <= 21.0 and stiffness.unique().numel() == 100
    torch.testing.assert_close(privileged[:, 5:17], stiffness / 40.0 - 1.0)
    assert fields["damping"].std() > 0.1  # what it leaves open is still drawn
