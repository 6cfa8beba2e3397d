from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from agility_rl import rotations
from agility_rl.collectors import RobotSensors
from agility_rl.go2 import constants, features
from agility_rl.simulation import BatchSimulator

POSE = torch.tensor(constants.DEFAULT_POSE)
Simulate = Callable[..., BatchSimulator]


def everyone(n: int) -> torch.Tensor:
    return torch.ones(n, dtype=torch.bool)


def step(simulator: BatchSimulator, generator: torch.Generator) -> None:
    simulator.step(POSE + 0.2 * torch.randn(simulator.num_simulations, 12, generator=generator))


def test_a_clean_reading_is_the_state(simulate: Simulate, generator: torch.Generator) -> None:
    simulator, sensors = simulate(), RobotSensors(2)
    sensors.reset(simulator, everyone(2))
    for _ in range(5):
        step(simulator, generator)
        reading = sensors.read(simulator)
    roll, pitch, _ = rotations.to_euler(simulator.root_quaternion)
    assert torch.equal(reading[:, :2], torch.stack((roll, pitch), -1))
    assert torch.equal(reading[:, 2:5], simulator.root_angular_velocity)
    assert torch.equal(reading[:, 5:17], simulator.joint_position)
    assert torch.equal(reading[:, 17:29], simulator.joint_velocity)
    assert set(reading[:, 29:].unique().tolist()) <= {0.0, 1.0}


def test_latency_holds_readings_back_and_a_reset_forgets_them(simulate: Simulate, generator: torch.Generator) -> None:
    simulator, late, prompt = simulate(), RobotSensors(2, latency=2), RobotSensors(2)
    prompt_readings, late_readings = [prompt.reset(simulator, everyone(2))], [late.reset(simulator, everyone(2))]
    for _ in range(5):
        step(simulator, generator)
        prompt_readings.append(prompt.read(simulator))
        late_readings.append(late.read(simulator))
    assert all(torch.equal(reading, prompt_readings[0]) for reading in late_readings[:3])
    assert torch.equal(late_readings[5], prompt_readings[3])
    reading = late.reset(simulator, torch.tensor([True, False]))
    assert torch.equal(reading[0, :29], prompt_readings[5][0, :29])
    assert torch.equal(reading[1], late_readings[5][1])
    step(simulator, generator)
    reading = late.read(simulator)
    assert torch.equal(reading[0, :29], prompt_readings[5][0, :29])
    assert torch.equal(reading[1], prompt_readings[4][1])


def test_noise_is_uniform_in_its_half_widths(simulate: Simulate, generator: torch.Generator) -> None:
    simulator = simulate(400)
    sensors = RobotSensors(400, noise=0.5, generator=generator)
    difference = sensors.reset(simulator, everyone(400)) - RobotSensors(400).reset(simulator, everyone(400))
    width = 0.5 * features.noise_scale(features.MEASUREMENT_LAYOUT)
    assert bool((difference[:, :29].abs() <= width * 1.0001 + 1e-6).all())
    torch.testing.assert_close(difference[:, :29].std(0), width / 3**0.5, rtol=0.15, atol=1e-4)
    assert difference[:, 29:].count_nonzero() == 0


def test_noise_of_named_entries_only(simulate: Simulate, generator: torch.Generator) -> None:
    simulator = simulate()
    noisy = RobotSensors(2, noise={"joint_velocity": 0.2}, generator=generator).reset(simulator, everyone(2))
    clean = RobotSensors(2).reset(simulator, everyone(2))
    assert torch.equal(noisy[:, :17], clean[:, :17])
    assert 0.0 < (noisy - clean)[:, 17:29].abs().max() <= 0.2


def test_errors() -> None:
    with pytest.raises(ValueError, match="needs a generator"):
        RobotSensors(1, noise=1.0)
    with pytest.raises(ValueError, match="latency"):
        RobotSensors(1, latency=-1)
    with pytest.raises(ValueError, match="no measurement is called nose"):
        RobotSensors(1, noise={"nose": 1.0})
