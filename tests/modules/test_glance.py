from __future__ import annotations

import torch

from agility_rl.modules.glance import SCALES, Glance


def test_who_has_learned_nothing_says_what_was_expected() -> None:
    glance, expected = Glance(8, (4, 3, 6), legs=2), torch.randn(5, 4)
    place, scale = glance.where(torch.randn(5, 8), expected, torch.tensor([0, 1, 1, 0, 0]))
    torch.testing.assert_close(place, expected)
    assert (scale == 0.0).all() and glance.what(torch.randn(5, 8)).shape == (5, 4 + 3 + 6)


def test_it_learns_where_an_obstacle_is_and_how_sure_that_is() -> None:
    """The feature tells x, on the second leg its opposite, and nothing of y, expected 0.25 m off on average."""
    generator = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    glance = Glance(1, (1,), legs=2)
    optimizer = torch.optim.Adam(glance.correction.parameters(), lr=1e-2)
    for _ in range(400):
        draw = torch.rand(5, 256, generator=generator) * 2.0 - 1.0
        leg = (draw[4] > 0.0).long()
        truth = torch.stack((draw[0] * (1 - 2 * leg), draw[1], torch.zeros(256), torch.ones(256)), -1)
        expected = truth + torch.cat((0.5 * draw[2:4], torch.zeros(2, 256))).T
        place, scale = glance.where(draw[0][:, None], expected, leg)
        wide = torch.cat((scale, scale[:, 2:]), -1)
        distance = (place - truth).abs()
        optimizer.zero_grad()
        (distance * (-wide).exp() + wide).mean().backward()
        optimizer.step()
    assert distance[:, 0].mean() < 0.05 and 0.2 < distance[:, 1].mean() < 0.3
    assert scale.exp().mean(0)[0] < 0.08 and 0.2 < scale.exp().mean(0)[1] < 0.3


def test_it_corrects_what_is_expected_by_what_was_expected_when_the_image_was_taken() -> None:
    glance, feature, leg = Glance(8, (4,), legs=2), torch.randn(5, 8), torch.tensor([0, 1, 1, 0, 0])
    torch.nn.init.normal_(glance.correction[-1].weight)
    now, then = torch.randn(2, 5, 4)
    place, scale = glance.where(feature, now, leg, then)
    earlier, same = glance.where(feature, then, leg)
    torch.testing.assert_close(place - now, earlier - then)
    assert torch.equal(scale, same) and torch.equal(
        glance.where(feature, now, leg, now)[0], glance.where(feature, now, leg)[0]
    )


def test_the_layers_that_read_a_place_are_those_asked_for() -> None:
    glance = Glance(8, (4,), legs=2, hidden=(6, 5))
    sizes = [layer.weight.shape for layer in glance.correction if isinstance(layer, torch.nn.Linear)]
    assert sizes == [(6, 8 + 4 + 2), (5, 6), (4 + 3, 5)]
    assert [tuple(layer.weight.shape) for layer in glance.linear if hasattr(layer, "weight")] == [(4, 8)]


def test_scales_stay_within_bounds() -> None:
    glance = Glance(1, (1,), legs=1)
    for bias, expected in ((100.0, SCALES[1]), (-100.0, SCALES[0])):
        torch.nn.init.constant_(glance.correction[-1].bias, bias)
        _, scale = glance.where(torch.zeros(2, 1), torch.zeros(2, 4), torch.zeros(2, dtype=torch.long))
        assert (scale == expected).all()
