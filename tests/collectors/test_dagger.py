"""The student acts, the teacher labels, memory goes on: on the real course."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from tensordict import TensorDictBase
from tensordict.nn import InteractionType, set_interaction_type
from torchrl.envs import StepCounter, TransformedEnv

from agility_rl import keys
from agility_rl.collectors import DAggerCollector
from agility_rl.envs import AgilityEnv
from agility_rl.losses import StudentLoss
from agility_rl.modules import RecurrentStudent, Teacher

N, T, M = 3, 5, 16


def sway(td: TensorDictBase) -> TensorDictBase:
    return td.set(keys.ACTION, 0.3 * torch.sin(td[keys.COMMAND].sum(-1, keepdim=True)).expand(-1, 12))


def make_env(**options: Any) -> AgilityEnv:
    options = {"depth": {"latency": (1, 2)}, "simulator_options": {"num_threads": 1}, "episode_length": 0.14, **options}
    return AgilityEnv(N, sway, **options)


@pytest.fixture
def env() -> Iterator[AgilityEnv]:
    made = make_env()
    yield made
    made.close(raise_if_closed=False)


@pytest.fixture
def teacher() -> Teacher:
    return Teacher(hidden=(32,))


@pytest.fixture
def student(teacher: Teacher) -> RecurrentStudent:
    student = RecurrentStudent.from_teacher(teacher, memory=M)
    with torch.no_grad():  # away from the teacher's actor, so that their actions differ
        student.actor.network.choice_head[0].weight.neg_()
    return student


def collector(env: AgilityEnv, student: RecurrentStudent, teacher: Teacher, **options: Any) -> DAggerCollector:
    options = {"initial_hidden": student.initial_hidden(N), **options}
    return DAggerCollector(env, student.policy(assisted=True), teacher.privileged_policy(), T, **options)


def deterministic(policy: Any, td: TensorDictBase) -> TensorDictBase:
    with set_interaction_type(InteractionType.DETERMINISTIC), torch.no_grad():
        return policy(td.clone())


@pytest.mark.parametrize(("bits", "dtype"), [(8, torch.uint8), (16, torch.int16)])
def test_what_is_stored(
    env: AgilityEnv, student: RecurrentStudent, teacher: Teacher, bits: int, dtype: torch.dtype
) -> None:
    window = collector(env, student, teacher, bits=bits).collect()
    assert window.batch_size == (T, N)
    assert window[keys.DEPTH].shape == (T, N, 58, 87) and window[keys.DEPTH].dtype == dtype
    assert window[keys.LABEL, keys.BEHAVIOUR].shape == (T, N)
    assert window[keys.LABEL, keys.PARAMETERS].shape == (T, N, 5, 6)
    assert window["next", "done"].shape == window["is_init"].shape == (T, N, 1)
    assert keys.SCANDOTS not in window.keys(True)
    loss = StudentLoss(student.policy(assisted=True, sequence=True))
    assert all(torch.isfinite(value).all() for value in loss(window.select(*loss.in_keys)).values())


def test_unrolling_a_window_gives_again_what_the_student_did(
    env: AgilityEnv, student: RecurrentStudent, teacher: Teacher
) -> None:
    gather = collector(env, student, teacher)
    begun = 0
    for _ in range(3):
        window = gather.collect()
        again = deterministic(student.policy(assisted=True, sequence=True), window.select(*gather.student.in_keys))
        assert torch.equal(again[keys.ACTION, keys.BEHAVIOUR], window[keys.ACTION, keys.BEHAVIOUR])
        torch.testing.assert_close(
            again[keys.ACTION, keys.PARAMETERS], window[keys.ACTION, keys.PARAMETERS], rtol=1e-4, atol=1e-5
        )
        begun += int(window["is_init"][1:].sum())
    assert begun > 0  # episodes ended within the windows


def test_memory_is_carried_on_between_windows_and_begins_anew_with_an_episode(
    env: AgilityEnv, student: RecurrentStudent, teacher: Teacher
) -> None:
    gather = collector(env, student, teacher)
    first, second = gather.collect(), gather.collect()
    assert first["is_init"][0].all() and first[keys.HIDDEN].abs().sum() == 0
    torch.testing.assert_close(second["is_init"][0], first["next", "done"][-1])
    again = deterministic(student.policy(assisted=True, sequence=True), first.select(*gather.student.in_keys))
    torch.testing.assert_close(second[keys.HIDDEN][0], again["memory", keys.HIDDEN][-1], rtol=1e-4, atol=1e-5)
    assert torch.equal(first["is_init"][1:], first["next", "done"][:-1])


def test_labels_are_the_teachers_on_what_the_student_met(
    env: AgilityEnv, student: RecurrentStudent, teacher: Teacher
) -> None:
    extra = [*teacher.privileged_policy().in_keys]
    window = collector(env, student, teacher, keep=[*extra, keys.OBSTACLE]).collect()
    expected = deterministic(teacher.privileged_policy(), window.select(*extra))
    assert torch.equal(window[keys.LABEL, keys.BEHAVIOUR], expected["logits"].argmax(-1))
    torch.testing.assert_close(window[keys.LABEL, keys.PARAMETERS], expected["loc"], rtol=1e-4, atol=1e-5)
    assert not torch.equal(window[keys.LABEL, keys.BEHAVIOUR], window[keys.ACTION, keys.BEHAVIOUR])


def test_continuation_is_bit_exact(student: RecurrentStudent, teacher: Teacher) -> None:
    env, other = make_env(), make_env(seed=7)
    gather, resumed = (collector(e, student, teacher) for e in (env, other))
    gather.collect()
    other.reset()
    other.load_state_dict(env.state_dict())
    resumed.load_state_dict(gather.state_dict())
    one, two = gather.collect(), resumed.collect()
    for key, value in one.items(include_nested=True, leaves_only=True):
        assert torch.equal(value, two[key]), key
    env.close()
    other.close()


def test_what_another_release_observed_is_refused(env: AgilityEnv, student: RecurrentStudent, teacher: Teacher) -> None:
    collect = collector(env, student, teacher)
    collect.collect()
    state = collect.state_dict()
    del state["carrier"]["history"]
    with pytest.raises(ValueError, match=r"the observations to go on from lack \['history'"):
        collector(env, student, teacher).load_state_dict(state)


def test_errors(env: AgilityEnv, student: RecurrentStudent, teacher: Teacher) -> None:
    blind = make_env(depth=None)
    with pytest.raises(ValueError, match=r"build it with a camera: AgilityEnv\(\.\.\., depth=\{\}\)"):
        collector(blind, student, teacher)
    blind.close()
    with pytest.raises(ValueError, match=r"initial_hidden must be \[3, M\], got \[2, 16\]"):
        collector(env, student, teacher, initial_hidden=student.initial_hidden(2))


def test_the_first_robots_may_be_led(env: AgilityEnv, student: RecurrentStudent, teacher: Teacher) -> None:
    collect = collector(env, student, teacher)
    collect.led = 2
    window = collect.collect()
    taken, told = window[keys.ACTION, keys.BEHAVIOUR], window[keys.LABEL, keys.BEHAVIOUR]
    parameters = [window[key, keys.PARAMETERS] for key in (keys.ACTION, keys.LABEL)]
    assert torch.equal(taken[:, :2], told[:, :2]) and torch.equal(parameters[0][:, :2], parameters[1][:, :2])
    assert not torch.equal(parameters[0][:, 2], parameters[1][:, 2]), "the third goes its own way"
    collect.led = 0
    window = collect.collect()
    assert not torch.equal(window[keys.ACTION, keys.PARAMETERS][:, 0], window[keys.LABEL, keys.PARAMETERS][:, 0])


def test_an_environment_that_counts_in_its_transforms(student: RecurrentStudent, teacher: Teacher) -> None:
    counted = TransformedEnv(make_env(episode_length=40.0), StepCounter())
    window = collector(counted, student, teacher, keep_next=["step_count"]).collect()
    assert window["next", "step_count"][:, 0, 0].tolist() == [1, 2, 3, 4, 5]
    counted.close()


def test_means_that_are_kept_are_the_students_own(env: AgilityEnv, student: RecurrentStudent, teacher: Teacher) -> None:
    collect = collector(env, student, teacher, keep_written=["loc"])
    collect.led = 1
    window = collect.collect()
    parameters, label = window[keys.ACTION, keys.PARAMETERS], window[keys.LABEL, keys.PARAMETERS]
    assert torch.equal(window["loc"][:, 1:], parameters[:, 1:])
    assert torch.equal(parameters[:, 0], label[:, 0]) and not torch.equal(window["loc"][:, 0], label[:, 0])
