"""The rhythm reward: known swings of the feet, its limits and invariances, and its memory."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from agility_rl.envs.rewards import rhythm
from agility_rl.envs.rhythm import MEMORY, REST, SHARPNESS, STANCE_WIDTH, Rhythm
from agility_rl.envs.state import LocomotionState
from agility_rl.go2 import constants, kinematics

TROT, PACE = torch.tensor([0.0, 0.5, 0.5, 0.0]), torch.tensor([0.0, 0.5, 0.0, 0.5])
STANDING = torch.tensor([[0.0], [1000.0]])
"""A trunk that stands and is said to be fast: no foot goes forward at half of that, each stands all of the time."""
GALLOP = torch.tensor([0.0, 0.15, 0.5, 0.62])


def pattern_of(
    ahead: Tensor, frequency: float, growth: float = 0.0, share: float = 1.0, duty: float = 1.0
) -> TensorDict:
    """That of feet which are so many strides ahead at 1 m/s, for all behaviours."""
    pairs = [(ahead[i] - ahead[j]).item() for i, j in constants.FOOT_PAIRS]
    image = ahead[[1, 0, 3, 2]]
    turned = [(image[i] - image[j]).item() for i, j in constants.FOOT_PAIRS]
    phases = {"phase": torch.tensor([pairs] * 5), "mirrored_phase": torch.tensor([turned] * 5)}
    figures = {"frequency": frequency, "speed": 1.0, "growth": growth, "duty": duty, "share": share}
    return TensorDict({name: torch.full((5,), value) for name, value in figures.items()} | phases, [5])


def heard(
    ahead: Tensor,
    frequency: float,
    pattern: TensorDict,
    amplitude: float = 0.1,
    seconds: float = 8.0,
    offset: float = 0.0,
    speed: float = 1.0,
) -> float:
    """Mean over the last two seconds of feet that swing so."""
    memory, skill, values = Rhythm(1, pattern), torch.tensor([2]), []
    told = torch.tensor([speed])
    for step in range(round(seconds / 0.02)):
        angle = 2.0 * math.pi * (frequency * 0.02 * step + ahead)
        values.append(memory.hear(offset + amplitude * torch.cos(angle)[None], STANDING, skill, told, 0.02))
    return float(torch.cat(values[-100:]).mean())


@pytest.mark.parametrize("ahead", [TROT, PACE, GALLOP])
def test_a_pattern_that_is_followed_is_worth_about_one_and_so_is_its_mirror_image(ahead: Tensor) -> None:
    pattern = pattern_of(ahead, 2.0)
    right = heard(ahead, 2.0, pattern)
    assert right > 0.85
    assert heard(ahead[[1, 0, 3, 2]], 2.0, pattern) == pytest.approx(right, abs=0.02)


def test_where_the_feet_swing_about_and_how_far_does_not_count() -> None:
    pattern = pattern_of(TROT, 2.0)
    right = heard(TROT, 2.0, pattern)
    assert heard(TROT, 2.0, pattern, offset=0.2, seconds=12.0) == pytest.approx(right, abs=0.02)
    assert heard(TROT, 2.0, pattern, amplitude=0.2) == pytest.approx(right, abs=0.05)
    trembling = 1e-3**2 / (1e-3**2 + 2.0 * REST**2)  # power of a sine beside the threshold's
    assert heard(TROT, 2.0, pattern, amplitude=1e-3) == pytest.approx(trembling * right, rel=0.1)


@pytest.mark.parametrize("detuned", [0.25, 0.5, 1.0])
def test_a_wrong_stride_frequency_loses_what_a_resonator_loses(detuned: float) -> None:
    """Power of a first-order resonator, 1 / (1 + (2 pi m d)^2); its answer to negative frequencies blurs it."""
    expected = 1.0 / (1.0 + (2.0 * math.pi * MEMORY * detuned) ** 2)
    pattern = pattern_of(TROT, 1.5)
    assert heard(TROT, 1.5 * (1.0 + detuned), pattern) == pytest.approx(expected, abs=0.08)


def test_the_stride_frequency_grows_with_the_commanded_speed_and_is_never_less_than_half() -> None:
    pattern = pattern_of(TROT, 1.0, growth=1.5)
    right = heard(TROT, 1.0, pattern)
    assert heard(TROT, 2.5, pattern, speed=2.0) == pytest.approx(right, abs=0.05)
    assert heard(TROT, 2.5, pattern, speed=1.0) < 0.3 * right
    assert heard(TROT, 0.5, pattern, speed=0.0, seconds=16.0) == pytest.approx(right, abs=0.05)


def test_motion_counts_beside_what_a_sine_is_of_the_dogs() -> None:
    """Half of the power in the third harmonic: half, and more where the dogs' motion is no sine either."""
    skill, speed, values = torch.zeros(1, dtype=torch.int64), torch.ones(1), []
    for share in (1.0, 0.75, 0.2):
        memory, last = Rhythm(1, pattern_of(TROT, 2.0, share=share)), []
        for step in range(400):
            angle = 2.0 * math.pi * (2.0 * 0.02 * step + TROT)
            last.append(memory.hear(0.2 * (angle.cos() + (3.0 * angle).cos())[None], STANDING, skill, speed, 0.02))
        values.append(float(torch.cat(last[-100:]).mean()))
    assert values[0] == pytest.approx(0.5, abs=0.06)
    assert values[1] == pytest.approx(values[0] / 0.75, abs=0.03)
    assert 0.9 < values[2] <= 1.0


