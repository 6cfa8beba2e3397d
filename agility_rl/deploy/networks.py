"""Networks of artifacts: built of the sizes that a manifest states, and filled with its weights."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from torch import nn

from agility_rl.deploy.artifact import Artifact, ArtifactError

M = TypeVar("M", bound=nn.Module)


def load_network(kind: Callable[..., M], artifact: Artifact, settings: Mapping[str, Any] | None = None) -> M:
    """The network of an artifact.

    Source: no formula.

    Args:
        kind: its class.
        artifact: with an entry ``network`` in the manifest, the keyword arguments of the class.
        settings: in place of that entry.

    Raises:
        ArtifactError: if this code knows no such network, or the weights are not those of it.

    Example:
        >>> import tempfile
        >>> from agility_rl.deploy.artifact import build_manifest
        >>> manifest = build_manifest("bbc", {}, control_period=0.02, network={"in_features": 2, "out_features": 1})
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     artifact = Artifact.save(folder, nn.Linear(2, 1).state_dict(), manifest)
        >>> load_network(nn.Linear, artifact)
        Linear(in_features=2, out_features=1, bias=True)
    """
    try:
        module = kind(**(artifact.manifest["network"] if settings is None else settings))
    except (TypeError, KeyError) as error:
        made = ", ".join(f"{name} {version}" for name, version in artifact.manifest["versions"].items())
        raise ArtifactError(
            f"{artifact.folder}: this code builds no such network ({error}); it was made with {made}: use that version "
            "of agility_rl, or train it again"
        ) from error
    artifact.fill(module)
    return module
