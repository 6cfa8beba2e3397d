"""The artifact: exact, atomic, and every kind of tampering or mismatch is refused with a reason."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from agility_rl.deploy.artifact import REQUIRED, Artifact, ArtifactError, build_manifest, describe_layout
from agility_rl.go2 import constants

LAYOUT = (("roll_pitch", 2, "rad", 1.0, 0.01), ("last_action", 12, "action units"))


@pytest.fixture
def manifest() -> dict[str, Any]:
    return build_manifest(
        "bbc", {"proprioception": LAYOUT}, control_period=0.02, data=["synthetic gaits"], hidden=[8, 4]
    )


def state() -> dict[str, torch.Tensor]:
    return {
        "actor.weight": torch.arange(6.0).reshape(2, 3).t(),
        "actor.bias": torch.zeros(3),
        "norm.count": torch.tensor(5),
    }


def test_round_trip(tmp_path: Path, manifest: dict[str, Any]) -> None:
    saved = Artifact.save(tmp_path / "policy", state(), manifest)
    loaded = Artifact.load(tmp_path / "policy", kind="bbc")
    assert loaded.manifest == saved.manifest and set(REQUIRED) <= set(loaded.manifest)
    for name, tensor in state().items():
        assert torch.equal(loaded.state[name], tensor) and loaded.state[name].dtype == tensor.dtype
    assert loaded.manifest["hidden"] == [8, 4] and loaded.manifest["data"] == ["synthetic gaits"]
    assert loaded.manifest["stiffness"] == [constants.STIFFNESS] * 12
    assert loaded.manifest["default_pose"] == pytest.approx(list(constants.DEFAULT_POSE))
    assert loaded.manifest["joint_names"] == list(constants.JOINT_NAMES)
    assert loaded.manifest["observations"]["proprioception"] == describe_layout(LAYOUT)
    assert set(loaded.part("actor")) == {"weight", "bias"}


def test_shared_tensors_and_parameters_are_saved(tmp_path: Path, manifest: dict[str, Any]) -> None:
    weight = torch.nn.Parameter(torch.ones(3))
    loaded = Artifact.save(tmp_path, {"a": weight, "b": weight}, manifest)
    assert not loaded.state["a"].requires_grad and torch.equal(Artifact.load(tmp_path).state["b"], torch.ones(3))


def test_saving_again_replaces_in_one_step(tmp_path: Path, manifest: dict[str, Any]) -> None:
    Artifact.save(tmp_path, state(), manifest)
    old_manifest = (tmp_path / "manifest.json").read_bytes()
    old_weights = next(tmp_path.glob("weights-*")).name
    (tmp_path / "kept.txt").write_text("mine")
    Artifact.save(tmp_path, {"actor.bias": torch.ones(3)}, manifest)
    assert len(list(tmp_path.glob("weights-*"))) == 1 and not (tmp_path / old_weights).exists()
    assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith(".")) == []
    assert (tmp_path / "manifest.json").read_bytes() != old_manifest and (tmp_path / "kept.txt").exists()


KILLER = """
import os, sys
import torch
from agility_rl.deploy.artifact import Artifact, build_manifest
folder, manifest = sys.argv[1], build_manifest("bbc", {}, control_period=0.02)
Artifact.save(folder, {"x": torch.full((4,), 0.0)}, manifest)
fatal, survivor = 0, 0.0
while True:
    fatal += 1
    child = os.fork()
    if child == 0:
        count = 0
        def hook(event, arguments):
            global count
            writes = event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR)
            if writes or event in ("os.mkdir", "os.rename", "os.remove"):
                count += 1
                if count == fatal:
                    os._exit(9)
        sys.addaudithook(hook)
        Artifact.save(folder, {"x": torch.full((4,), float(fatal))}, manifest)
        os._exit(0)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    x = Artifact.load(folder).state["x"].unique().tolist()
    assert x in ([survivor], [float(fatal)]), (fatal, x)
    survivor = x[0]
    if status == 0:
        break
