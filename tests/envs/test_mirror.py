"""Mirror images of observations and decisions, against mirrored courses in the engine."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict

from agility_rl import behaviours, keys, rotations
from agility_rl.envs import AgilityEnv, Course, Slot
from agility_rl.envs.mirror import mirror
from agility_rl.go2 import constants
from agility_rl.go2.mirror import mirror_joints

READ = (
    *(keys.PROPRIOCEPTION, keys.EXPLICIT, keys.PRIVILEGED, keys.HISTORY, keys.MOTION, keys.COMMAND, keys.PEAK),
    *(keys.SKILL, keys.SHIFT, keys.HEADING_ERROR, keys.PLACE, keys.OBSTACLE, keys.SCANDOTS),
)
WIDTH = 4.0


def symmetric_controller(td: TensorDict) -> TensorDict:
    """Joint targets that lean on what is measured and commanded, the same in a mirror."""

    def lean(seen: TensorDict) -> torch.Tensor:
        mixed = torch.cat((seen[keys.PROPRIOCEPTION], seen[keys.COMMAND]), -1)
        return 0.2 * (mixed @ torch.linspace(-0.3, 0.3, mixed.shape[-1] * 12).reshape(-1, 12)).tanh()

    seen = td.select(keys.PROPRIOCEPTION, keys.COMMAND)
    td[keys.ACTION] = (lean(seen) + mirror_joints(lean(mirror(seen)))) / 2
    return td


def build(obstacle: str, where: float) -> AgilityEnv:
    """One robot before an obstacle beside the middle of an arena."""
    course = Course("one", (WIDTH, 8.0), (Slot(obstacle, (WIDTH / 2 + where, 4.0), yaw=torch.pi / 2),))
    return AgilityEnv(
        1,
        symmetric_controller,
        course,
        simulator_options={"num_threads": 1},
        decision_steps=5,
        command_noise=(1.0, 1.0),
    )


def put(env: AgilityEnv, side: float) -> TensorDict:
    """Stand the robot at the same place and heading, mirrored for ``side`` -1."""
    env.reset()
    env.arena.start_spread = 0.0
    td = env.reset()
    everyone, zero = torch.ones(1, dtype=torch.bool), torch.zeros(1)
    env.simulator.reset(
        everyone,
        root_position=torch.tensor([[WIDTH / 2 + side * 0.25, 1.6, constants.STANDING_HEIGHT]]),
        root_quaternion=rotations.from_euler(zero, zero, torch.tensor([torch.pi / 2 - side * 0.3])),
        root_linear_velocity=torch.tensor([[side * 0.1, 0.5, 0.0]]),
        root_angular_velocity=torch.zeros(1, 3),
        joint_position=torch.tensor([constants.DEFAULT_POSE]),
        joint_velocity=torch.zeros(1, 12),
    )
    return td


@pytest.mark.parametrize("obstacle", ["a_frame", "tunnel", "tire_jump"])
def test_a_mirrored_course_is_seen_and_walked_as_the_image_of_the_other(obstacle: str) -> None:
    """Two robots on courses that are each other's images, who decide each other's images, stay so."""
    right, left = build(obstacle, 0.1), build(obstacle, -0.1)
    one, other = put(right, 1.0), put(left, -1.0)
    generator = torch.Generator().manual_seed(3)
    for step in range(6):
        decision = TensorDict(
            {
                keys.BEHAVIOUR: torch.tensor([step % behaviours.NUM_BEHAVIOURS]),
                keys.PARAMETERS: torch.rand(1, behaviours.NUM_BEHAVIOURS, 6, generator=generator) * 2.0 - 1.0,
            },
            [1],
        )
        one[keys.ACTION] = decision
        other[keys.ACTION] = mirror(TensorDict({keys.ACTION: decision}, [1]))[keys.ACTION]
        one, other = right.step(one)["next"], left.step(other)["next"]
        image = mirror(one.select(*READ))
        for key in READ:
            apart = (image[key].float() - other[key].float()).abs()
            if key == keys.SCANDOTS:  # looked up in cells: a dot on an edge may fall to either side
                assert (apart < 5e-3).float().mean() > 0.9
            else:
                assert apart.max() < 5e-3, key
    assert one[keys.HEADING_ERROR].abs().min() > 0.05 and one[keys.SCANDOTS].abs().max() > 0.02
    right.close()
    left.close()


def test_an_image_of_an_image_is_what_was_seen() -> None:
    td = TensorDict(
        {
            keys.DEPTH: torch.rand(2, 58, 87),
            keys.SCANDOTS: torch.rand(2, 132),
            (keys.ACTION, keys.BEHAVIOUR): torch.tensor([1, 4]),
            (keys.ACTION, keys.PARAMETERS): torch.rand(2, 5, 6),
        },
        [2],
    )
    image = mirror(td)
    assert torch.equal(image[keys.DEPTH][:, :, 0], td[keys.DEPTH][:, :, -1])
    assert torch.equal(image[keys.SCANDOTS][:, :12], td[keys.SCANDOTS][:, -12:])  # the row to the right
    for key in td.keys(include_nested=True, leaves_only=True):
        assert torch.equal(mirror(image)[key], td[key])


def test_an_entry_without_an_image_is_refused() -> None:
    with pytest.raises(KeyError, match="the mirror image of 'reward' is not known"):
        mirror(TensorDict({"reward": torch.zeros(1, 1)}, [1]))
