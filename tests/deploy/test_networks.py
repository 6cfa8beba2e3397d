"""Networks of artifacts: what was saved is what is built, and what cannot be built is said."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from agility_rl.deploy.artifact import Artifact, ArtifactError, build_manifest
from agility_rl.deploy.networks import load_network
from agility_rl.modules import BasicBehaviourController


def saved(folder: Path, **settings: object) -> Artifact:
    bbc = BasicBehaviourController(hidden=(8,))
    manifest = build_manifest("bbc", {}, control_period=0.02, network={**bbc.settings, **settings})
    return Artifact.save(folder, bbc.state_dict(), manifest)


def test_it_has_the_sizes_and_weights_that_were_saved(tmp_path: Path) -> None:
    artifact = saved(tmp_path)
    found = load_network(BasicBehaviourController, artifact)
    assert isinstance(found, BasicBehaviourController) and found.settings["hidden"] == [8]
    assert all(torch.equal(value, artifact.state[name]) for name, value in found.state_dict().items())


def test_settings_of_another_release_are_named_with_what_made_them(tmp_path: Path) -> None:
    message = r"builds no such network \(.*'wings'\); it was made with agility_rl .*, torch .*: use that version"
    with pytest.raises(ArtifactError, match=message):
        load_network(BasicBehaviourController, saved(tmp_path, wings=2))


def test_weights_of_other_sizes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError):
        load_network(BasicBehaviourController, saved(tmp_path), {"hidden": (9,)})