@pytest.mark.parametrize(("duty", "longer"), [(0.7, 0.0), (0.6, 0.0), (0.45, 0.0), (0.6, 0.1), (0.4, 0.2)])
def test_feet_that_stand_too_long_or_too_short_lose_by_a_bell_curve(duty: float, longer: float) -> None:
    """A foot that goes back at the trunk's speed stands; of each stride here 0.7, saw teeth at 1 m/s."""
    skill, speed, values = torch.zeros(1, dtype=torch.int64), torch.ones(1), []
    for usual, more in ((0.7, 0.0), (duty, longer)):
        memory, last = Rhythm(1, pattern_of(TROT, 2.0, share=0.5, duty=usual)), []
        memory.longer_stance[0] = more
        for step in range(2000):
            phase = torch.remainder(2.0 * 0.004 * step + TROT, 1.0)
            swing = torch.where(phase < 0.7, 0.175 - 0.5 * phase, -0.175 + 0.35 * (phase - 0.7) / 0.3)
            last.append(memory.hear(swing[None], torch.ones(2, 1), skill, speed, 0.004))
        values.append(float(torch.cat(last[-500:]).mean()))
    miss = (0.7 - duty - longer) / STANCE_WIDTH
    assert values[1] / values[0] == pytest.approx(math.exp(-(miss**2)), abs=0.05)


def test_feet_out_of_phase_lose_their_pairs() -> None:
    """A pair aside by d counts exp(8 (cos 2 pi d - 1)); of a pace and a trot, the front and the hind pair agree."""
    pattern = pattern_of(TROT, 2.0)
    assert heard(PACE, 2.0, pattern) == pytest.approx(2.0 / 6.0 * heard(TROT, 2.0, pattern), abs=0.03)
    late = TROT + torch.tensor([0.1, 0.0, 0.1, 0.0])  # left feet: four of the six pairs are aside
    lost = math.exp(SHARPNESS * (math.cos(0.2 * math.pi) - 1.0))
    assert heard(late, 2.0, pattern) == pytest.approx((2.0 + 4.0 * lost) / 6.0 * heard(TROT, 2.0, pattern), abs=0.05)


