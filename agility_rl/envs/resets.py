"""Episodes that begin anew on a GPU without a word from it."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase


class MaskedResets(EnvBase):
    """Base of environments in which ``step_and_maybe_reset`` does not wait for a GPU.

    TorchRL asks whether anyone is done, and then whether everyone is; the answer takes until the GPU has done all that
    it was told before. Of thousands of robots some are done in nearly every step: there, rows are reset by their mask
    and nobody asks. On a CPU, which knows at once, nothing changes; nor where a reset is dear.

    Source: ours.
    """

    @property
    def cheap_resets(self) -> bool:
        """Whether a reset of nobody costs next to nothing.

        It does not where parameters are drawn, for the engine then derives constants of all robots, or images taken.
        """
        return True

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Of what came of a step, ``[N]``, begin anew the rows whose ``done`` [N, 1] is set."""
        if self.device.type != "cpu" and self.cheap_resets:
            return masked_reset(self, tensordict)
        found: TensorDictBase = super().maybe_reset(tensordict)
        return found


def masked_reset(env: EnvBase, tensordict: TensorDictBase) -> TensorDictBase:
    """Reset the rows whose ``done`` [N, 1] is set, if there are any, in place.

    It is what ``EnvBase.maybe_reset`` does for an environment of one batch dimension, without a look at the mask; what
    a reset does not write, such as an action, becomes zero in those rows.

    Args:
        env: environment of ``[N]``, whose ``_reset`` honours the mask ``_reset`` [N, 1] and draws for all rows.
        tensordict: what came of a step, ``[N]``.

    Returns:
        The same TensorDict.

    Example:
        >>> import torch
        >>> from agility_rl.envs import LocomotionEnv
        >>> env = LocomotionEnv(2, simulator_options={"num_threads": 1})
        >>> observed = env.reset()
        >>> observed["done"][1] = True
        >>> masked_reset(env, observed)["done"].flatten()
        tensor([False, False])
        >>> env.close()
    """
    done = tensordict.get("done")
    fresh = env._reset(TensorDict({"_reset": done}, env.batch_size, device=env.device))
    # What it lacks would be padded by a number, which would be copied to the GPU each time.
    for key in set(tensordict.keys(True, True)) - set(fresh.keys(True, True)):
        fresh.set(key, torch.zeros_like(tensordict.get(key)))
    kept: TensorDictBase = tensordict.where(
        ~done.reshape(env.batch_size), other=fresh, out=tensordict, pad=0, update_batch_size=True
    )
    return kept
