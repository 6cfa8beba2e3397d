from __future__ import annotations

import pytest

from agility_rl.losses.reduction import check_reduction


def test_only_reductions_that_need_no_common_shape() -> None:
    assert [check_reduction(r) for r in (None, "mean", "sum")] == ["mean", "mean", "sum"]
    with pytest.raises(ValueError, match="'none'"):
        check_reduction("none")