def test_an_emphasis_multiplies_its_behaviour_alone() -> None:
    usual, louder = Rhythm(2, pattern_of(TROT, 2.0)), Rhythm(2, pattern_of(TROT, 2.0))
    louder.emphasis[0] = 2.5
    skill, speed = torch.tensor([0, 2]), torch.ones(2)
    for step in range(100):
        swing = torch.cos(2.0 * math.pi * (2.0 * 0.02 * step + TROT)).expand(2, 4)
        both = [memory.hear(swing, STANDING.expand(2, 2), skill, speed, 0.02) for memory in (usual, louder)]
    torch.testing.assert_close(both[1] / both[0], torch.tensor([2.5, 1.0]))


def test_robots_are_heard_apart_and_a_new_episode_knows_nothing_of_the_last() -> None:
    pattern, skill, speed = pattern_of(TROT, 2.0), torch.zeros(2, dtype=torch.int64), torch.ones(2)
    memory, alone = Rhythm(2, pattern), Rhythm(1, pattern)
    for step in range(150):
        angle = 2.0 * math.pi * (2.0 * 0.02 * step + torch.stack((TROT, PACE)))
        if step == 100:
            memory.begin(torch.tensor([False, True]))
            alone = Rhythm(1, pattern)
        both = memory.hear(torch.cos(angle), STANDING.expand(2, 2), skill, speed, 0.02)
        single = alone.hear(torch.cos(angle[1:]), STANDING, skill[1:], speed[1:], 0.02)
    torch.testing.assert_close(both[1:], single)
    assert both[0] > 0.8


def test_a_saved_memory_goes_on_exactly() -> None:
    pattern, skill, speed = pattern_of(GALLOP, 2.0), torch.zeros(1, dtype=torch.int64), torch.ones(1)
    one, other = Rhythm(1, pattern), Rhythm(1, pattern)
    positions = torch.randn(40, 1, 4, generator=torch.Generator().manual_seed(0))
    for position in positions[:20]:
        one.hear(position, STANDING, skill, speed, 0.02)
    other.load_state_dict(one.state_dict())
    for position in positions[20:]:
        assert torch.equal(
            one.hear(position, STANDING, skill, speed, 0.02), other.hear(position, STANDING, skill, speed, 0.02)
        )


def test_the_feet_are_those_of_the_joints_in_a_level_frame(neutral: Callable[..., LocomotionState]) -> None:
    pattern, skill = pattern_of(TROT, 2.0, growth=1.0), torch.zeros(1, dtype=torch.int64)
    joints, hands = Rhythm(1, pattern), Rhythm(1, pattern)
    pose = torch.tensor(constants.DEFAULT_POSE)
    for step in range(60):
        swing = (
            0.4
            * torch.cos(2.0 * math.pi * (2.0 * 0.02 * step + TROT)).repeat_interleave(3)
            * torch.tensor([0, 1, 0] * 4)
        )
        pitch = torch.full((1,), 0.1 * math.sin(0.3 * step))
        told = {"command": torch.tensor([[0.3, -0.4, 1.0, 0.0, 0.3]])}
        goes = {"linear_velocity": torch.tensor([[0.4, 9.0, 9.0]]), "mean_velocity": torch.tensor([[0.6, 9.0, 9.0]])}
        state = neutral(1, joint_position=(pose + swing)[None], pitch=pitch, **told, **goes)
        turn = torch.tensor([[pitch.cos(), 0.0, pitch.sin()], [0.0, 1.0, 0.0], [-pitch.sin(), 0.0, pitch.cos()]])
        level = kinematics.forward(pose + swing) @ turn.T
        forward, speed = torch.tensor([[0.4], [0.6]]), torch.tensor([0.5])
        by_hand = hands.hear(level[None, :, 0], forward, skill, speed, state.dt)
        torch.testing.assert_close(joints.update(state, skill), by_hand)
    assert torch.equal(rhythm(neutral(1, rhythm=torch.tensor([0.3]))), torch.tensor([0.3]))
