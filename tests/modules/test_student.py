from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import InteractionType, set_interaction_type
from torch import nn

from agility_rl.modules import RecurrentStudent, Teacher

M = 16
"""Units of memory in the tests."""
WAY_POINTS = [[[x, 0.0] for x in (-1.5, -0.5, 0.5, 1.5)] for _ in range(7)]
BALL = ["sphere", [0.4], [0.0, 0.0, 0.4], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0]]


SHAPES = {"solids": [[BALL]] * 7, "stock": [1] * 7, "estimator_history": True}


@pytest.fixture(params=[(0, {}), (8, {}), (8, SHAPES)], ids=["headings only", "place", "shapes"])
def either(request: pytest.FixtureRequest) -> RecurrentStudent:
    num_place, options = request.param
    return RecurrentStudent(num_place=num_place, memory=M, way_points=WAY_POINTS, **options)


@pytest.fixture
def student() -> RecurrentStudent:
    return RecurrentStudent(memory=M)


def steps(time: int, robots: int, size: int = M) -> TensorDict:
    return TensorDict(
        {
            "depth": torch.rand(time, robots, 58, 87) - 0.5,
            "image_age": torch.full((time, robots, 1), 0.04),
            "proprioception": torch.randn(time, robots, 45),
            "history": torch.randn(time, robots, 10, 45),
            "heading_error": torch.rand(time, robots, 2) * 2.0 - 1.0,
            "progress": torch.eye(4)[torch.zeros(time, robots, dtype=torch.long)],
            "hidden": torch.randn(robots, size).expand(time, robots, size),
            "is_init": torch.zeros(time, robots, 1, dtype=torch.bool),
        },
        [time, robots],
    )


def one_by_one(student: RecurrentStudent, td: TensorDict) -> TensorDict:
    policy, hidden, rows = student.policy(assisted=True), td["hidden"][0], []
    with set_interaction_type(InteractionType.DETERMINISTIC):
        for step in td.unbind(0):
            rows.append(policy(step.clone().set("hidden", hidden)))
            hidden = rows[-1]["memory", "hidden"]
    return torch.stack(rows)


def test_sizes_are_those_of_the_supplement() -> None:
    student = RecurrentStudent()
    assert student.memory.cell.hidden_size == 512
    assert [p.shape[0] for p in student.memory.fusion.parameters() if p.dim() == 2] == [128, 32]
    assert student.memory.fusion[0].in_features == 32 + 45
    assert student.memory.head[0].out_features == 32 + 2 + 7
    placed = RecurrentStudent(num_place=8, way_points=WAY_POINTS).memory
    assert (placed.cell.input_size, placed.cell.hidden_size, placed.size) == (32, 512, 551)
    assert placed.head[0].out_features == 32 + 7 + 4 + 3 + 1


def test_a_smaller_encoder_is_built_again_from_its_settings() -> None:
    small = RecurrentStudent(memory=M, encoder_channels=(4, 3), encoder_hidden=5, encoder_features=9)
    first, _, _, second, _ = small.depth_encoder.module.convolutions
    assert (first.out_channels, second.out_channels) == (4, 3)
    assert small.depth_encoder.module.linear[1].weight.shape == (5, 3 * 25 * 39)  # 58 x 87, kernel 5, pool 2, kernel 3
    assert small.policy()(steps(1, 3)[0])["depth_feature"].shape == (3, 9)
    again = RecurrentStudent(**small.settings)
    again.load_state_dict(small.state_dict())
    with pytest.raises(RuntimeError, match="size mismatch"):
        RecurrentStudent(memory=M, encoder_hidden=5).load_state_dict(small.state_dict())


def test_shapes_and_keys(student: RecurrentStudent) -> None:
    td = student.policy()(steps(1, 3)[0].exclude("heading_error"))
    shapes = {
        "depth_feature": (32,),
        "terrain_latent": (32,),
        "heading_estimate": (2,),
        "obstacle_logits": (7,),
        ("memory", "hidden"): (M,),
        ("action", "parameters"): (5, 6),
        "logits": (5,),
    }
    for key, shape in shapes.items():
        assert td[key].shape == (3, *shape), key


def test_a_window_unrolled_is_what_single_steps_give_with_beginnings_anywhere(either: RecurrentStudent) -> None:
    student, td = either, steps(6, 4, either.memory.size)
    td["is_init"][3, 1] = td["is_init"][3, 2] = td["is_init"][5, 1] = td["is_init"][0, 0] = True
    expected = one_by_one(student, td)
    with set_interaction_type(InteractionType.DETERMINISTIC):
        unrolled = student.policy(assisted=True, sequence=True)(td.clone())
    written = [("memory", "hidden"), "terrain_latent", "heading_estimate", "obstacle_logits", "logits", "loc"]
    for key in [*written, *(["place_estimate"] if student.settings["num_place"] else [])]:
        torch.testing.assert_close(unrolled[key], expected[key], rtol=1e-4, atol=1e-5)


