"""The locomotion environment for other libraries: a Gymnasium ``VectorEnv`` around the same batch of robots.

Importing :mod:`agility_rl.envs` registers it, so that ``gymnasium.make_vec("agility_rl/Locomotion-v0", num_envs=N)``
finds it; without that import, ``"agility_rl.envs.gymnasium:agility_rl/Locomotion-v0"`` does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from agility_rl import keys
from agility_rl.envs.locomotion import LocomotionEnv

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        "agility_rl.envs.gymnasium needs the optional package gymnasium, which is not installed; "
        "run: pip install 'agility_rl[gymnasium]'"
    ) from error

LOCOMOTION_ID = "agility_rl/Locomotion-v0"
GROUPS = (keys.PROPRIOCEPTION, keys.COMMAND, keys.PEAK, keys.HISTORY, keys.EXPLICIT, keys.PRIVILEGED, keys.MOTION)
"""Observation groups shown by default; a robot measures the first four (:data:`~agility_rl.keys.PEAK` by estimate)."""


class LocomotionVectorEnv(VectorEnv):
    """``N`` Go2 robots as a Gymnasium vector environment.

    All three autoreset modes of Gymnasium are offered, with its meaning: after an episode's last step, ``NEXT_STEP``
    returns the true last observation and starts the next episode in the following step (whose action is ignored and
    whose reward is 0); ``SAME_STEP`` returns the first observation of the next episode and keeps the last one in
    ``infos["final_obs"]``; ``DISABLED`` waits for ``reset(options={"reset_mask": mask})``. A time limit is a
    truncation, a fall a termination.

    ``infos["reward_terms"][name]`` ``[N]`` is each term of the reward, weighted.

    Source: Gymnasium's vector API, 1.1 and later; the robots are those of :class:`LocomotionEnv`.

    Args:
        num_envs: N.
        groups: observation groups to show, entries of the ``Dict`` space; shapes and units in :mod:`agility_rl.keys`.
        autoreset_mode: one of ``AutoresetMode``, or its value, ``"NextStep"``, ``"SameStep"``, ``"Disabled"``.
        action_limit: bounds of the action space in action units; 10 reaches every joint limit but the upper ones of the
            thighs. Larger actions are clipped.
        env: ready environment, or ``None`` for one built with ``options``.
        **options: keyword arguments of :class:`LocomotionEnv`.

    Raises:
        ModuleNotFoundError: at import, if Gymnasium is not installed.
        ValueError: if there is no group or one is unknown or not float32, the limit is not positive, or ``env`` holds
            another number of robots.

    Example:
        >>> import gymnasium
        >>> envs = gymnasium.make_vec("agility_rl/Locomotion-v0", num_envs=2, simulator_options={"num_threads": 1})
        >>> observation, info = envs.reset(seed=0)
        >>> observation["proprioception"].shape
        (2, 45)
        >>> observation, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
        >>> reward.shape, "reward_terms" in info
        ((2,), True)
        >>> envs.close()
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        groups: Sequence[str] = GROUPS,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        action_limit: float = 10.0,
        env: LocomotionEnv | None = None,
        **options: Any,
    ) -> None:
        if action_limit <= 0.0:
            raise ValueError(f"expected an action_limit above 0 action units, got {action_limit}")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        if env is not None and (env.num_robots != num_envs or options):
            raise ValueError(
                f"a ready env of {env.num_robots} robots was given, with num_envs={num_envs} and options "
                f"{sorted(options)}; expected the same number and no options"
            )
        self.env = LocomotionEnv(num_envs, **options) if env is None else env
        self.num_envs = num_envs
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        if not groups:
            raise ValueError("expected at least one observation group, got none; leave groups out for the usual ones")
        self.groups = tuple(groups)
        self.single_observation_space = gymnasium.spaces.Dict({name: self._space(name) for name in self.groups})
        actions = self.env.action_spec.shape[1:]
        self.single_action_space = gymnasium.spaces.Box(-action_limit, action_limit, tuple(actions), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._limit = action_limit
        self._observation: dict[str, Tensor] = {}
        self._ended = torch.zeros(num_envs, dtype=torch.bool)

    def _space(self, name: str) -> gymnasium.spaces.Box:
        specs = self.env.observation_spec.items()
        shown = {key: spec for key, spec in specs if spec.dtype == torch.float32 and not isinstance(spec, Composite)}
        if name not in shown:
            raise ValueError(f"{name!r} is no float32 observation group; expected some of {', '.join(sorted(shown))}")
        return gymnasium.spaces.Box(-np.inf, np.inf, tuple(shown[name].shape[1:]), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start new episodes, of all robots or of those in a mask.

        Args:
            seed: seed of all further randomness; without one it goes on from that of ``LocomotionEnv(seed=...)``, 0.
            options: ``{"reset_mask": bool array [N]}`` to reset only these robots.

        Raises:
            ValueError: if the mask is no bool array ``[N]`` with a set row, or names only some robots before the first
                full reset.
            gymnasium.error.ClosedEnvironmentError: after :meth:`close`.
        """
        self._check_open()
        super().reset(seed=seed)
        if seed is not None:
            self.env.generator.manual_seed(seed)
        mask = torch.ones(self.num_envs, dtype=torch.bool)
        if options is not None and "reset_mask" in options:
            chosen = np.asarray(options["reset_mask"])
            if chosen.shape != (self.num_envs,) or chosen.dtype != np.bool_ or not chosen.any():
                raise ValueError(
                    f"expected options['reset_mask'] to be a bool array of shape ({self.num_envs},) with a set row, "
                    f"got {chosen.dtype} of shape {chosen.shape} with {np.count_nonzero(chosen)} set"
                )
            mask = torch.from_numpy(chosen.copy())
            if not self._observation and not mask.all():
                raise ValueError("the first reset must be of all robots, got a reset_mask that leaves some out")
        self._begin(mask)
        return self._numpy(), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Move every robot by one control step.

        Args:
            actions: float ``[N, 12]`` in action units.

        Returns:
            Observations, rewards ``[N]``, terminations ``[N]``, truncations ``[N]``, infos.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset, or with ``DISABLED`` after an episode's end.
            gymnasium.error.ClosedEnvironmentError: after :meth:`close`.
            ValueError: if the actions have another shape.
        """
        self._check_open()
        action = torch.as_tensor(np.asarray(actions, dtype=np.float32))
        if action.shape != self.env.action_spec.shape:
            raise ValueError(f"expected actions of shape {self.action_space.shape}, got {tuple(action.shape)}")
        starting = self._ended.clone()
        if not self._observation or (starting.any() and self.autoreset_mode is AutoresetMode.DISABLED):
            which = f"robots {starting.nonzero()[:, 0].tolist()}" if self._observation else "all robots"
            raise gymnasium.error.ResetNeeded(f"{which} need a reset before the next step")

        # All robots share one physics step, those that wait for their next episode too: they are placed anew below.
        action = action.clamp(-self._limit, self._limit).masked_fill(starting[:, None], 0.0)
        after = self.env.step(TensorDict({keys.ACTION: action.to(self.env.device)}, [self.num_envs]))["next"].cpu()
        self._observation = {name: after[name] for name in self.groups}
        reward = after["reward"][:, 0].masked_fill(starting, 0.0)
        terminated, truncated = (after[name][:, 0] & ~starting for name in ("terminated", "truncated"))
        self._ended = terminated | truncated

        infos: dict[str, Any] = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            starting = self._ended.clone()
            if starting.any():
                infos |= {"final_obs": self._final(starting), "_final_obs": starting.numpy()}
                infos |= {"final_info": self._terms(after, starting), "_final_info": starting.numpy()}
        if starting.any():
            self._begin(starting)
        infos |= self._terms(after, ~starting)
        return self._numpy(), reward.numpy(), terminated.numpy(), truncated.numpy(), infos

    def _check_open(self) -> None:
        if self.closed:
            raise gymnasium.error.ClosedEnvironmentError("the robots were closed; make the environment anew")

    def _begin(self, mask: Tensor) -> None:
        """Start episodes of the rows of a bool mask, and leave the observations of the others as they are."""
        fresh = self.env.reset(TensorDict({"_reset": mask[:, None].to(self.env.device)}, [self.num_envs])).cpu()
        for name in self.groups:
            row = mask.view(-1, *(1,) * (fresh[name].ndim - 1))
            self._observation[name] = torch.where(row, fresh[name], self._observation.get(name, fresh[name]))
        self._ended = self._ended & ~mask

    def _numpy(self) -> dict[str, np.ndarray]:
        # Copies, so that a caller who writes into an observation does not write into the robots' memories.
        return {name: value.numpy().copy() for name, value in self._observation.items()}

    def _final(self, mask: Tensor) -> np.ndarray:
        """Observations of the rows of a mask as Gymnasium keeps them: an object array with ``None`` elsewhere."""
        final = np.full(self.num_envs, None, dtype=object)
        for row in mask.nonzero()[:, 0].tolist():
            final[row] = {name: value[row].numpy().copy() for name, value in self._observation.items()}
        return final

    def _terms(self, after: TensorDictBase, mask: Tensor) -> dict[str, Any]:
        """Reward terms of the rows of a mask, each beside its ``_name`` mask as Gymnasium wants it."""
        if not mask.any():
            return {}
        valid = mask.numpy()
        terms: dict[str, np.ndarray] = {}
        for name, value in after[keys.REWARD_TERMS].items():
            terms |= {name: value[:, 0].masked_fill(~mask, 0.0).numpy(), f"_{name}": valid}
        return {keys.REWARD_TERMS: terms, f"_{keys.REWARD_TERMS}": valid}

    def close_extras(self, **kwargs: Any) -> None:
        """Release the simulator."""
        self.env.close()


if LOCOMOTION_ID not in gymnasium.registry:
    gymnasium.register(LOCOMOTION_ID, vector_entry_point="agility_rl.envs.gymnasium:LocomotionVectorEnv")
