"""Networks of an artifact by onnxruntime: the file that was checked at the export, and no other."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from agility_rl.deploy.artifact import Artifact, ArtifactError


def onnx_session(
    artifact: Artifact, inputs: Sequence[str], outputs: Sequence[str]
) -> Callable[..., tuple[Tensor, ...]]:
    """The network of an artifact, on one thread: tensors in, tensors out, in the given orders.

    Args:
        artifact: whose manifest has an entry ``onnx`` (``recipes/export.py``).
        inputs: names of the inputs.
        outputs: names of the outputs.

    Raises:
        ArtifactError: if the artifact has no ONNX file, or it is not the one that was checked at the export.
        ImportError: if onnxruntime is not installed.

    Example:
        >>> onnx_session(Artifact({}, {}, Path("nowhere")), ["x"], ["y"])
        Traceback (most recent call last):
        ...
        agility_rl.deploy.artifact.ArtifactError: nowhere has no ONNX file beside the manifest; write it with \
recipes/export.py
    """
    entry: dict[str, Any] = artifact.manifest.get("onnx", {})
    name = str(entry.get("file", ""))
    if not name or Path(name).name != name or not (artifact.folder / name).is_file():
        raise ArtifactError(f"{artifact.folder} has no ONNX file beside the manifest; write it with recipes/export.py")
    content = (artifact.folder / name).read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if digest != entry.get("sha256") or entry.get("weights_sha256") != artifact.manifest["weights"]["sha256"]:
        raise ArtifactError(
            f"{artifact.folder / name} has SHA-256 {digest[:12]}, expected {str(entry.get('sha256'))[:12]} made from "
            f"weights {artifact.manifest['weights']['sha256'][:12]}: altered, or of another training; export it again"
        )
    try:
        import onnxruntime
    except ImportError as error:
        raise ImportError("ONNX files need onnxruntime: pip install 'agility_rl[deploy]'") from error

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])

    def network(*values: Tensor) -> tuple[Tensor, ...]:
        feed = {name: value.numpy() for name, value in zip(inputs, values, strict=True)}
        return tuple(torch.from_numpy(found) for found in session.run(list(outputs), feed))

    return network
