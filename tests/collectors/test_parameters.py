from __future__ import annotations

import math

import pytest
import torch

from agility_rl.collectors import GAINS, Parameter, ParameterSpace
from agility_rl.collectors.parameters import NOMINAL_FIELDS
from agility_rl.go2 import constants
from agility_rl.simulation import PARAMETERS, BatchSimulator

EVERYTHING = (
    *GAINS,
    "joint_damping",
    "armature",
    "hip_friction_loss",
    "thigh_torque_limit",
    "ground_friction",
    "trunk_mass_offset",
    "trunk_com_offset_x",
    "action_delay",
)


def test_the_six_gains_of_the_paper_are_the_default() -> None:
    space = ParameterSpace()
    assert space.names == (
        "hip_stiffness",
        "hip_damping",
        "thigh_stiffness",
        "thigh_damping",
        "calf_stiffness",
        "calf_damping",
    )
    assert space.nominal.tolist() == [40.0, 1.0] * 3
    assert space.low.tolist() == pytest.approx([40 / 3, 1 / 3] * 3)
    assert space.high.tolist() == pytest.approx([120.0, 3.0] * 3)


def test_nominal_fields_are_those_of_the_model() -> None:
    simulator = BatchSimulator(1, num_threads=1)
    assert set(NOMINAL_FIELDS) == set(PARAMETERS)
    for name, value in NOMINAL_FIELDS.items():
        torch.testing.assert_close(simulator.parameter(name)[0], torch.tensor(value))


def test_scales_by_hand() -> None:
    space = ParameterSpace(["hip_stiffness", Parameter.named("hip_damping", scale="linear"), "trunk_mass_offset"])
    values = space.denormalize(torch.tensor([[0.5, 0.5, 0.5], [1.0, 0.0, 1.0], [0.0, 1.0, 0.0]]))
    assert values[0].tolist() == pytest.approx([40.0, (1 / 3 + 3) / 2, 1.0])
    assert values[1].tolist() == pytest.approx([120.0, 1 / 3, 3.0])
    assert values[2].tolist() == pytest.approx([40 / 3, 3.0, -1.0])


def test_vectors_may_leave_the_first_range_as_far_as_physics_allows() -> None:
    space = ParameterSpace(["hip_stiffness", Parameter.named("hip_damping", scale="linear"), "action_delay"])
    values = space.denormalize(torch.tensor([[1.5, -1.0, 2.0], [-1.0, 2.0, -0.5]]))
    assert values[0].tolist() == pytest.approx([40 / 3 * 9**1.5, 0.0, constants.CONTROL_DT])
    assert values[1].tolist() == pytest.approx([40 / 27, 3.0 + 8 / 3, 0.0])
    lower, upper = space.limits
    assert lower.tolist() == pytest.approx([-math.inf, -1 / 8, 0.0])
    assert upper.tolist() == [math.inf, math.inf, 1.0]


def test_round_trips() -> None:
    space = ParameterSpace(EVERYTHING)
    vectors = torch.rand(7, len(space), dtype=torch.float64)
    values = space.denormalize(vectors)
    torch.testing.assert_close(space.normalize(values), vectors)
    torch.testing.assert_close(space.values(space.fields(values)), values, rtol=1e-6, atol=1e-7)
    assert space.values(space.fields(values.unflatten(0, (7, 1)))).shape == (7, 1, len(space))


def test_fields_reach_the_right_joints_and_leave_the_others() -> None:
    space = ParameterSpace(["thigh_damping", "armature"], base={"damping": [0.5] * 12})
    fields = space.fields(torch.tensor([[7.0, 0.02]]))
    assert fields["damping"][0].tolist() == [0.5, 7.0, 0.5] * 4
    assert fields["armature"][0].tolist() == pytest.approx([0.02] * 12)
    assert set(fields) == {"damping", "armature"}


def test_a_simulator_takes_every_field_and_gives_it_back() -> None:
    space, simulator = ParameterSpace(EVERYTHING), BatchSimulator(3, num_threads=1)
    values = space.denormalize(torch.rand(3, len(space)))
    simulator.set_parameters(torch.ones(3, dtype=torch.bool), **space.fields(values))
    fields = {parameter.field: simulator.parameter(parameter.field) for parameter in space.parameters}
    torch.testing.assert_close(space.values(fields), values, rtol=1e-6, atol=1e-7)
    simulator.step(torch.tensor(constants.DEFAULT_POSE).expand(3, 12))
    assert not simulator.unstable.any()


def test_another_first_range() -> None:
    space = ParameterSpace(["hip_stiffness"]).narrowed([30.0], [60.0])
    assert space.denormalize(torch.tensor([[0.0], [1.0]]))[:, 0].tolist() == pytest.approx([30.0, 60.0])
    assert ParameterSpace(["hip_stiffness"], span=2.0).high.tolist() == [80.0]


def test_units() -> None:
    assert ParameterSpace(["ground_friction", "action_delay", "armature"]).units == ("1", "s", "kg m^2")


def test_errors() -> None:
    with pytest.raises(ValueError, match="unknown parameter 'tail_length'"):
        ParameterSpace(["tail_length"])
    with pytest.raises(ValueError, match="hip_torque_limit, thigh_torque_limit"):
        Parameter.named("torque_limit")
    with pytest.raises(ValueError, match="set the same joints"):
        ParameterSpace(["stiffness", "hip_stiffness"])
    with pytest.raises(ValueError, match="at least one"):
        ParameterSpace([])
    with pytest.raises(ValueError, match="minimum <= low < high"):
        Parameter.named("hip_stiffness", low=200.0)
    with pytest.raises(ValueError, match="logarithmic scale needs low > 0"):
        Parameter.named("action_delay", scale="log")
    with pytest.raises(ValueError, match="unknown field 'mass'"):
        Parameter("m", "mass", (0,), 1.0, 0.5, 2.0)
    with pytest.raises(ValueError, match="has 1 entries"):
        Parameter("m", "ground_friction", (1,), 1.0, 0.5, 2.0)
    with pytest.raises(ValueError, match="scale must be"):
        Parameter.named("armature", scale="cubic")
    with pytest.raises(ValueError, match=r"expected \[\*B, 6\]"):
        ParameterSpace().denormalize(torch.zeros(2, 5))
    with pytest.raises(ValueError, match="differs between its joints"):
        ParameterSpace(["stiffness"]).values({"stiffness": torch.arange(12.0)[None]})
    with pytest.raises(ValueError, match="base stiffness"):
        ParameterSpace(base={"stiffness": torch.zeros(3)})
