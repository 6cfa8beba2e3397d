"""Figures of courses: what is drawn and where, not how it looks."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.image import imread
from matplotlib.patches import Circle, Polygon

from agility_rl.record.course_plots import BEHAVIOUR_COLOURS, PlanView, behaviour_use, plan_view
from agility_rl.record.plots import save_figure
from agility_rl.record.scene import Shape


def view(success: bool = True, **changes: object) -> PlanView:
    path = torch.stack((torch.ones(31), torch.linspace(0.5, 3.5, 31)), -1)
    behaviour = torch.tensor([2] * 10 + [4] * 20)
    bar = Shape("box", (1.2, 0.06, 0.06), (1.0, 2.0, 0.1))
    fields = {
        "size": (2.0, 4.0),
        "shapes": [bar],
        "labels": [("bar", (1.5, 2.0), 1.5)],
        "goals": torch.tensor([[1.0, 1.0], [1.0, 3.0]]),
        "goal_radius": 0.45,
        "path": path,
        "behaviour": behaviour,
        "success": success,
    }
    return PlanView(**(fields | changes))


def test_a_plan_view_draws_the_path_in_the_colours_of_its_behaviours() -> None:
    hits = torch.tensor([[1.0, 2.0]])
    figure = plan_view([view(title="one"), view(False, title="two", collisions=hits)])
    one, two = figure.axes
    assert (one.get_title(), two.get_title()) == ("one", "two")
    lines = next(item for item in one.collections if isinstance(item, LineCollection))
    colours = [tuple(colour) for colour in lines.get_colors()]
    assert colours == [to_rgba(BEHAVIOUR_COLOURS[index]) for index in [2] * 10 + [4] * 20]
    assert lines.get_segments()[9].tolist() == pytest.approx(torch.tensor([[1.0, 1.4], [1.0, 1.5]]).numpy())
    bars = [patch for patch in one.patches if isinstance(patch, Polygon)]
    assert len(bars) == 1 and bars[0].get_xy().max(0) == pytest.approx([1.6, 2.03])
    rings = [patch for patch in one.patches if isinstance(patch, Circle)]
    assert [(*ring.center, ring.radius) for ring in rings] == [(1.0, 1.0, 0.45), (1.0, 3.0, 0.45)]
    assert one.get_aspect() == 1.0, "to scale"
    legend = {text.get_text() for text in figure.legends[0].get_texts()}
    assert legend == {"trot", "jump", "start", "way-point", "passed", "failed", "leg hits something"}
    assert "failed" not in {text.get_text() for text in plan_view([view()]).legends[0].get_texts()}


def test_labels_are_never_upside_down() -> None:
    for degrees in (-175.0, -90.0, 0.0, 85.0, 95.0, 180.0):
        figure = plan_view([view(labels=[("bar", (1.0, 1.0), math.radians(degrees))])])
        turn = figure.axes[0].texts[0].get_rotation() % 360.0
        assert turn <= 100.0 + 1e-6 or turn >= 280.0 - 1e-6, degrees
        assert (turn - degrees) % 180.0 == pytest.approx(0.0, abs=1e-6) or (turn - degrees) % 180.0 > 179.999


def test_behaviour_use_by_hand() -> None:
    rows = {"tunnel": torch.tensor([0.0, 0.0, 3.0, 1.0, 0.0]), "box": torch.tensor([0.0, 0.0, 0.0, 0.1, 4.9])}
    axes = behaviour_use(rows).axes[0]
    drawn = [
        (round(bar.get_y() + 0.36), round(bar.get_x(), 3), round(bar.get_width(), 3), bar.get_facecolor())
        for bar in axes.patches
    ]
    trot, canter, jump = (to_rgba(BEHAVIOUR_COLOURS[index]) for index in (2, 3, 4))
    assert drawn == [(0, 0.0, 0.75, trot), (0, 0.75, 0.25, canter), (1, 0.0, 0.02, canter), (1, 0.02, 0.98, jump)]
    assert [text.get_text() for text in axes.texts] == ["0.75", "0.25", "0.98"], "no number in a sliver"


def test_what_cannot_be_drawn_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one episode"):
        plan_view([])
    with pytest.raises(ValueError, match=r"expected a path \[31, 2\], one point more than behaviours, got \[30, 2\]"):
        view(path=torch.zeros(30, 2))
    with pytest.raises(ValueError, match="at least one row of 5 numbers, got none"):
        behaviour_use({})
    with pytest.raises(ValueError, match=r"\{'tunnel': \[4\]\}"):
        behaviour_use({"tunnel": torch.ones(4)})


def test_a_saved_plan_is_a_picture(tmp_path: Path) -> None:
    picture = imread(save_figure(plan_view([view()]), tmp_path / "plan.png"))
    assert picture.ndim == 3 and picture.std() > 0.05
