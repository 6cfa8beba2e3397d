"""The prior over skills, estimated from unlabelled motion."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from agility_rl.behaviours import NUM_BEHAVIOURS


class SkillPrior(nn.Module):
    r"""Follow the share of each skill in the unlabelled motion, and draw skills for the policy.

    .. math:: p_{i+1}(c) = \beta \, p_i(c) + (1 - \beta) \frac{1}{N} \sum_j Q^c(c | o_j)

    Source: Eq. (S1); decay 0.999: Table S1, whose "moving average weight 1.0 E-3" is :math:`1 - \beta` (the released
    code confirms it). ``temperature=0.25`` draws from softmax(p / 0.25) as the released code does, which flattens the
    prior and lets no skill vanish; ``None`` draws from p, as Algorithm S1 says.

    Args:
        num_skills: K, number of skills; the prior starts uniform.
        decay: beta, in [0, 1].
        temperature: of the sampling distribution, or ``None``.

    Raises:
        ValueError: if an argument is out of its range.

    Example:
        >>> prior = SkillPrior(num_skills=2, decay=0.5)
        >>> prior.update(torch.tensor([[1.0, 0.0], [1.0, 0.0]]))
        >>> prior.probabilities
        tensor([0.7500, 0.2500])
        >>> prior.sample((3,), torch.Generator().manual_seed(0)).shape
        torch.Size([3])
    """

    probabilities: Tensor

    def __init__(
        self, num_skills: int = NUM_BEHAVIOURS, decay: float = 0.999, temperature: float | None = None
    ) -> None:
        super().__init__()
        if num_skills < 1:
            raise ValueError(f"num_skills must be at least 1, got {num_skills}")
        if not 0.0 <= decay <= 1.0:
            raise ValueError(f"decay must be in [0, 1], got {decay}; it is beta, near 1, not Table S1's 1 - beta")
        if temperature is not None and temperature <= 0.0:
            raise ValueError(f"temperature must be positive or None, got {temperature}")
        self.decay = decay
        self.temperature = temperature
        self.register_buffer("probabilities", torch.full((num_skills,), 1.0 / num_skills))

    @torch.no_grad()
    def update(self, skill_probabilities: Tensor) -> None:
        """Move the prior towards the mean of Q^c on unlabelled motion (Eq. S1), in place.

        Args:
            skill_probabilities: ``[*B, K]``, Q^c of every unlabelled sample, or already averaged ``[K]``.

        Raises:
            ValueError: if the last dimension is not K.
        """
        num_skills = self.probabilities.shape[0]
        if skill_probabilities.shape[-1] != num_skills:
            raise ValueError(
                f"skill_probabilities must be [*B, {num_skills}], got {list(skill_probabilities.shape)}; "
                "pass probabilities of every skill, not logits of one"
            )
        mean = skill_probabilities.reshape(-1, num_skills).mean(0).to(self.probabilities)
        self.probabilities.lerp_(mean, 1.0 - self.decay)

    @property
    def sampling_probabilities(self) -> Tensor:
        """float32 ``[K]``, the distribution :meth:`sample` draws from."""
        if self.temperature is None:
            return self.probabilities
        return (self.probabilities / self.temperature).softmax(-1)

    def sample(self, shape: tuple[int, ...] | torch.Size = (), generator: torch.Generator | None = None) -> Tensor:
        """Draw skills.

        Args:
            shape: shape of the result.
            generator: source of randomness.

        Returns:
            int64 tensor of ``shape``.
        """
        shape = torch.Size(shape)
        draws = torch.multinomial(self.sampling_probabilities, shape.numel(), replacement=True, generator=generator)
        return draws.reshape(shape)
