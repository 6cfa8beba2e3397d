"""Figures: what is drawn, not how it looks."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from matplotlib.image import imread

from agility_rl.record.plots import behaviour_matrix, footfall_diagram, learning_curves, save_figure, tracking_plot


def test_learning_curves() -> None:
    steps = torch.arange(4)
    runs = {
        "a": {"loss": (steps, torch.tensor([4.0, 2.0, 2.0, 2.0])), "reward": (steps, steps.double())},
        "b": {"loss": (steps, torch.ones(4))},
    }
    figure = learning_curves(runs, ["loss", "reward"], smoothing=0.5)
    loss, reward = figure.axes
    assert loss.get_title() == "loss" and len(loss.lines) == 4 and len(reward.lines) == 2
    assert list(loss.lines[1].get_ydata()) == [4.0, 3.0, 2.5, 2.25]
    only = learning_curves({"a": {"loss": (steps[:1], torch.ones(1))}}, ["loss"])
    assert only.axes[0].lines[0].get_marker() == "."
    gap = torch.tensor([0.0, 2.0, float("nan"), 2.0])
    line = learning_curves({"a": {"loss": (steps, gap)}}, ["loss"], smoothing=0.5).axes[0].lines[1]
    assert line.get_ydata()[[0, 1, 3]].tolist() == [0.0, 1.0, 1.5]
    with pytest.raises(ValueError, match="no run has any of nothing_like_it; they have loss, reward"):
        learning_curves(runs, ["nothing_like_it"])


def test_footfall_bars_are_the_stances() -> None:
    contact = torch.tensor([[1, 0, 1, 0], [1, 0, 0, 0], [0, 0, 1, 0], [1, 0, 1, 0]]).bool()
    bars = footfall_diagram(contact, dt=0.5).axes[0].patches
    drawn = sorted((round(b.get_y() + b.get_height() / 2), b.get_x(), b.get_width()) for b in bars)
    assert drawn == [(0, 0.0, 1.0), (0, 1.5, 0.5), (2, 0.0, 0.5), (2, 1.0, 1.0)]
    with pytest.raises(ValueError, match=r"expected contacts \[T, 4\], got \[4\]"):
        footfall_diagram(contact[0], dt=0.5)


def test_behaviour_matrix_shows_shares_of_rows() -> None:
    figure = behaviour_matrix(torch.tensor([[3, 1, 0], [0, 0, 0]]), ["walk", "trot"], ["walk", "trot", "other"])
    assert [text.get_text() for text in figure.axes[0].texts] == ["0.75", "0.25", "0.00", "0.00", "0.00", "0.00"]
    with pytest.raises(ValueError, match=r"expected counts \[2, 2\]"):
        behaviour_matrix(torch.ones(3, 3), ["walk", "trot"])


def test_tracking_plot() -> None:
    time = torch.arange(10.0)
    figure = tracking_plot({"v": time, "w": time}, {"v": time, "w": time + 2.0, "x": time}, dt=0.02)
    assert [axes.get_title() for axes in figure.axes] == ["v, RMS error 0.000", "w, RMS error 2.000"]
    assert tracking_plot({"v": time}, {"v": time}, 0.02, peaks=["v"]).axes[0].get_title() == "v, peaks commanded"
    with pytest.raises(KeyError, match="not measured"):
        tracking_plot({"v": time}, {}, dt=0.02)


def test_a_saved_figure_is_a_picture(tmp_path: Path) -> None:
    path = save_figure(footfall_diagram(torch.eye(4).bool(), dt=0.02, title="trot"), tmp_path / "figures" / "f.png")
    picture = imread(path)
    assert picture.ndim == 3 and picture.std() > 0.05