assert survivor == fatal and fatal > 4
assert len(os.listdir(folder)) == 2, os.listdir(folder)
"""


def test_a_process_killed_at_any_file_operation_leaves_a_loadable_artifact(tmp_path: Path) -> None:
    command = [sys.executable, "-W", "ignore", "-c", KILLER, str(tmp_path)]
    repository = Path(__file__).parents[2]
    result = subprocess.run(
        command, capture_output=True, text=True, cwd=repository, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=False
    )
    assert result.returncode == 0, result.stderr


def tamper(folder: Path, **changes: Any) -> None:
    path = folder / "manifest.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joint_names": [*constants.JOINT_NAMES[3:], *constants.JOINT_NAMES[:3]]}, "the same joints in another order"),
        ({"joint_names": ["a"] * 12}, "names other joints"),
        ({"format": "other"}, "describes no agility_rl.artifact"),
        ({"format_version": 3}, "has format version 3, expected 1 or 2; .* use that version of agility_rl"),
        ({"stiffness": [40.0] * 11}, "stiffness must be 12 finite numbers"),
        ({"damping": [float("nan")] * 12}, "damping must be 12 finite numbers"),
        ({"control_period": "0.02"}, r"manifest.json is damaged: .*; export the policy again"),
        ({"limits": None}, r"manifest.json is damaged: "),
        ({"default_pose": ["x"] * 12}, r"manifest.json is damaged: "),
        ({"control_period": 20}, r"control_period must be in \(0, 1\] s, got 20"),
        ({"stiffness": [-40.0] * 12}, "stiffness must be positive"),
        ({"damping": [-1.0] * 12}, "damping must not be negative"),
        ({"default_pose": [0.0, 0.9, 1.8] * 4}, "default_pose of FL_calf_joint is 1.8, outside its stops"),
        ({"limits": {}}, "limits lack joint_lower"),
        ({"normalisers": {}}, "the controller was trained with method None"),
        ({"stiffness": [41.0] * 12}, r"manifest.json was altered: its entries have the checksum"),
        ({"note": "harmless"}, r"manifest.json was altered"),
        ({"manifest_sha256": None}, r"was altered.*expected None; copy it again"),
    ],
)
def test_a_manifest_that_does_not_fit_is_refused(
    tmp_path: Path, manifest: dict[str, Any], changes: dict[str, Any], message: str
) -> None:
    Artifact.save(tmp_path, state(), manifest)
    tamper(tmp_path, **changes)
    with pytest.raises(ArtifactError, match=message) as error:
        Artifact.load(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", REQUIRED)
def test_every_required_entry_is_required(tmp_path: Path, manifest: dict[str, Any], name: str) -> None:
    del manifest[name]
    with pytest.raises(ArtifactError, match=f"lacks {name}; make it with build_manifest"):
        Artifact.save(tmp_path, state(), manifest)
    assert not list(tmp_path.iterdir()), "nothing was written"


def as_version_1(folder: Path) -> None:
    """What agility_rl wrote before limits, normalisers and the manifest's checksum were part of it."""
    path = folder / "manifest.json"
    manifest = json.loads(path.read_text())
    for name in ("limits", "normalisers", "manifest_sha256"):
        del manifest[name]
    path.write_text(json.dumps({**manifest, "format_version": 1}))


def test_version_1_is_still_read(tmp_path: Path, manifest: dict[str, Any]) -> None:
    Artifact.save(tmp_path, state(), manifest)
    as_version_1(tmp_path)
    loaded = Artifact.load(tmp_path, kind="bbc")
    assert loaded.manifest["format_version"] == 1
    assert loaded.manifest["limits"]["joint_torque"] == list(constants.TORQUE_LIMIT)
    assert loaded.manifest["normalisers"] == manifest["normalisers"]


