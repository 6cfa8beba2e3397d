"""Looks, and nothing but looks."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from agility_rl.go2.appearance import BONE_GROUP, VISIBLE_GROUP, dress
from agility_rl.go2.model import ROBOT_GROUP, build_spec


@pytest.mark.parametrize("heights", [None, np.zeros((4, 4))], ids=["plane", "height field"])
def test_a_dressed_robot_moves_as_a_bare_one(heights: np.ndarray | None) -> None:
    bare, dressed = build_spec(heights=heights).compile(), dress(build_spec(heights=heights)).compile()
    assert (bare.geom_group == ROBOT_GROUP).any() and set(dressed.geom_group) == {VISIBLE_GROUP, BONE_GROUP}
    np.testing.assert_array_equal(dressed.body_inertia, bare.body_inertia)
    assert dressed.geom_rgba[:, 3].min() == 1.0
    ends = []
    for model in (bare, dressed):
        data = mujoco.MjData(model)
        data.qpos[2] += 0.1
        mujoco.mj_step(model, data, 100)
        ends.append(data.qpos.copy())
    np.testing.assert_array_equal(ends[0], ends[1])


def test_there_are_a_sky_a_light_and_a_floor_that_shows_motion() -> None:
    model = dress(build_spec()).compile()
    assert model.nlight >= 1
    assert {int(kind) for kind in model.tex_type} == {
        int(mujoco.mjtTexture.mjTEXTURE_SKYBOX),
        int(mujoco.mjtTexture.mjTEXTURE_2D),
    }
    assert model.geom("floor").matid[0] == model.material("floor").id


def test_what_a_skin_hides_stays_hidden() -> None:
    spec = build_spec()
    spec.geom("trunk").rgba = (1.0, 1.0, 1.0, 0.0)
    model = dress(spec).compile()
    assert model.geom("trunk").group[0] == ROBOT_GROUP
