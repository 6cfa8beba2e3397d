"""Make a controller ready for a robot: a complete manifest, ONNX beside the weights, and proof that they agree.

The controller is driven in the training environment, all five behaviours, and what it saw is put through the
environment's own policy, the network of ``agility_rl.deploy`` by PyTorch, and the ONNX file by onnxruntime. Nothing is
written unless they agree. An artifact of an earlier format becomes one of the present.

In:  a run or artifact folder of a BBC.
Out: ``--output`` (the same artifact folder by default) with ``manifest.json``, ``weights-*.safetensors``,
     ``policy-*.onnx``; the ONNX file carries the manifest as metadata.

    python recipes/export.py runs/my_run [--output exported/my_bbc]

Needs the extra ``export``: pip install 'agility_rl[export]'.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import warnings
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from rollouts import Controller, drive, load_controller, make_env
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from agility_rl import keys
from agility_rl.behaviours import BEHAVIOURS, NUM_BEHAVIOURS, command_bounds
from agility_rl.deploy.artifact import CHECKSUM, Artifact, ArtifactError, build_manifest
from agility_rl.deploy.behaviour import INPUTS, OUTPUTS, BBCNetwork, example_inputs, onnx_network
from agility_rl.go2 import features
from agility_rl.training import cli

SAME_NETWORK = 1e-6
"""Largest difference of an action between the training policy and the deployed network, both by PyTorch."""
SAME_ANSWER = 1e-5
"""Largest difference of an action or an estimate between PyTorch and onnxruntime."""
_WRITTEN_ANEW = ("format", "format_version", "weights", "onnx", CHECKSUM, "limits", "normalisers")


@dataclass(frozen=True)
class Config:
    run: Annotated[Path, tyro.conf.Positional]
    """Run or artifact folder of a BBC."""
    output: Path | None = None
    """Folder to write; the artifact's own by default."""
    steps: int = 300
    """Control steps that each behaviour is driven for."""
    seed: int = 0
    """Of the start states."""


def recorded_inputs(controller: Controller, steps: int, seed: int) -> TensorDict:
    """What the controller saw, ``[steps x 5]``, in roll-outs from standing, each behaviour in mid-range (Table S2)."""
    low, high = command_bounds()
    schedule = [(steps, torch.arange(NUM_BEHAVIOURS), (low + high) / 2)]
    env = make_env(NUM_BEHAVIOURS, controller, None, num_threads=1, seed=seed)
    seen = [td.select(*INPUTS) for td in drive(controller.bbc, env, schedule)]
    env.close()
    return torch.cat(seen)  # type: ignore[arg-type]


def to_onnx(network: BBCNetwork, metadata: dict[str, Any]) -> bytes:
    """The network as an ONNX model that carries JSON values."""
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # the exporter's remarks about packages it could use
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            network,
            example_inputs(),
            input_names=list(INPUTS),
            output_names=list(OUTPUTS),
            external_data=False,
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    model.doc_string = ""  # it would name folders of this machine
    for node in model.graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    for name, value in metadata.items():
        model.metadata_props.add(key=name, value=json.dumps(value))
    return model.SerializeToString(deterministic=True)


def difference(ours: Tensor, theirs: Tensor) -> float:
    """Largest absolute difference; NaN counts as infinite."""
    return float((ours - theirs).abs().nan_to_num(torch.inf).max())


@torch.no_grad()
def check_network(controller: Controller, network: BBCNetwork, seen: TensorDict, where: Path) -> tuple[Tensor, Tensor]:
    """Actions and estimates of the deployed network, which must be the training policy's.

    Raises:
        ArtifactError: if they differ.
    """
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        trained = controller.bbc.deployable_policy()(seen.clone())
    action, estimate = network(*(seen[name] for name in INPUTS))
    worst = max(difference(action, trained[keys.ACTION]), difference(estimate, trained[keys.ESTIMATE]))
    if not worst <= SAME_NETWORK:
        raise ArtifactError(
            f"{where}: the network for deployment differs from the training policy by {worst:.2e}, expected at most "
            f"{SAME_NETWORK:.0e}; nothing was exported"
        )
    return action, estimate


