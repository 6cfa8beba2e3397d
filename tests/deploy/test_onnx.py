"""The ONNX file of an artifact: the one that was checked, in the order that was asked for, and no other."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from agility_rl.deploy.artifact import Artifact, ArtifactError
from agility_rl.deploy.onnx import onnx_session

onnx = pytest.importorskip("onnx")


@pytest.fixture
def exported(artifact: Artifact) -> Artifact:
    """An artifact with a network of two inputs: their sum, and twice the first."""
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    values = {name: helper.make_tensor_value_info(name, kind, [1, 3]) for name in ("a", "b", "sum", "twice")}
    nodes = [helper.make_node("Add", ["a", "b"], ["sum"]), helper.make_node("Add", ["a", "a"], ["twice"])]
    graph = helper.make_graph(nodes, "net", [values["a"], values["b"]], [values["sum"], values["twice"]])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 9
    content = model.SerializeToString()
    (artifact.folder / "policy.onnx").write_bytes(content)
    entry = {"file": "policy.onnx", "sha256": hashlib.sha256(content).hexdigest()}
    entry["weights_sha256"] = artifact.manifest["weights"]["sha256"]
    return replace(artifact, manifest={**artifact.manifest, "onnx": entry})


def test_tensors_go_in_and_come_out_in_the_orders_asked_for(exported: Artifact) -> None:
    a, b = torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[10.0, 20.0, 30.0]])
    total, twice = onnx_session(exported, ("a", "b"), ("sum", "twice"))(a, b)
    assert total.tolist() == [[11.0, 22.0, 33.0]] and twice.tolist() == [[2.0, 4.0, 6.0]]
    twice, total = onnx_session(exported, ("b", "a"), ("twice", "sum"))(a, b)
    assert total.tolist() == [[11.0, 22.0, 33.0]] and twice.tolist() == [[20.0, 40.0, 60.0]]


def test_another_file_than_the_one_that_was_checked_is_refused(exported: Artifact) -> None:
    names = ("a", "b"), ("sum",)
    entry = exported.manifest["onnx"]
    for changes in ({"weights_sha256": "another"}, {"sha256": "another"}):
        with pytest.raises(ArtifactError, match="altered, or of another training; export it again"):
            onnx_session(replace(exported, manifest={**exported.manifest, "onnx": {**entry, **changes}}), *names)
    with (exported.folder / "policy.onnx").open("ab") as file:
        file.write(b" ")
    with pytest.raises(ArtifactError, match="altered, or of another training; export it again"):
        onnx_session(exported, *names)


@pytest.mark.parametrize("file", ["", "missing.onnx", "../policy/policy.onnx"])
def test_a_file_that_is_missing_or_elsewhere_is_refused(exported: Artifact, file: str) -> None:
    entry = {**exported.manifest["onnx"], "file": file}
    assert Path(exported.folder / "policy.onnx").is_file()
    with pytest.raises(ArtifactError, match="has no ONNX file beside the manifest"):
        onnx_session(replace(exported, manifest={**exported.manifest, "onnx": entry}), ("a", "b"), ("sum",))
