"""The environment of stages 1 and 2: a batch of Go2s that follow behaviours and commands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded

from agility_rl import behaviours, keys, rotations
from agility_rl.envs.commands import CommandSampler
from agility_rl.envs.encounters import NUM_OBSERVED, PIECES, Encounters
from agility_rl.envs.observations import ObservationGroups
from agility_rl.envs.randomization import Randomization, uniform
from agility_rl.envs.reference import ReferenceStates
from agility_rl.envs.resets import MaskedResets
from agility_rl.envs.rewards import LOCOMOTION_REWARDS, RewardTerm
from agility_rl.envs.rhythm import Rhythm
from agility_rl.envs.robots import CLEARANCE, Pushes, Robots
from agility_rl.envs.state import LocomotionState
from agility_rl.envs.terminations import LOCOMOTION_TERMINATIONS, Termination
from agility_rl.go2 import constants, features, kinematics
from agility_rl.simulation import Simulator, make_simulator
from agility_rl.tensors import constant, rows_of

EDGE = 1.0
"""How far beyond the square of the starts an episode on a height field goes on [m]; the field ends a metre further."""


class LocomotionEnv(MaskedResets):
    """``N`` Go2 robots that move in a commanded behaviour at a commanded velocity and height.

    A step takes joint targets ``q* = q_default + scale * action``, holds them for one control step, and returns named
    observation groups. Time limits and the edge of a height field are truncations; contact of trunk or hip, or
    divergence of the engine, terminates. The reward is the task reward r^T: the sum of weighted terms times the control
    step, clipped at zero. Imitation, skill and shift rewards are not the environment's business.

    Source: method notes, section 4; supplement S2, S4, Table S2.

    Keys written (``N`` robots): ``proprioception`` [N, 45], ``explicit`` [N, 4], ``privileged`` [N, 29], ``history``
    [N, 10, 45], ``command`` [N, 11], ``peak`` [N, 1], ``motion`` [N, 2, 49], ``skill`` [N], ``shift`` [N, 1], with
    encounters ``encounter`` [N, 7], ``reward`` [N, 1], ``(reward_terms, name)`` [N, 1], ``done``, ``terminated``,
    ``truncated`` [N, 1]. Units stand in :mod:`agility_rl.keys`.

    Args:
        num_robots: N.
        simulator: ready simulator, or ``None`` for one built with ``simulator_options``.
        simulator_options: keyword arguments of :func:`agility_rl.simulation.make_simulator`.
        reference: states for reference-state initialisation as :class:`ReferenceStates` takes them; ``None`` starts
            from standing.
        standing_starts: share of the episodes that start from standing all the same; may be set anew at any time.
        rewards: reward terms by name.
        terminations: failures; an episode ends when one of them holds.
        randomization: ranges of physical parameters, drawn anew at each reset; ``None`` leaves the model nominal.
        observation_noise: factor on the noise of :data:`agility_rl.go2.features.PROPRIOCEPTION_LAYOUT`.
        episode_length: seconds until truncation.
        resample_period: seconds between redraws of latents and commands; ``None`` leaves them to
            :meth:`set_commands`.
        push_interval: seconds between pushes; ``None`` for none.
        push_velocity: largest horizontal speed on each axis that a push sets [m/s].
        patterns: rhythm of each behaviour, as :class:`agility_rl.envs.rhythm.Rhythm` takes them, for the reward term
            ``rhythm``; ``None`` hears none.
        encounters: share of the commands on which a bar or a ramp lies in the way (:class:`Encounters`).
        boxes: share of the jumps that begin before a box.
        motion_offsets: which discriminator frames ``motion`` holds, in control steps from the oldest; ``[N, H, 49]``
            then has their number H. With ``past_motion`` in the reference, those before an episode are the dog's.
        seed: seed of all randomness in the environment.

    Raises:
        ValueError: if the simulator holds another number of robots or, with encounters, another world, or comes with
            ``simulator_options``, a reference entry is missing or too short, a behaviour has no reference state,
            ``standing_starts`` is no share, the offsets do not rise from zero, commands or pushes shall come more often
            than at every control step, or there is no reward term or no termination.

    Example:
        >>> env = LocomotionEnv(2, simulator_options={"num_threads": 1})
        >>> rollout = env.rollout(3)
        >>> rollout["next", "motion"].shape
        torch.Size([2, 3, 2, 49])
        >>> env.close()
    """

    def __init__(
        self,
        num_robots: int,
        *,
        simulator: Simulator | None = None,
        simulator_options: Mapping[str, Any] | None = None,
        reference: TensorDictBase | None = None,
        standing_starts: float = 0.0,
        rewards: Mapping[str, RewardTerm] = LOCOMOTION_REWARDS,
        terminations: Sequence[Termination] = LOCOMOTION_TERMINATIONS,
        randomization: Randomization | None = None,
        observation_noise: float = 0.0,
        episode_length: float = 20.0,
        resample_period: float | None = behaviours.RESAMPLE_PERIOD,
        push_interval: float | None = None,
        push_velocity: float = 0.5,
        patterns: TensorDictBase | None = None,
        encounters: float = 0.0,
        boxes: float = 0.0,
        motion_offsets: Sequence[int] = features.MOTION_OFFSETS,
        seed: int = 0,
    ) -> None:
        meeting = bool(encounters or boxes)
        engine = {"scenery": PIECES if meeting else (), **(simulator_options or {})}
        if simulator is not None and simulator_options:
            raise ValueError(f"expected simulator or simulator_options, got both, with {sorted(simulator_options)}")
        simulator = simulator or make_simulator(num_simulations=num_robots, **engine)
        super().__init__(device=simulator.device, batch_size=torch.Size([num_robots]))
        self.is_closed = False  # EnvBase starts as closed, and close() would leave the simulator's threads running
        self.simulator, device = simulator, simulator.device
        if self.simulator.num_simulations != num_robots:
            raise ValueError(f"the simulator holds {self.simulator.num_simulations} robots, expected {num_robots}")
        if meeting and (tuple(simulator.scenery) != PIECES or simulator.ground_extent > 0.0):
            raise ValueError("encounters need a plane, and a simulator that holds agility_rl.envs.encounters.PIECES")
        self.dt = self.simulator.control_dt
        self.rewards = dict(rewards)
        self.terminations = tuple(terminations)
        if not self.rewards or not self.terminations:
            raise ValueError(
                "expected at least one reward term and one termination, got "
                f"{len(self.rewards)} and {len(self.terminations)}"
            )
        self.randomization = randomization
        self.max_steps = round(episode_length / self.dt)
        self.generator = torch.Generator(device).manual_seed(seed)
        period = None if resample_period is None else round(resample_period / self.dt)
        if period is not None and period < 1:
            raise ValueError(f"resample_period must be at least a control step, {self.dt} s, got {resample_period}")
        self.commands = CommandSampler(num_robots, self.generator, period)
        self.observations = ObservationGroups(num_robots, self.generator, observation_noise, motion_offsets)
        self.reference = (
            ReferenceStates.standing(device) if reference is None else ReferenceStates(reference.to(device))
        )
        self.reference.check_past(motion_offsets[-1])
        if not 0.0 <= standing_starts <= 1.0:
            raise ValueError(f"standing_starts: expected a share from 0 to 1, got {standing_starts}")
        self.standing_starts = standing_starts
        n = num_robots
        interval = None if push_interval is None else round(push_interval / self.dt)
        self.pushes = Pushes(n, self.generator, interval, push_velocity)
        self.encounters = Encounters(n, self.generator, encounters, boxes) if meeting else None
        self.robots = Robots(self.simulator, self.generator, self._ground)
        self.rhythm = None if patterns is None else Rhythm(n, patterns.to(device))
        self._step_count = torch.zeros(n, dtype=torch.int64, device=device)
        self._make_specs(n)

    def _make_specs(self, n: int) -> None:
        def group(*shape: int) -> Unbounded:
            return Unbounded((n, *shape), dtype=torch.float32)

        self.observation_spec = Composite(
            {
                keys.PROPRIOCEPTION: group(features.NUM_PROPRIOCEPTION),
                keys.EXPLICIT: group(features.NUM_EXPLICIT),
                keys.PRIVILEGED: group(features.NUM_PRIVILEGED),
                keys.HISTORY: group(features.HISTORY, features.NUM_PROPRIOCEPTION),
                keys.COMMAND: group(len(behaviours.COMMANDS) + 1 + behaviours.NUM_BEHAVIOURS),
                keys.PEAK: group(1),
                keys.MOTION: group(len(self.observations.motion_offsets), features.NUM_MOTION),
                keys.SKILL: Categorical(behaviours.NUM_BEHAVIOURS, shape=(n,), dtype=torch.int64),
                keys.SHIFT: Bounded(-1.0, 1.0, (n, 1), dtype=torch.float32),
                **({} if self.encounters is None else {keys.ENCOUNTER: group(NUM_OBSERVED)}),
                keys.REWARD_TERMS: Composite({name: group(1) for name in self.rewards}, shape=(n,)),
            },
            shape=(n,),
        )
        self.action_spec = Unbounded((n, constants.NUM_JOINTS), dtype=torch.float32)
        self.reward_spec = Unbounded((n, 1), dtype=torch.float32)
        self.full_done_spec = Composite(
            {name: Binary(shape=(n, 1), dtype=torch.bool) for name in ("done", "terminated", "truncated")}, shape=(n,)
        )

    @property
    def cheap_resets(self) -> bool:
        return self.randomization is None

    @property
    def num_robots(self) -> int:
        """Number of robots."""
        return self.batch_size[0]

    def set_commands(self, skill: Tensor, command: Tensor, shift: Tensor | None = None) -> None:
        """Command every robot from the next observation on; what lies in its way stays (:class:`Encounters`).

        Args:
            skill: int64 ``[N]``.
            command: ``[N, 5]`` in the order and units of :data:`agility_rl.behaviours.COMMANDS`.
            shift: ``[N, 1]`` in [-1, 1], zero if not given.

        Raises:
            ValueError: if one of them has another shape.
        """
        shift = torch.zeros(self.num_robots, 1, device=self.device) if shift is None else shift
        expected = [list(now.shape) for now in (self.commands.skill, self.commands.command, self.commands.shift)]
        found = [list(given.shape) for given in (skill, command, shift)]
        if found != expected:
            raise ValueError(f"expected skill, command and shift of {expected}, got {found}")
        self.commands.assign(self._everyone(), *(given.to(self.device) for given in (skill, command, shift)))

    def set_skill_probabilities(self, probabilities: Tensor) -> None:
        """Draw future skills from ``[5]`` probabilities (the skill prior).

        Raises:
            ValueError: if they are not one for each behaviour.
        """
        if tuple(probabilities.shape) != (behaviours.NUM_BEHAVIOURS,):
            raise ValueError(f"expected [{behaviours.NUM_BEHAVIOURS}] probabilities, got {list(probabilities.shape)}")
        self.commands.probabilities = probabilities.detach().to(self.device, copy=True)

    def _everyone(self) -> Tensor:
        return torch.ones(self.num_robots, dtype=torch.bool, device=self.device)

    # -- TorchRL -----------------------------------------------------------------------------------------------------
    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.generator.manual_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = self._everyone()
        if tensordict is not None and (chosen := tensordict.get("_reset", None)) is not None:
            mask = chosen.reshape(self.num_robots)
        if self.commands.period is not None:
            self.commands.resample(mask)
        past = self._place(mask)
        if self.encounters is not None:
            self.encounters.begin(mask, self.simulator, self.commands)
        if self.randomization is not None:
            self.robots.randomize(mask, self.randomization)
        self._step_count = self._step_count.masked_fill(mask, 0)
        self.pushes.begin(mask)
        if self.rhythm is not None:
            self.rhythm.begin(mask)
        state = self.robots.begin(mask, self.commands)
        self.observations.reset(mask, state, past)

        observation = self._observe(state)
        nothing = {name: torch.zeros(self.num_robots, 1, device=self.device) for name in self.rewards}
        observation[keys.REWARD_TERMS] = TensorDict(nothing, self.batch_size)
        for name in ("done", "terminated", "truncated"):
            observation[name] = torch.zeros(self.num_robots, 1, dtype=torch.bool, device=self.device)
        # Transforms that add entries at a reset of all robots take the device from here.
        return observation.to(self.device) if tensordict is None else observation

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict[keys.ACTION].detach()  # the engine has no gradients, and states must not keep a graph
        self.pushes.apply(self.simulator, self._step_count)
        self.robots.step(action)
        self._step_count = self._step_count + 1

        state = self.robots.state(action, self.commands)
        if self.rhythm is not None:
            state.rhythm = self.rhythm.update(state, self.commands.skill)
        boxes = self.encounters if self.encounters is not None and self.encounters.boxes else None
        if boxes is not None:
            feet = rotations.rotate(self.simulator.root_quaternion[:, None], state.feet)
            state.low_feet = boxes.low_feet(feet + self.simulator.root_position[:, None])
        weights = constant(tuple(term.weight * self.dt for term in self.rewards.values()), self.device)
        terms = weights * torch.stack([term.function(state) for term in self.rewards.values()], -1)
        terms = terms.masked_fill(state.unstable[:, None], 0.0)
        reward = terms.sum(-1, keepdim=True).clamp(min=0.0)
        terminated = torch.stack([failed(state) for failed in self.terminations]).any(0)[:, None]
        truncated = ((self._step_count >= self.max_steps) | self._at_edge())[:, None] & ~terminated

        self.commands.advance(None if boxes is None else boxes.holding(self.simulator, self.commands))
        if self.encounters is not None:
            self.encounters.advance(self.simulator, self.commands)
        self.observations.update(state)
        self.robots.remember(state)
        observation = self._observe(state)
        observation["reward"] = reward
        observation["terminated"], observation["truncated"] = terminated, truncated
        observation["done"] = terminated | truncated
        by_name = dict(zip(self.rewards, terms.split(1, -1), strict=True))
        observation[keys.REWARD_TERMS] = TensorDict(by_name, self.batch_size)
        return observation

    def _observe(self, state: LocomotionState) -> TensorDict:
        observation = self.observations.build(state, self.commands, self.robots.privileged)
        if self.encounters is not None:
            observation[keys.ENCOUNTER] = self.encounters.observe(self.simulator)
        return observation

    # -- physics -----------------------------------------------------------------------------------------------------
    def _place(self, mask: Tensor) -> Tensor | None:
        n = self.num_robots
        number = self.reference.draw(self.commands.skill, self.generator, self.standing_starts)
        start, past = self.reference.states[number], self.reference.past_motion
        yaw = uniform((n,), (0.0, 2.0 * torch.pi), self.generator)
        turn = rotations.from_euler(torch.zeros_like(yaw), torch.zeros_like(yaw), yaw)
        place = self.simulator.ground_extent * uniform((n, 2), (-1.0, 1.0), self.generator)
        height = self.simulator.ground_height(place)[:, None] + start["root_height"] + CLEARANCE
        position = torch.cat((place, height), -1)
        quaternion = rotations.multiply(turn, start["root_quaternion"])
        if self.simulator.ground_extent > 0.0:  # a plane is as high under the feet as under the trunk
            position[:, 2] += self._buried(position, quaternion, start["joint_position"])
        self.simulator.reset(
            mask,
            root_position=position,
            root_quaternion=quaternion,
            root_linear_velocity=rotations.rotate(turn, start["root_linear_velocity"]),
            root_angular_velocity=rotations.rotate_inverse(start["root_quaternion"], start["root_angular_velocity"]),
            joint_position=start["joint_position"],
            joint_velocity=start["joint_velocity"],
        )
        return None if past is None else past[number[rows_of(mask)]]

    def _buried(self, position: Tensor, quaternion: Tensor, joint_position: Tensor) -> Tensor:
        """By how much ``[N]`` [m] the deepest sole is nearer to the ground below it than ``CLEARANCE``."""
        feet = position[:, None] + rotations.rotate(quaternion[:, None], kinematics.forward(joint_position))
        ground = self.simulator.ground_height(feet[..., :2].flatten(0, 1)).view(feet.shape[:2])
        return (ground + CLEARANCE - (feet[..., 2] - constants.FOOT_RADIUS)).clamp(min=0.0).amax(-1)

    def _ground(self, position: Tensor) -> Tensor:
        """Height [m] of what robots stand on under horizontal positions ``[N, 2]``, as ``[N]``."""
        height = self.simulator.ground_height(position)
        return height if self.encounters is None else height + self.encounters.ground(position)

    def _at_edge(self) -> Tensor:
        """Who has come to the edge of a height field, beyond which there is nothing to walk on."""
        beyond = self.simulator.root_position[:, :2].abs().amax(-1) - self.simulator.ground_extent
        return (beyond > EDGE) & (self.simulator.ground_extent > 0.0)

    # -- resume ------------------------------------------------------------------------------------------------------
    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:  # type: ignore[override]
        """Everything that an exact continuation needs: simulator, commands, memories, clocks, generator."""
        return {
            "simulator": self.simulator.state_dict(),
            "commands": self.commands.state_dict(),
            "observations": self.observations.state_dict(),
            **({} if self.rhythm is None else {"rhythm": self.rhythm.state_dict()}),
            **({} if self.encounters is None else {"encounters": self.encounters.state_dict()}),
            "buffers": {
                "step_count": self._step_count.clone(),
                "push_phase": self.pushes.phase.clone(),
                **self.robots.state_dict(),
            },
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any], *args: Any, **kwargs: Any) -> None:  # type: ignore[override]
        """Restore what :meth:`state_dict` returned."""
        self.simulator.load_state_dict(state_dict["simulator"])
        self.commands.load_state_dict(state_dict["commands"])
        self.observations.load_state_dict(state_dict["observations"])
        if self.rhythm is not None:
            self.rhythm.load_state_dict(state_dict["rhythm"])
        if self.encounters is not None:
            self.encounters.load_state_dict(state_dict["encounters"])
        buffers = state_dict["buffers"]
        self._step_count, self.pushes.phase = buffers["step_count"].clone(), buffers["push_phase"].clone()
        self.robots.load_state_dict(buffers)
        self.generator.set_state(state_dict["generator"])

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Release the simulator's threads and memory."""
        if not self.is_closed:
            self.simulator.close()
        super().close(raise_if_closed=raise_if_closed)