def test_what_was_matched_when_it_was_seen_stands_for_the_images() -> None:
    student = RecurrentStudent(num_place=8, memory=M, way_points=WAY_POINTS, solids=[[BALL]] * 7)
    seen = student.policy(sequence=True)(steps(3, 4, student.memory.size))
    again = student.policy(sequence=True, seen=True)(seen.select(*student.policy(seen=True).in_keys).clone())
    for key in ("place_estimate", "logits", ("memory", "hidden")):
        torch.testing.assert_close(again[key], seen[key])
    seen["scan_match"][..., :2] += 0.3
    seen["scan_match"][..., 4:7] = 1e-3
    moved = student.policy(sequence=True, seen=True)(seen.select(*student.policy(seen=True).in_keys).clone())
    assert not torch.allclose(moved["place_estimate"], again["place_estimate"], atol=0.05)


def test_an_episode_does_not_remember_the_one_before_it(either: RecurrentStudent) -> None:
    student, td = either, steps(4, 2, either.memory.size)
    td["is_init"][2, 0] = True
    other = td.clone()
    other["depth"][:2] = torch.rand(2, 2, 58, 87) - 0.5
    one, two = (student.policy(sequence=True)(x)["memory", "hidden"] for x in (td.clone(), other))
    torch.testing.assert_close(one[2:, 0], two[2:, 0])
    assert not torch.allclose(one[2:, 1], two[2:, 1], atol=1e-6)
    assert not torch.allclose(one[:2], two[:2], atol=1e-6)


def test_a_new_episode_begins_with_the_initial_memory(either: RecurrentStudent) -> None:
    student, td = either, steps(1, 3, either.memory.size)[0]
    fresh = td.clone().set("hidden", student.initial_hidden(3))
    td["is_init"] = torch.ones(3, 1, dtype=torch.bool)
    policy = student.policy()
    torch.testing.assert_close(policy(td)["memory", "hidden"], policy(fresh)["memory", "hidden"])


def test_headings_beyond_the_gate_are_given_in_training_only(student: RecurrentStudent) -> None:
    td = steps(1, 200)[0]
    assisted, alone = student.policy(assisted=True)(td.clone()), student.policy()(td.clone())
    truth, estimate = td["heading_error"], assisted["heading_estimate"]
    used = assisted["perceived", "heading_error"]
    far = truth.abs() >= 0.6
    assert far.any() and (~far).any()
    assert torch.equal(used[far], truth[far]) and torch.equal(used[~far], estimate[~far])
    assert torch.equal(alone["perceived", "heading_error"], alone["heading_estimate"])
    assert "heading_error" not in student.policy().in_keys


def test_the_actor_reads_the_likeliest_obstacle(student: RecurrentStudent) -> None:
    td = student.policy()(steps(1, 50)[0])
    expected = nn.functional.one_hot(td["obstacle_logits"].argmax(-1), 7).float()
    assert torch.equal(td["perceived", "obstacle"], expected)


def test_factor_on_the_headings(student: RecurrentStudent) -> None:
    with torch.no_grad():
        student.memory.head[0].weight.zero_()
        student.memory.head[0].bias.fill_(0.4)
    td = student.policy()(steps(1, 2)[0])
    torch.testing.assert_close(td["heading_estimate"], torch.full((2, 2), 0.6))
    torch.testing.assert_close(td["terrain_latent"], torch.full((2, 32), 0.4).tanh())


def test_from_a_teacher() -> None:
    teacher = Teacher(hidden=(32, 16), allowed=[1, 2])
    student = RecurrentStudent.from_teacher(teacher, memory=M)
    assert student.settings["memory"] == M and student.settings["allowed"] == [1, 2]
    for name in ("actor", "estimator", "history_encoder"):
        mine, its = getattr(student, name), getattr(teacher, name)
        assert all(torch.equal(a, b) for a, b in zip(mine.parameters(), its.parameters(), strict=True))
        assert not {id(p) for p in mine.parameters()} & {id(p) for p in its.parameters()}
    own = RecurrentStudent.from_teacher(teacher, memory=M, estimator_history=True)
    assert all(torch.equal(a, b) for a, b in zip(own.actor.parameters(), teacher.actor.parameters(), strict=True))
    assert own.estimator.in_keys == ["history"] and next(own.estimator.parameters()).shape == (128, 10 * 45)
    # Knowing what the teacher knows, its actor does what the teacher's does.
    td = steps(1, 3)[0].update({"obstacle": torch.eye(7)[:3], "scandots": torch.randn(3, 132)})
    with set_interaction_type(InteractionType.DETERMINISTIC):
        expected = teacher.deployable_policy()(td.clone())
        known = td.update({"perceived": {"heading_error": td["heading_error"], "obstacle": td["obstacle"]}})
        known.update(expected.select("terrain_latent", "estimate", "latent"))
        torch.testing.assert_close(student.actor(known)["loc"], expected["loc"])


