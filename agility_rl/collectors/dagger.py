"""DAgger: the student acts, the teacher says what it would have done."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import InteractionType, TensorDictModuleBase, set_interaction_type
from torch import Tensor
from torchrl.envs import EnvBase

from agility_rl.go2.camera import quantize
from agility_rl.keys import ACTION, DEPTH, HEADING_ERROR, HIDDEN, LABEL, OBSTACLE


class DAggerCollector:
    """Windows of consecutive steps that a recurrent student has taken, with the action of a teacher beside each.

    Both act deterministically and without gradients. The student's memory goes on from window to window, and begins
    anew with an episode: ``is_init`` says where, so that unrolling a window from its first ``hidden`` gives again what
    the student thought. Images are stored in 8 or 16 bits, and the student acts on what is stored.

    Source: supplement, Algorithm S3, lines 8 to 12; 24 steps: method notes, section 5.9; Ross et al. 2011,
    arXiv:1011.0686.

    Args:
        env: batched environment, ``batch_size == [N]``.
        student: one step of a policy; reads observations, ``hidden`` and ``is_init``, writes an action and the next
            memory, such as ``RecurrentStudent.policy(assisted=True)``.
        teacher: policy on the same observations, such as ``Teacher.privileged_policy()``.
        num_steps: T.
        initial_hidden: memory of a student that has not seen anything, ``[N, M]``.
        bits: how images are stored.
        keep: observations to store beside those that the student reads.
        keep_next: entries of the next state to store beside the three done flags.
        keep_written: entries that the student writes to store, such as ``depth_feature``.
        depth_key: key of the images; ``None`` where there are none.
        hidden_key: key of the memory that the student reads.
        next_hidden_key: key of the memory that it writes.
        action_key: key of the actions.
        label_key: where the teacher's action is stored.

    Attributes:
        led: so many robots, the first ones, do what the teacher says; a beginner by itself would see little but its own
            falls. Ross et al. mix the policies likewise (their beta).

    Raises:
        ValueError: if the environment has no batch dimension or no images, the memory has another number of rows, there
            is no step, or the teacher reads an entry that the environment does not have.

    Example:
        >>> from tensordict.nn import TensorDictModule
        >>> from agility_rl.envs import AgilityEnv
        >>> from agility_rl.modules import RecurrentStudent, Teacher
        >>> env = AgilityEnv(2, lambda td: td.set("action", torch.zeros(2, 12)), depth={},
        ...     simulator_options={"num_threads": 1})
        >>> teacher = Teacher()
        >>> student = RecurrentStudent.from_teacher(teacher, memory=16)
        >>> collector = DAggerCollector(env, student.policy(assisted=True), teacher.privileged_policy(), 3,
        ...     initial_hidden=student.initial_hidden(2))
        >>> window = collector.collect()
        >>> window["depth"].shape, window["depth"].dtype, window["label", "behaviour"].shape
        (torch.Size([3, 2, 58, 87]), torch.uint8, torch.Size([3, 2]))
        >>> env.close()
    """

    def __init__(
        self,
        env: EnvBase,
        student: TensorDictModuleBase,
        teacher: TensorDictModuleBase,
        num_steps: int,
        *,
        initial_hidden: Tensor,
        bits: Literal[8, 16] = 8,
        keep: Sequence[NestedKey] = (HEADING_ERROR, OBSTACLE),
        keep_next: Sequence[NestedKey] = ("reward",),
        keep_written: Sequence[NestedKey] = (),
        depth_key: NestedKey | None = DEPTH,
        hidden_key: NestedKey = HIDDEN,
        next_hidden_key: NestedKey = ("memory", HIDDEN),
        action_key: NestedKey = ACTION,
        label_key: NestedKey = LABEL,
    ) -> None:
        if len(env.batch_size) != 1:
            raise ValueError(f"expected an environment with batch_size [N], got {list(env.batch_size)}")
        if num_steps < 1:
            raise ValueError(f"num_steps must be at least 1, got {num_steps}")
        if len(initial_hidden) != env.batch_size[0]:
            raise ValueError(f"initial_hidden must be [{env.batch_size[0]}, M], got {list(initial_hidden.shape)}")
        observed = set(env.observation_spec.keys(True, True))
        if depth_key is not None and depth_key not in observed:
            raise ValueError(
                f"the environment writes no images under {depth_key!r}; build it with a camera: "
                "AgilityEnv(..., depth={})"
            )
        if missing := [key for key in teacher.in_keys if key not in observed]:
            raise ValueError(f"the teacher reads {missing}, which the environment does not write")
        self.env, self.student, self.teacher = env, student, teacher
        self.num_steps, self.bits = num_steps, bits
        self._own = {hidden_key, "is_init"}
        if missing := [key for key in student.in_keys if key not in observed | self._own]:
            raise ValueError(f"the student reads {missing}, which the environment does not write")
        self.keep = [*dict.fromkeys([*(key for key in student.in_keys if key != hidden_key), *keep])]
        self.keep_written = list(keep_written)
        self.keep_next = [*keep_next, "done", "terminated", "truncated"]
        self.depth_key, self.hidden_key, self.next_hidden_key = depth_key, hidden_key, next_hidden_key
        self.action_key, self.label_key = action_key, label_key
        self.led = 0
        self._initial_hidden = initial_hidden.detach().clone()
        self._carrier: TensorDictBase | None = None

    @torch.no_grad()
    def collect(self) -> TensorDictBase:
        """Go on for T steps from where the last call ended.

        Returns:
            TensorDict ``[T, N]``: the kept observations, ``is_init`` bool [T, N, 1], ``hidden`` [T, N, M], which is the
            memory before the first step at every step and takes memory once, the ``action`` taken, the teacher's
            ``label``, and ``("next", ...)``.
        """
        carrier = self._begin() if self._carrier is None else self._carrier
        hidden = carrier.get(self.hidden_key)
        rows = []
        for _ in range(self.num_steps):
            with set_interaction_type(InteractionType.DETERMINISTIC):
                acting = self.student(carrier.select(*self.student.in_keys))
                label = self.teacher(carrier.select(*self.teacher.in_keys)).get(self.action_key)
            row = carrier.select(*self.keep).update(acting.select(*self.keep_written))
            action, label = _decision(acting.get(self.action_key)), _decision(label)
            if self.led:
                action = action.clone()  # a mean that is kept may be the same memory
                action[: self.led] = label[: self.led]
            row.set(self.action_key, action)
            row.set(self.label_key, label)
            # Whatever else the environment has written, since its transforms may count in it.
            before = carrier.exclude(*self._own).set(self.action_key, action.clone())
            full, upcoming = self.env.step_and_maybe_reset(before)
            row.set("next", full.get("next").select(*self.keep_next))
            rows.append(row)
            carrier = self._carry(upcoming, acting.get(self.next_hidden_key), full.get(("next", "done")))
        self._carrier = carrier
        window: TensorDictBase = torch.stack(rows)  # type: ignore[arg-type, assignment]
        return window.set(self.hidden_key, hidden.expand(self.num_steps, *hidden.shape))

    def _begin(self) -> TensorDictBase:
        first = torch.ones(len(self._initial_hidden), 1, dtype=torch.bool, device=self._initial_hidden.device)
        return self._carry(self.env.reset(), self._initial_hidden, first)

    def _carry(self, observation: TensorDictBase, hidden: Tensor, is_init: Tensor) -> TensorDictBase:
        carrier = observation.exclude(self.action_key).set(self.hidden_key, hidden).set("is_init", is_init)
        if self.depth_key is not None:
            carrier.set(self.depth_key, quantize(observation.get(self.depth_key), self.bits))
        return carrier

    def state_dict(self) -> dict[str, Any]:
        """The observations and memories from which the next call goes on, as nested dicts of tensors."""
        return {} if self._carrier is None else {"carrier": self._carrier.clone().to_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned.

        Raises:
            ValueError: if student or teacher read what was not observed then.
        """
        carrier = state.get("carrier")
        if carrier is not None:
            carrier = TensorDict(carrier, self.env.batch_size)
            if missing := [
                key for key in (*self.student.in_keys, *self.teacher.in_keys) if key not in carrier.keys(True)
            ]:
                raise ValueError(
                    f"the observations to go on from lack {missing}: another release wrote them; begin a new run that "
                    "starts from the student of this one"
                )
        self._carrier = carrier


def _decision(action: TensorDictBase | Tensor) -> TensorDictBase | Tensor:
    """An action without its log-probabilities."""
    if isinstance(action, Tensor):
        return action
    return action.exclude(*(key for key in list(action.keys()) if key.endswith("_log_prob")))
