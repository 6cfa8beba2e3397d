"""Rate, latency, mounting and noise of the camera, by itself and in the course environment."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.utils import check_env_specs

from agility_rl import keys
from agility_rl.envs import COURSES, AgilityEnv
from agility_rl.envs.depth import DepthObservation
from agility_rl.go2 import camera, constants
from agility_rl.simulation import BatchSimulator

STILL = {"pitch": 0.0, "offset_noise": 0.0, "pixel_noise": 0.0}


class Lift:
    """Robots at a height that counts control steps: the floor in the last row tells when an image was taken."""

    def __init__(self, robots: int, **options: Any) -> None:
        self.simulator = BatchSimulator(robots, num_threads=1)
        self.steps = torch.zeros(robots)
        self.put(torch.ones(robots, dtype=torch.bool))
        self.depth = DepthObservation(self.simulator, torch.Generator().manual_seed(0), **{**STILL, **options})
        self.depth.begin(torch.ones(robots, dtype=torch.bool))

    def put(self, mask: Tensor) -> None:
        n = len(mask)
        height = (0.3 + 0.02 * self.steps)[:, None]
        self.simulator.reset(
            mask,
            root_position=torch.cat((torch.zeros(n, 2), height), -1),
            root_quaternion=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
            root_linear_velocity=torch.zeros(n, 3),
            root_angular_velocity=torch.zeros(n, 3),
            joint_position=torch.tensor(constants.DEFAULT_POSE).repeat(n, 1),
            joint_velocity=torch.zeros(n, 12),
        )

    def step(self) -> None:
        self.steps += 1
        self.put(torch.ones(len(self.steps), dtype=torch.bool))
        self.depth.advance()

    def shown(self) -> list[float]:
        """Control steps after which the images shown were taken."""
        floor = camera.metres(self.depth.image())[:, -1, 40]
        height = floor * (57.5 - camera.PRINCIPAL_POINT[1]) / camera.FOCAL_LENGTH - camera.POSITION[2]
        return [round(step, 3) for step in ((height - 0.3) / 0.02).tolist()]


@pytest.mark.parametrize("latency", [0, 1, 2, 3])
@pytest.mark.parametrize("decision_steps", [1, 5])
@pytest.mark.parametrize("frame_steps", [1, 2, 3])
def test_the_newest_frame_of_at_least_the_latency_ago_is_shown(
    latency: int, decision_steps: int, frame_steps: int
) -> None:
    lift = Lift(1, latency=(latency, latency), decision_steps=decision_steps, frame_steps=frame_steps)
    assert lift.shown() == [0]
    for step in range(1, 13):
        lift.step()
        if step % decision_steps == 0:
            expected = max(0, (step - latency) // frame_steps * frame_steps)
            assert lift.shown() == [pytest.approx(expected, abs=0.01)], step
            assert lift.depth.age().item() == pytest.approx(0.02 * max(step - expected, latency)), step


def test_only_the_frames_that_are_shown_are_rendered(monkeypatch: pytest.MonkeyPatch) -> None:
    lift = Lift(3, latency=(1, 2), decision_steps=5)
    counted = []
    render = lift.depth.camera.render
    monkeypatch.setattr(lift.depth.camera, "render", lambda mask: counted.append(int(mask.sum())) or render(mask))
    for _ in range(10):
        lift.step()
    assert sum(counted) == 2 * 3  # two observations of three robots


def test_each_robot_has_its_own_latency_and_keeps_it_over_the_episode() -> None:
    lift = Lift(40, latency=(1, 2))
    seen = []
    for _ in range(6):
        lift.step()
        seen.append([lift.steps[0].item() - shown for shown in lift.shown()])
    late = {round(value) for value in seen[-1]}
    assert late == {1, 2}
    assert [round(value) for value in seen[-1]] == [round(value) for value in seen[-2]]


def test_a_new_episode_sees_its_first_frame_at_once_and_the_others_are_left_alone() -> None:
    lift = Lift(3, latency=(2, 2))
    for _ in range(4):
        lift.step()
    before = lift.depth.image()
    mask = torch.tensor([False, True, False])
    lift.depth.begin(mask)
    assert lift.shown() == pytest.approx([2, 4, 2], abs=0.01)
    assert lift.depth.age()[:, 0].tolist() == pytest.approx([0.04] * 3)
    assert torch.equal(lift.depth.image()[~mask], before[~mask])
    lift.step()
    assert lift.shown() == pytest.approx([3, 4, 3], abs=0.01)  # no frame of the former episode


def test_noise_has_the_width_that_the_source_says_and_belongs_to_a_frame() -> None:
    clean = Lift(60).depth.image()
    lift = Lift(60, offset_noise=0.05, pixel_noise=0.0, latency=(0, 0), frame_steps=2)
    inside = (clean > -0.45) & (clean < 0.45)
    span = camera.DEPTH_FAR - camera.DEPTH_NEAR
    error = (lift.depth.image() - clean) * span
    first = error[0][inside[0]]
    assert (first - first.mean()).abs().max() < 1e-5  # one offset for the image
    offsets = torch.stack([row[where].mean() for row, where in zip(error, inside, strict=True)])
    assert 0.045 < offsets.abs().max() <= 0.0501 and abs(offsets.mean()) < 0.012
    before = lift.depth.image()
    lift.step()
    assert torch.equal(lift.depth.image(), before)  # no new frame, no new noise

    pixels = Lift(60, offset_noise=0.0, pixel_noise=0.05)
    error = ((pixels.depth.image() - clean) * span)[inside]
    assert 0.045 < error.abs().max() <= 0.0501
    # The variance of 0.05 u (2 v - 1) with u, v ~ U(0, 1): 0.05^2 E[u^2] / 3 = 0.05^2 / 9.
    assert error.std().item() == pytest.approx(0.05 / 3.0, rel=0.1)


def test_the_mounting_angle_is_drawn_anew_for_each_episode() -> None:
    lift = Lift(80, pitch=camera.PITCH_JITTER)
    before = lift.depth.camera.pitch.clone()
    assert 0.9 * camera.PITCH_JITTER < before.abs().max() <= camera.PITCH_JITTER
    assert abs(before.mean()) < 0.2 * camera.PITCH_JITTER
    mask = torch.arange(80) < 40
    lift.depth.begin(mask)
    assert (lift.depth.camera.pitch != before).tolist() == mask.tolist()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"latency": (2, 1)}, "latency"),
        ({"latency": (-1, 0)}, "latency"),
        ({"frame_steps": 0}, "frame_steps"),
        ({"pixel_noise": -0.1}, "noise"),
    ],
)
def test_impossible_cameras(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Lift(1, **options)


# In the environment ------------------------------------------------------------------------------------------------


@pytest.fixture
def build() -> Iterator[Callable[..., AgilityEnv]]:
    made: list[AgilityEnv] = []

    def make(num_robots: int = 3, **options: Any) -> AgilityEnv:
        options = {"simulator_options": {"num_threads": 1}, "depth": {}, **options}
        made.append(AgilityEnv(num_robots, stand, **options))
        return made[-1]

    yield make
    for env in made:
        env.close(raise_if_closed=False)


def stand(td: TensorDictBase) -> TensorDictBase:
    return td.set(keys.ACTION, 0.2 * torch.sin(td[keys.HISTORY].sum((-1, -2)))[:, None].expand(-1, 12))


def run(env: AgilityEnv, steps: int, carrier: TensorDictBase | None = None) -> tuple[Tensor, TensorDictBase]:
    carrier = env.reset() if carrier is None else carrier
    images = []
    decision = {keys.BEHAVIOUR: torch.full((env.num_robots,), 2), keys.PARAMETERS: torch.zeros(env.num_robots, 5, 6)}
    for _ in range(steps):
        images.append(carrier[keys.DEPTH].clone())
        carrier = env.step_and_maybe_reset(carrier.set(keys.ACTION, TensorDict(decision, [env.num_robots])))[1]
    return torch.stack(images), carrier


def test_specs(build: Callable[..., AgilityEnv]) -> None:
    check_env_specs(build(2, depth={"latency": (1, 2)}, decision_steps=2), break_when_any_done="both", seed=0)
    assert keys.DEPTH not in build(2, depth=None).observation_spec.keys(True)


def test_threads_and_seeds_reproduce_the_images(build: Callable[..., AgilityEnv]) -> None:
    one, two = (run(build(simulator_options={"num_threads": n}, episode_length=0.1), 8)[0] for n in (1, 2))
    assert torch.equal(one, two)
    assert not torch.equal(one, run(build(seed=1, episode_length=0.1), 8)[0])


def test_a_camera_changes_nothing_else(build: Callable[..., AgilityEnv]) -> None:
    """It draws its delays from the environment's generator: nothing else is drawn in these steps."""
    options = {"command_noise": (1.0, 1.0), "episode_length": 10.0}
    with_camera, without = build(depth={**STILL, "latency": (1, 1)}, **options), build(depth=None, **options)
    positions = []
    for env in (with_camera, without):
        env.generator.manual_seed(5)
        carrier = env.reset()
        began = env.simulator.root_position.clone()
        for _ in range(5):
            carrier = env.step(carrier.update(without.action_spec.zero()))["next"]
        positions.append(env.simulator.root_position.clone())
        assert not torch.equal(began, positions[-1])
    assert torch.equal(*positions)