def test_from_a_teacher_that_reads_its_place() -> None:
    """The student guesses the place, and does what the teacher does where the guess is right."""
    teacher = Teacher(hidden=(32, 16), num_place=8)
    student = RecurrentStudent.from_teacher(teacher, memory=M, way_points=WAY_POINTS)
    assert student.settings["num_place"] == 8 and "place" not in student.policy(assisted=True).in_keys
    td = steps(1, 3, student.memory.size)[0].update({"obstacle": torch.eye(7)[:3], "scandots": torch.randn(3, 132)})
    seen = student.policy()(td.clone())
    assert torch.equal(seen["perceived", "place"], seen["place_estimate"]) and seen["place_estimate"].shape == (3, 8)
    with set_interaction_type(InteractionType.DETERMINISTIC):
        expected = teacher.deployable_policy()(td.clone().set("place", seen["place_estimate"].detach()))
        known = td.update({"perceived": {"heading_error": td["heading_error"], "obstacle": td["obstacle"]}})
        known["perceived", "place"] = seen["place_estimate"]
        known.update(expected.select("terrain_latent", "estimate", "latent"))
        torch.testing.assert_close(student.actor(known)["loc"], expected["loc"])
        known["perceived", "place"] = known["perceived", "place"] + 1.0
        assert not torch.allclose(student.actor(known)["loc"], expected["loc"])


def test_who_infers_a_place_knows_the_obstacles() -> None:
    with pytest.raises(ValueError, match="expected way_points of 7 types of obstacles, got 0"):
        RecurrentStudent(num_place=8)
    with pytest.raises(ValueError, match="expected solids of 7 types of obstacles, got 1"):
        RecurrentStudent(num_place=8, way_points=WAY_POINTS, solids=[[BALL]])
    with pytest.raises(ValueError, match="expected stock of 7 types of obstacles, got 2"):
        RecurrentStudent(num_place=8, way_points=WAY_POINTS, stock=[1, 1])
    with pytest.raises(ValueError, match="num_place must be 0 or 8, got 3"):
        RecurrentStudent(num_place=3)


def test_imitation_does_not_push_the_place() -> None:
    student = RecurrentStudent(
        memory=M, num_place=8, way_points=WAY_POINTS, routes=[[[2.0, 3.0, 1.5], [2.0, 7.0, 1.5]]]
    )
    torch.nn.init.normal_(student.memory.glance.correction[-1].weight)
    td = student.policy(sequence=True)(steps(3, 2, student.memory.size))
    td["loc"].sum().backward(retain_graph=True)
    assert student.memory.head[0].weight.grad[32:].abs().sum() == 0
    td["place_estimate"].sum().backward(retain_graph=True)
    pushed = (student.memory.head[0].weight.grad[39:].abs().sum(1) > 0).tolist()
    # How many images count as one; the likeliest way-point is no matter of degree.
    assert pushed == [False] * 8 + [True] * 3 + [False]
    td["progress_logits"][..., 0].sum().backward()
    assert (student.memory.head[0].weight.grad[39:].abs().sum(1) > 0).all()
    assert not td["heading_estimate"].requires_grad


def test_gradients(student: RecurrentStudent) -> None:
    td = student.policy(sequence=True)(steps(3, 2))
    td["loc"].sum().backward(retain_graph=True)
    head = student.memory.head[0].weight.grad
    assert head[:32].abs().sum() > 0 and head[32:].abs().sum() == 0  # by the latent, not by what it perceives
    assert all(p.grad.abs().sum() > 0 for p in student.depth_encoder.parameters())
    assert student.memory.cell.weight_hh_l0.grad.abs().sum() > 0
    (td["heading_estimate"].sum() + td["obstacle_logits"].square().sum()).backward()
    assert student.memory.head[0].weight.grad[32:].abs().sum() > 0


def test_policies_share_the_parameters_and_hold_all_of_them(student: RecurrentStudent) -> None:
    own = {id(p) for p in student.parameters()}
    for sequence in (False, True):
        assert {id(p) for p in student.policy(sequence=sequence).parameters()} == own
    rebuilt = RecurrentStudent(**student.settings)
    rebuilt.load_state_dict(student.state_dict())
    td = steps(1, 2)[0]
    torch.testing.assert_close(rebuilt.policy()(td.clone())["loc"], student.policy()(td.clone())["loc"])
