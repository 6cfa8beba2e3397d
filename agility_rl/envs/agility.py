"""The environment of stages 3 and 4: a batch of Go2s on an agility course, told by a Task-Specific Controller."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded

from agility_rl import behaviours, keys, rotations
from agility_rl.envs.agility_rewards import AGILITY_REWARDS, TERMINATION, TERMINATION_TERM, AgilityTerm
from agility_rl.envs.agility_state import AgilityState
from agility_rl.envs.agility_terminations import AGILITY_TERMINATIONS, Termination
from agility_rl.envs.arena import NUM_PLACE, Arena
from agility_rl.envs.course import Course
from agility_rl.envs.course_presets import full_course
from agility_rl.envs.decisions import COMMAND_NOISE, NUM_PARAMETERS, Decisions
from agility_rl.envs.depth import DepthObservation
from agility_rl.envs.layout import scenery
from agility_rl.envs.misjudgement import Misjudgement
from agility_rl.envs.observations import ObservationGroups
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.envs.outcome import DecisionOutcome, outcome_specs
from agility_rl.envs.progress import GOAL_RADIUS, Events
from agility_rl.envs.randomization import Randomization
from agility_rl.envs.resets import MaskedResets
from agility_rl.envs.robots import Pushes, Robots
from agility_rl.envs.scandots import NUM_SCANDOTS
from agility_rl.envs.snapshots import per_robot, with_rows
from agility_rl.go2 import camera, features
from agility_rl.simulation import Simulator, make_simulator
from agility_rl.tensors import constant

Controller = Callable[[TensorDictBase], TensorDictBase]
"""The frozen Basic Behaviour Controller: locomotion observations to joint targets under ``action``."""

COURSE_RANDOMIZATION = Randomization(gain=(1.0, 1.0), action_delay=(0.02, 0.02))
"""Friction, mass and centre of mass as in stage 1, nominal gains, one step of delay (method notes, section 5.11)."""


class AgilityEnv(MaskedResets):
    """``N`` Go2 robots that pass the obstacles of a course.

    A step takes a decision, a behaviour and six parameters for each of the five, and holds it for ``decision_steps``
    control steps, in each of which the frozen Basic Behaviour Controller moves the joints. Rewards are summed over
    these; they are r^T, without weight: the imitation reward of the controller's discriminator on ``motion``, and the
    weights of both, belong to the training. A robot whose episode ends within a held decision earns nothing more.

    Success, and the time limit, are truncations; ``outcome`` tells them apart. Every episode has its own course: order,
    places and heights of the obstacles are drawn at the reset.

    Source: supplement S2, S5, Algorithm S3; method notes, section 5. Different from the release: ``history`` holds the
    present proprioception too, as the Basic Behaviour Controller needs it.

    Keys read: ``(action, behaviour)`` int64 [N], ``(action, parameters)`` [N, 5, 6].

    Keys written, beside those of :class:`LocomotionEnv` (where ``command``, ``skill`` and ``shift`` are now the last
    decision's): ``heading_error`` [N, 2], ``obstacle`` [N, 7], ``scandots`` [N, 132], ``place`` [N, 8], ``progress``
    [N, S], ``(outcome, name)`` bool [N, 1] or [N, 7], ``(terminations, name)`` bool [N, 1], and with a camera ``depth``
    [N, 58, 87]. Units stand in :mod:`agility_rl.keys`.

    Args:
        num_robots: N.
        controller: the Basic Behaviour Controller, deterministic; called without gradients.
        course: what stands where.
        simulator: ready simulator that holds the course's pieces, or ``None`` for one built with
            ``simulator_options``.
        simulator_options: keyword arguments of :func:`agility_rl.simulation.make_simulator`.
        decision_steps: control steps of a decision; 1 decides at 50 Hz.
        command_noise: factors that commands are multiplied by; (1, 1) for none.
        fastest_canter: what the forward speed of a commanded canter ends at [m/s]; Table S2's, or a faster one (ours).
        rewards: reward terms by name.
        termination_reward: weight of a failure.
        terminations: failures by name; an episode ends when one of them holds.
        randomization: ranges of physical parameters, drawn anew at each reset; ``None`` leaves the model nominal.
        observation_noise: factor on the noise of the proprioception (the release has none here).
        episode_length: seconds until truncation.
        goal_radius: distance at which a way-point is reached [m].
        start: before a random obstacle, or before the first.
        start_spread: how many times as far aside and turned as released (:class:`~agility_rl.envs.arena.Arena`).
        start_after: share of random starts that are where the obstacle before is left.
        misjudgement: factor on how wrong ``place``, ``heading_error``, ``obstacle`` and ``scandots`` are
            (:class:`~agility_rl.envs.misjudgement.Misjudgement`; ours); 0: they are true.
        push_interval: seconds between pushes; ``None`` for none.
        push_velocity: largest horizontal speed on each axis that a push sets [m/s].
        motion_offsets: which discriminator frames ``motion`` holds, in control steps from the oldest.
        depth: keyword arguments of :class:`agility_rl.envs.depth.DepthObservation`, such as ``{}``; ``None`` for no
            camera.
        seed: seed of all randomness in the environment.

    Raises:
        ValueError: if the simulator holds another number of robots or other scenery, or comes with
            ``simulator_options``, a number is impossible, or there is no reward term or no termination.
        TypeError: if ``course`` is none, such as the name of one.

    Example:
        >>> def stand(td):
        ...     return td.set("action", torch.zeros(*td.shape, 12))
        >>> env = AgilityEnv(2, stand, simulator_options={"num_threads": 1})
        >>> rollout = env.rollout(3)
        >>> rollout["next", "scandots"].shape
        torch.Size([2, 3, 132])
        >>> env.close()
    """

    def __init__(
        self,
        num_robots: int,
        controller: Controller,
        course: Course | None = None,
        *,
        simulator: Simulator | None = None,
        simulator_options: Mapping[str, Any] | None = None,
        decision_steps: int = 1,
        command_noise: tuple[float, float] = COMMAND_NOISE,
        fastest_canter: float = behaviours.FASTEST_CANTER,
        rewards: Mapping[str, AgilityTerm] = AGILITY_REWARDS,
        termination_reward: float = TERMINATION,
        terminations: Mapping[str, Termination] = AGILITY_TERMINATIONS,
        randomization: Randomization | None = None,
        observation_noise: float = 0.0,
        episode_length: float = 40.0,
        goal_radius: float = GOAL_RADIUS,
        start: Literal["random", "first"] = "random",
        start_spread: float = 1.0,
        start_after: float = 0.0,
        misjudgement: float = 0.0,
        push_interval: float | None = None,
        push_velocity: float = 0.5,
        motion_offsets: Sequence[int] = features.MOTION_OFFSETS,
        depth: Mapping[str, Any] | None = None,
        seed: int = 0,
    ) -> None:
        if decision_steps < 1:
            raise ValueError(f"decision_steps must be at least 1, got {decision_steps}")
        course = full_course() if course is None else course
        pieces = scenery(course)
        if simulator is not None and simulator_options:
            raise ValueError(f"expected simulator or simulator_options, got both, with {sorted(simulator_options)}")
        simulator = simulator or make_simulator(num_simulations=num_robots, scenery=pieces, **(simulator_options or {}))
        super().__init__(device=simulator.device, batch_size=torch.Size([num_robots]))
        self.is_closed = False  # EnvBase starts as closed, and close() would leave the simulator's threads running
        self.simulator = simulator
        self.generator = torch.Generator(simulator.device).manual_seed(seed)
        period = simulator.control_dt * decision_steps
        errors = Misjudgement(num_robots, self.generator, misjudgement, period) if misjudgement else None
        self.arena = Arena(course, num_robots, self.generator, goal_radius, start, start_spread, start_after, errors)
        if self.simulator.num_simulations != num_robots:
            raise ValueError(f"the simulator holds {self.simulator.num_simulations} robots, expected {num_robots}")
        if tuple(self.simulator.scenery) != pieces:
            raise ValueError(f"the simulator must hold scenery(course) of {course.name!r} (agility_rl.envs.layout)")
        self.controller = controller
        self.dt = self.simulator.control_dt
        self.decision_steps = decision_steps
        self.rewards, self.terminations = dict(rewards), dict(terminations)
        if not self.rewards or not self.terminations:
            raise ValueError(
                "expected at least one reward term and one termination, got "
                f"{len(self.rewards)} and {len(self.terminations)}"
            )
        self.termination_reward = termination_reward
        self.randomization = randomization
        self.max_steps = round(episode_length / self.dt)
        self.decisions = Decisions(num_robots, self.generator, command_noise, fastest_canter)
        self.observations = ObservationGroups(num_robots, self.generator, observation_noise, motion_offsets)
        interval = None if push_interval is None else round(push_interval / self.dt)
        self.pushes = Pushes(num_robots, self.generator, interval, push_velocity)
        ground = partial(self.arena.ground, simulator=self.simulator)
        self.robots = Robots(self.simulator, self.generator, ground)
        self.depth: DepthObservation | None = None
        if depth is not None:
            self.depth = DepthObservation(self.simulator, self.generator, decision_steps, **depth)
        self._robot = self.robots.state(self.robots.action, self.decisions.commands)
        self._step_count = torch.zeros(num_robots, dtype=torch.int64, device=self.device)
        self._make_specs(num_robots)

    def _make_specs(self, n: int) -> None:
        def group(*shape: int) -> Unbounded:
            return Unbounded((n, *shape), dtype=torch.float32)

        images = Bounded(-0.5, 0.5, (n, camera.IMAGE_HEIGHT, camera.IMAGE_WIDTH), dtype=torch.float32)
        skill = Categorical(behaviours.NUM_BEHAVIOURS, shape=(n,), dtype=torch.int64)
        self.observation_spec = Composite(
            {
                keys.PROPRIOCEPTION: group(features.NUM_PROPRIOCEPTION),
                keys.EXPLICIT: group(features.NUM_EXPLICIT),
                keys.PRIVILEGED: group(features.NUM_PRIVILEGED),
                keys.HISTORY: group(features.HISTORY, features.NUM_PROPRIOCEPTION),
                keys.COMMAND: group(len(behaviours.COMMANDS) + 1 + behaviours.NUM_BEHAVIOURS),
                keys.PEAK: group(1),
                keys.MOTION: group(len(self.observations.motion_offsets), features.NUM_MOTION),
                keys.SKILL: skill,
                keys.SHIFT: Bounded(-1.0, 1.0, (n, 1), dtype=torch.float32),
                keys.HEADING_ERROR: group(2),
                keys.PLACE: group(NUM_PLACE),
                keys.OBSTACLE: group(len(OBSTACLES)),
                keys.PROGRESS: group(self.arena.progress.num_stages),
                keys.SCANDOTS: group(NUM_SCANDOTS),
                **outcome_specs(n, (*self.rewards, TERMINATION_TERM), self.terminations),
                **({} if self.depth is None else {keys.DEPTH: images, keys.IMAGE_AGE: group(1)}),
            },
            shape=(n,),
        )
        parameters = group(behaviours.NUM_BEHAVIOURS, NUM_PARAMETERS)
        decision = Composite({keys.BEHAVIOUR: skill.clone(), keys.PARAMETERS: parameters}, shape=(n,))
        self.full_action_spec = Composite({keys.ACTION: decision}, shape=(n,))
        self.reward_spec = group(1)
        self.full_done_spec = Composite(
            {name: Binary(shape=(n, 1), dtype=torch.bool) for name in ("done", "terminated", "truncated")}, shape=(n,)
        )

    @property
    def cheap_resets(self) -> bool:
        return self.randomization is None and self.depth is None

    @property
    def num_robots(self) -> int:
        """Number of robots."""
        return self.batch_size[0]

    def set_curriculum(
        self,
        *,
        difficulty: float | None = None,
        obstacles: int | None = None,
        start_weights: Tensor | None = None,
    ) -> None:
        """Change what later episodes draw; what is ``None`` stays as it is.

        Args:
            difficulty: share of every range of heights, 0 to 1.
            obstacles: most obstacles in an episode, from the one it starts before.
            start_weights: ``[K]``, how often episodes start before each of the course's obstacles.

        Raises:
            ValueError: if a value is outside its range.
        """
        self.arena.set_curriculum(difficulty, obstacles, start_weights)

    # -- TorchRL -----------------------------------------------------------------------------------------------------
    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.generator.manual_seed(seed)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = torch.ones(self.num_robots, dtype=torch.bool, device=self.device)
        if tensordict is not None and (chosen := tensordict.get("_reset", None)) is not None:
            mask = chosen.reshape(self.num_robots)
        self.arena.begin(mask, self.simulator)
        if self.randomization is not None:
            self.robots.randomize(mask, self.randomization)
        self._step_count = self._step_count.masked_fill(mask, 0)
        self.pushes.begin(mask)
        self.decisions.begin(mask)
        self._robot = self.robots.begin(mask, self.decisions.commands)
        self.observations.reset(mask, self._robot)
        if self.depth is not None:
            self.depth.begin(mask)

        observation = self._observe(self._outcome()).exclude("reward")
        # Transforms that add entries at a reset of all robots take the device from here.
        return observation.to(self.device) if tensordict is None else observation

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        decision = tensordict[keys.ACTION].detach()  # decisions are remembered, and must not keep a graph
        self.decisions.decide(decision[keys.BEHAVIOUR], decision[keys.PARAMETERS])
        outcome, leg = self._outcome(), self.arena.progress.leg
        for _ in range(self.decision_steps):
            self._advance(outcome)
        self.arena.advance(leg, self.simulator.root_position[:, :2], self._robot.yaw)
        return self._observe(outcome)

    def _outcome(self) -> DecisionOutcome:
        return DecisionOutcome(self.num_robots, (*self.rewards, TERMINATION_TERM), self.terminations, self.device)

    def _advance(self, outcome: DecisionOutcome) -> None:
        """One control step of all robots."""
        commands, progress = self.decisions.commands, self.arena.progress
        seen = self.observations.build(self._robot, commands, self.robots.privileged)
        with torch.no_grad():
            action = self.controller(seen)[keys.ACTION]
        self.pushes.apply(self.simulator, self._step_count)
        self.robots.step(action)
        self._step_count = self._step_count + 1
        kind = self.arena.types[progress.obstacle]
        events = progress.update(self.simulator.root_position[:, :2])
        self._robot = self.robots.state(action, commands)
        state = self._state(events)
        self._judge(outcome, state, kind, events)
        self.observations.update(self._robot)
        self.robots.remember(self._robot)
        self.decisions.advance()
        if self.depth is not None:
            self.depth.advance()

    def _judge(self, outcome: DecisionOutcome, state: AgilityState, kind: Tensor, events: Events) -> None:
        causes = {name: failed(state) for name, failed in self.terminations.items()}
        failure = torch.stack(tuple(causes.values())).any(0)
        weights = constant(tuple(term.weight * self.dt for term in self.rewards.values()), self.device)
        weighted = weights[:, None] * torch.stack([term.function(state) for term in self.rewards.values()])
        weighted = weighted.masked_fill(state.robot.unstable, 0.0)
        reward = weighted.sum(0).clamp(min=0.0)
        terms = dict(zip(self.rewards, weighted, strict=True))
        terms[TERMINATION_TERM] = self.termination_reward * self.dt * failure
        outcome.add(
            terms,
            reward + terms[TERMINATION_TERM],
            causes,
            kind=kind,
            events=events,
            finished=self.arena.progress.finished,
            late=self._step_count >= self.max_steps,
        )

    def _state(self, events: Events) -> AgilityState:
        robot, simulator, decisions = self._robot, self.simulator, self.decisions
        position = simulator.root_position
        goal, heading_error = self.arena.heading_error(position[:, :2], robot.yaw)
        distance = torch.linalg.vector_norm(goal, dim=-1)
        feet = rotations.rotate(simulator.root_quaternion[:, None], robot.feet)
        return AgilityState(
            robot=robot,
            position=position,
            velocity=simulator.root_linear_velocity[:, :2],
            goal_distance=distance,
            goal_direction=goal / distance.clamp(min=1e-6)[:, None],
            heading_error=heading_error,
            target_speed=self.arena.target_speed(),
            at_goal=events.at_goal,
            foot_on_edge=self.arena.scan.on_edge((feet + position[:, None])[..., :2]),
            behaviours=decisions.behaviours,
            parameters=decisions.parameters,
            applied=decisions.applied,
        )

    def _observe(self, outcome: DecisionOutcome) -> TensorDict:
        observation = self.observations.build(self._robot, self.decisions.commands, self.robots.privileged)
        observation.update(self.arena.observe(self.simulator, self._robot.yaw))
        if self.depth is not None:
            observation[keys.DEPTH], observation[keys.IMAGE_AGE] = self.depth.image(), self.depth.age()
        return observation.update(outcome.entries(self.arena.progress.detour))

    # -- resume ------------------------------------------------------------------------------------------------------
    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:  # type: ignore[override]
        """Everything that an exact continuation needs: simulator, course, decisions, memories, clocks, generator."""
        return {
            **({} if self.depth is None else {"depth": self.depth.state_dict()}),
            "simulator": self.simulator.state_dict(),
            "arena": self.arena.state_dict(),
            "decisions": self.decisions.state_dict(),
            "observations": self.observations.state_dict(),
            "robots": self.robots.state_dict(),
            "step_count": self._step_count.clone(),
            "push_phase": self.pushes.phase.clone(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state_dict: Mapping[str, Any], *args: Any, **kwargs: Any) -> None:  # type: ignore[override]
        """Restore what :meth:`state_dict` returned."""
        self.simulator.load_state_dict(state_dict["simulator"])
        for name in ("arena", "decisions", "observations", "robots"):
            getattr(self, name).load_state_dict(state_dict[name])
        if self.depth is not None:
            self.depth.load_state_dict(state_dict["depth"])
        self._step_count = state_dict["step_count"].clone()
        self.pushes.phase = state_dict["push_phase"].clone()
        self.generator.set_state(state_dict["generator"])
        self._robot = self.robots.state(self.robots.action, self.decisions.commands)

    def snapshot(self) -> TensorDict:
        """Where every robot and its course are, and what both remember, ``[N]``, for :meth:`restore`."""
        return per_robot(self.state_dict(), self.num_robots)

    def restore(self, rows: Tensor, snapshot: TensorDictBase) -> TensorDict:
        """Let robots ``rows``, int64 ``[M]``, go on from snapshots ``[M]``, their own or others'.

        Returns:
            What all ``[N]`` robots observe then; the others are where they were.

        Raises:
            ValueError: if the snapshots are of an environment with other options.
        """
        self.load_state_dict(with_rows(self.state_dict(), rows, snapshot))
        return self._observe(self._outcome()).exclude("reward")

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Release the simulator's threads and memory."""
        if not self.is_closed:
            self.simulator.close()
        super().close(raise_if_closed=raise_if_closed)
