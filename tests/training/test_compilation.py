"""What cannot be compiled is refused before it is called; what shall not be stays as it is."""

from __future__ import annotations

import pytest
import torch

from agility_rl.training.compilation import compiled


def test_a_machine_without_a_compiler_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(ValueError, match=r"found no no-such-compiler; .*--ppo\.no-compile"):
        compiled(torch.sin, True)
    assert compiled(torch.sin, False) is torch.sin


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::FutureWarning")  # torch's compiler, of torch itself
def test_what_is_compiled_does_the_same() -> None:
    module, inputs = torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.ELU()), torch.randn(5, 3)
    faster = compiled(module, True)
    assert faster is not module
    torch.testing.assert_close(faster(inputs), module(inputs))