@pytest.mark.parametrize("weights", [{}, {"file": "../x.safetensors"}])
def test_weights_elsewhere_are_refused(tmp_path: Path, manifest: dict[str, Any], weights: dict[str, str]) -> None:
    Artifact.save(tmp_path, state(), manifest)
    as_version_1(tmp_path)  # where no checksum speaks first
    tamper(tmp_path, weights=weights)
    with pytest.raises(ArtifactError, match="weights must be a file beside the manifest"):
        Artifact.load(tmp_path)


def test_spaces_in_the_manifest_do_not_count(tmp_path: Path, manifest: dict[str, Any]) -> None:
    Artifact.save(tmp_path, state(), manifest)
    tamper(tmp_path)  # rewrites it without indentation
    assert Artifact.load(tmp_path).manifest["kind"] == "bbc"


def test_damaged_weights_are_refused(tmp_path: Path, manifest: dict[str, Any]) -> None:
    Artifact.save(tmp_path, state(), manifest)
    path = next(tmp_path.glob("weights-*"))
    content = path.read_bytes()
    for damaged in (content[:-1], b"", content[:-1] + bytes([content[-1] ^ 1])):
        path.write_bytes(damaged)
        with pytest.raises(ArtifactError, match="truncated or altered; copy it again"):
            Artifact.load(tmp_path)
    path.unlink()
    with pytest.raises(FileNotFoundError, match="copy the whole folder"):
        Artifact.load(tmp_path)


def test_a_run_is_as_good_as_its_policy(tmp_path: Path, manifest: dict[str, Any]) -> None:
    saved = Artifact.save(tmp_path / "policy", state(), manifest)
    found = Artifact.load(tmp_path, kind=manifest["kind"])
    assert found.folder == saved.folder == tmp_path / "policy" and found.manifest == saved.manifest


def test_other_errors(tmp_path: Path, manifest: dict[str, Any]) -> None:
    with pytest.raises(FileNotFoundError, match=r"give the policy/ folder of a run"):
        Artifact.load(tmp_path)
    with pytest.raises(ArtifactError, match=r"'actor.bias' holds NaN or infinity"):
        Artifact.save(tmp_path, {"actor.bias": torch.tensor([float("nan")])}, manifest)
    with pytest.raises(ArtifactError, match="at least one tensor"):
        Artifact.save(tmp_path, {}, manifest)
    artifact = Artifact.save(tmp_path, state(), manifest)
    with pytest.raises(ArtifactError, match="expected an artifact of kind 'student', got 'bbc'"):
        Artifact.load(tmp_path, kind="student")
    with pytest.raises(ArtifactError, match="has no part 'critic'; it has actor, norm"):
        artifact.part("critic")
    (tmp_path / "manifest.json").write_text("{")
    with pytest.raises(ArtifactError, match=r"manifest.json is damaged"):
        Artifact.load(tmp_path)


def test_the_observation_layout_is_compared(tmp_path: Path, manifest: dict[str, Any]) -> None:
    artifact = Artifact.save(tmp_path, state(), manifest)
    artifact.check_layout("proprioception", LAYOUT)
    with pytest.raises(ArtifactError, match=r"entry 0: the controller was trained with .*'size': 2.*'size': 3"):
        artifact.check_layout("proprioception", [("roll_pitch", 3, "rad")])
    with pytest.raises(ArtifactError, match="trained with 2 entries, this code gives 1"):
        artifact.check_layout("proprioception", LAYOUT[:1])
    with pytest.raises(ArtifactError, match="expects no observation 'depth', only proprioception"):
        artifact.check_layout("depth", LAYOUT)


def test_weights_fill_a_module_or_are_refused_in_one_line(tmp_path: Path) -> None:
    module, weight = nn.Linear(2, 1, bias=False), torch.tensor([[3.0, 4.0]])
    Artifact({"weight": weight}, {}, tmp_path).fill(module)
    assert torch.equal(module.weight, weight)
    for state in ({"weight": torch.ones(1, 3)}, {"other": weight}):
        with pytest.raises(ArtifactError, match="the weights are not those of the expected network") as caught:
            Artifact(state, {}, tmp_path).fill(module)
        assert str(tmp_path) in str(caught.value) and "\n" not in str(caught.value)