def test_images_are_as_old_as_control_steps_are_long(build: Callable[..., AgilityEnv]) -> None:
    ages = []
    for control_dt in (0.02, 0.01):
        env = build(depth={**STILL, "latency": (2, 2)}, simulator_options={"num_threads": 1, "control_dt": control_dt})
        carrier = env.reset()
        for _ in range(4):
            carrier = env.step(carrier.update(env.action_spec.zero()))["next"]
        ages.append(carrier[keys.IMAGE_AGE])
    torch.testing.assert_close(ages[0], 2.0 * ages[1])
    assert (ages[1] >= 0.02).all()


def test_resume_is_bit_exact(build: Callable[..., AgilityEnv]) -> None:
    options: dict[str, Any] = {"depth": {"latency": (1, 2)}, "episode_length": 0.14}
    env, other = build(**options), build(**options, seed=9)
    _, carrier = run(env, 5)
    other.reset()
    other.load_state_dict(env.state_dict())
    assert torch.equal(run(env, 6, carrier.clone())[0], run(other, 6, carrier.clone())[0])
    with pytest.raises(ValueError, match="latency"):
        build(depth={"latency": (3, 3)}).load_state_dict(env.state_dict())


def test_partial_reset_leaves_the_other_images_alone(build: Callable[..., AgilityEnv]) -> None:
    env = build(course=COURSES["full"])
    images, carrier = run(env, 3)
    before = carrier[keys.DEPTH].clone()
    mask = torch.tensor([True, False, False])
    after = env.reset(carrier.exclude(keys.ACTION).set("_reset", mask[:, None]))[keys.DEPTH]
    assert torch.equal(after[1:], before[1:])
    assert not torch.equal(after[0], before[0])
    assert images.min() >= -0.5 and images.max() <= 0.5