def check_onnx(artifact: Artifact, seen: TensorDict, action: Tensor, estimate: Tensor) -> float:
    """Largest difference between onnxruntime and PyTorch.

    Raises:
        ArtifactError: if it is too large.
    """
    run = onnx_network(artifact)
    rows = [run(*(seen[name][index : index + 1] for name in INPUTS)) for index in range(len(seen))]
    found = torch.cat([row[0] for row in rows]), torch.cat([row[1] for row in rows])
    worst = max(difference(found[0], action), difference(found[1], estimate))
    if not worst <= SAME_ANSWER:
        raise ArtifactError(
            f"{artifact.folder}: onnxruntime and PyTorch differ by {worst:.2e} on {len(seen)} recorded inputs, "
            f"expected at most {SAME_ANSWER:.0e}; nothing was exported"
        )
    return worst


def complete_manifest(controller: Controller) -> dict[str, Any]:
    """The manifest of the training, with what the present format asks for besides."""
    trained = {k: v for k, v in controller.artifact.manifest.items() if k not in _WRITTEN_ANEW}
    for name, layout in features.CONTROLLER_LAYOUTS.items():
        controller.artifact.check_layout(name, layout)
    now = build_manifest("bbc", features.CONTROLLER_LAYOUTS, control_period=trained["control_period"])
    simulation = {"friction_loss": controller.friction_loss, **trained.get("simulation", {})}
    return {**now, **trained, "units": now["units"], "simulation": simulation, "exported_with": now["versions"]}


def main(cfg: Config) -> Path:
    """Export, check, write; returns the folder."""
    if cfg.steps < 1:
        raise ValueError(f"expected --steps of at least 1, got {cfg.steps}")
    controller = load_controller(cfg.run)
    output = controller.artifact.folder if cfg.output is None else cfg.output
    manifest = complete_manifest(controller)
    network = BBCNetwork(controller.bbc.eval().requires_grad_(False))
    seen = recorded_inputs(controller, cfg.steps, cfg.seed)
    action, estimate = check_network(controller, network, seen, controller.artifact.folder)
    weights = controller.artifact.manifest["weights"]["sha256"]
    content = to_onnx(network, {**manifest, "weights_sha256": weights})
    digest = hashlib.sha256(content).hexdigest()
    entry = {
        "file": f"policy-{digest[:16]}.onnx",
        "sha256": digest,
        "weights_sha256": weights,
        "inputs": {name: list(value.shape) for name, value in zip(INPUTS, example_inputs(), strict=True)},
        "outputs": list(OUTPUTS),
        "checked_on": f"{len(seen)} recorded inputs",
    }
    output.mkdir(parents=True, exist_ok=True)
    onnx_file = output / entry["file"]
    present = onnx_file.exists()
    onnx_file.write_bytes(content)
    trial = Artifact(controller.artifact.state, {**controller.artifact.manifest, "onnx": entry}, output)
    try:
        entry["largest_difference"] = check_onnx(trial, seen, action, estimate)
    except BaseException:
        if not present:
            onnx_file.unlink()
        raise
    artifact = Artifact.save(output, controller.artifact.state, {**manifest, "onnx": entry})
    for old in output.glob("policy-*.onnx"):
        if old.name != entry["file"]:
            old.unlink()
    if artifact.manifest["weights"]["sha256"] != weights:
        raise ArtifactError(f"{output}: the weights changed while they were written; export again")
    print(
        f"{output}: {', '.join(BEHAVIOURS)} checked on {len(seen)} recorded inputs; PyTorch and onnxruntime differ by "
        f"{entry['largest_difference']:.1e} at most (allowed {SAME_ANSWER:.0e})\n"
        f"{onnx_file.name}: {len(content) / 1e6:.2f} MB"
    )
    return output


if __name__ == "__main__":
    with cli.one_line_errors():
        main(tyro.cli(Config, description=__doc__))
