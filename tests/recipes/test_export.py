"""The export: complete, checked against the training policy and onnxruntime, and refused where they differ."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from agility_rl.deploy.artifact import Artifact, ArtifactError
from agility_rl.deploy.behaviour import onnx_network, torch_network
from agility_rl.deploy.task import onnx_student, torch_student

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxscript")
Module = Callable[[str], ModuleType]


@pytest.fixture
def export(module: Module) -> ModuleType:
    return module("export")


def as_version_1(run: Path) -> None:
    path = run / "policy" / "manifest.json"
    manifest = json.loads(path.read_text())
    for name in ("limits", "normalisers", "manifest_sha256"):
        del manifest[name]
    path.write_text(json.dumps({**manifest, "format_version": 1}))


def test_an_export_keeps_the_limits_of_an_artifact(export: ModuleType, untrained: Path) -> None:
    before = Artifact.load(untrained / "policy")
    slow = {**before.manifest["limits"], "joint_speed": [5.0] * 12}
    Artifact.save(before.folder, before.state, {**before.manifest, "limits": slow})
    export.main(export.Config(untrained, steps=8))
    assert Artifact.load(before.folder).manifest["limits"] == slow


def test_an_export_in_place_completes_an_old_artifact(export: ModuleType, untrained: Path) -> None:
    as_version_1(untrained)
    before = Artifact.load(untrained / "policy")
    folder = export.main(export.Config(untrained, steps=8))
    assert folder == untrained / "policy"
    artifact = Artifact.load(folder, kind="bbc")
    assert artifact.manifest["format_version"] == 2
    assert artifact.manifest["weights"] == before.manifest["weights"]
    assert (
        artifact.manifest["versions"] == before.manifest["versions"] and "torch" in artifact.manifest["exported_with"]
    )
    entry = artifact.manifest["onnx"]
    assert entry["checked_on"] == "40 recorded inputs" and entry["largest_difference"] <= 1e-5
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        ["manifest.json", entry["file"], artifact.manifest["weights"]["file"]]
    )
    # On inputs that the check has not seen, and with the contract inside the file.
    generator = torch.Generator().manual_seed(7)
    inputs = [torch.randn(1, *shape, generator=generator) for shape in ((45,), (10, 45), (11,), (1,))]
    for ours, theirs in zip(torch_network(artifact)(*inputs), onnx_network(artifact)(*inputs), strict=True):
        assert (ours - theirs).abs().max() <= 1e-5
    metadata = {entry.key: json.loads(entry.value) for entry in onnx.load(folder / entry["file"]).metadata_props}
    assert metadata["joint_names"][0] == "FL_hip_joint" and metadata["stiffness"] == [40.0] * 12
    assert metadata["weights_sha256"] == artifact.manifest["weights"]["sha256"]
    assert str(folder) not in (folder / entry["file"]).read_bytes().decode("latin-1")


def test_a_mismatch_is_refused_and_nothing_is_written(
    export: ModuleType, untrained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    convert = export.to_onnx

    def of_another_network(exportable: Any, metadata: dict) -> bytes:
        other = copy.deepcopy(exportable.network)
        other.mean.layers[-1].bias += 2e-5
        return convert(replace(exportable, network=other), metadata)

    monkeypatch.setattr(export, "to_onnx", of_another_network)
    output = tmp_path / "exported"
    with pytest.raises(ArtifactError, match=r"onnxruntime and PyTorch differ by 2\.\d\de-05 on 10 recorded inputs"):
        export.main(export.Config(untrained, output=output, steps=2))
    assert list(output.iterdir()) == []


def test_a_network_that_is_not_the_trained_policy_is_refused(export: ModuleType, untrained: Path) -> None:
    exportable = export.controller_to_export(export.Config(untrained, steps=2))
    network = copy.deepcopy(exportable.network)
    with torch.no_grad():
        network.mean.layers[-1].bias += 1e-5
    with pytest.raises(ArtifactError, match=r"differs from the training policy by 1\.0"):
        export.check_network(replace(exportable, network=network))


def test_differences_count_as_shares_of_large_outputs(export: ModuleType) -> None:
    ours, theirs = torch.tensor([0.5, 20.0]), torch.tensor([0.5, 20.4])
    assert export.difference([ours], [theirs]) == pytest.approx(0.4 / 20.4)
    assert export.difference([ours], [ours - 0.25]) == 0.25
    assert export.difference([ours * float("nan")], [theirs]) == float("inf")


def test_a_student_is_exported_with_its_memory(
    export: ModuleType, untrained: Path, make_student: Callable[..., Path], tmp_path: Path
) -> None:
    run, output = make_student(), tmp_path / "exported"
    assert export.main(export.Config(run, bbc=untrained, output=output, steps=12)) == output
    artifact = Artifact.load(output, kind="student")
    entry = artifact.manifest["onnx"]
    assert entry["checked_on"] == "48 recorded inputs" and entry["largest_difference"] <= 1e-5
    assert entry["inputs"] == {
        "depth": [1, 58, 87],
        "image_age": [1, 1],
        "proprioception": [1, 45],
        "history": [1, 10, 45],
        "hidden": [1, 55],
    }
    assert artifact.manifest["camera"] == Artifact.load(run).manifest["camera"]
    generator = torch.Generator().manual_seed(7)
    networks = torch_student(artifact), onnx_student(artifact)
    memories = [torch.zeros(1, 55), torch.zeros(1, 55)]
    for _ in range(20):  # the memory does not drift apart
        depth = torch.rand(1, 58, 87, generator=generator) - 0.5
        age = 0.1 * torch.rand(1, 1, generator=generator)
        rest = [torch.randn(1, *shape, generator=generator) for shape in ((45,), (10, 45))]
        answers = [net(depth, age, *rest, memory) for net, memory in zip(networks, memories, strict=True)]
        ours, theirs = answers
        assert export.difference(ours[:-1], theirs[:-1]) <= 1e-5
        # The logarithm of a belief moves by 50 for each metre, of which float32 rounds 4 to 2.4e-7 at every step.
        assert export.difference(ours[-1:], theirs[-1:]) <= export.SAME_DECISION
        memories = [answer[-1] for answer in answers]
    with pytest.raises(ArtifactError, match="no ONNX file beside the manifest"):
        onnx_student(Artifact.load(run))


def test_the_shipped_student_is_exported(export: ModuleType, repository: Path, tmp_path: Path) -> None:
    """Trained weights round more coarsely than random ones; what differs in a batch is refused all the same."""
    output = tmp_path / "exported"
    assert export.main(export.Config(repository / "pretrained" / "student_leaping", output=output, steps=60)) == output
    entry = Artifact.load(output, kind="student").manifest["onnx"]
    assert entry["checked_on"] == "240 recorded inputs" and 0.0 < entry["largest_difference"] <= export.SAME_DECISION
    exportable = export.student_to_export(export.Config(repository / "pretrained" / "student_leaping", steps=4))
    shifted = replace(exportable, expected=tuple(values + 2e-5 for values in exportable.expected))
    with pytest.raises(ArtifactError, match=r"differs from the training policy by .*, expected at most 1e-05"):
        export.check_network(shifted)


def test_neither_another_artifact_nor_a_run_is_exported_over(
    export: ModuleType, untrained: Path, repository: Path, tmp_path: Path
) -> None:
    other = shutil.copytree(repository / "pretrained" / "bbc", tmp_path / "other")
    before = {path.name: path.stat().st_mtime_ns for path in other.iterdir()}
    for folder in (other, untrained):
        with pytest.raises(FileExistsError, match=f"--output {folder} holds another policy already"):
            export.main(export.Config(untrained, output=folder, steps=2))
    assert {path.name: path.stat().st_mtime_ns for path in other.iterdir()} == before
    assert not (untrained / "manifest.json").exists()


def test_steps_must_be_positive(export: ModuleType, untrained: Path) -> None:
    with pytest.raises(ValueError, match="--steps of at least 1"):
        export.main(export.Config(untrained, steps=0))
