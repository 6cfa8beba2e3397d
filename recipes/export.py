"""Make a controller or a student ready for a robot: a complete manifest, ONNX and weights, and proof that they agree.

It is driven in the training environment (a controller in all five behaviours, a student over its course), what it saw
is put through the training's own policy, the network of ``agility_rl.deploy`` by PyTorch, and the ONNX file by
onnxruntime. Nothing is written unless they agree. An artifact of an earlier format becomes one of the present.

In:  a run or artifact folder of a BBC or of a student.
Out: ``--output`` (by default the same folder): ``manifest.json``, weights, ``policy-*.onnx`` with the manifest in it.

    python recipes/export.py runs/my_run [--output exported/my_bbc]
    python recipes/export.py runs/my_student --bbc pretrained/bbc_leaping

Needs the extra ``export``: pip install 'agility_rl[export]'.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from rollouts import Controller, drive, load_controller, make_env
from student_rollout import SAID, recorded_steps
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from tsc_artifacts import load_trained

from agility_rl import keys
from agility_rl.behaviours import BEHAVIOURS, NUM_BEHAVIOURS, command_bounds
from agility_rl.deploy import behaviour, task
from agility_rl.deploy.artifact import CHECKSUM, MANIFEST_FILE, Artifact, ArtifactError, build_manifest
from agility_rl.go2 import features
from agility_rl.modules import RecurrentStudent
from agility_rl.training import cli
from agility_rl.training.checkpoint import publish

SAME_ANSWER = 1e-5
"""Largest difference of an output between the training policy and the deployed network, and between that by PyTorch and
by onnxruntime, as a share of the output where that is above one: float32 sums of a batch and of one row, or of two
libraries, are rounded differently, and a logit of 20 is rounded more coarsely than a probability."""
SAME_DECISION = 1e-4
"""The same of a student where rows are answered one by one, or by onnxruntime: each of its features is a sum of tens of
thousands of products, which is rounded otherwise than in a batch. In a batch it must be :data:`SAME_ANSWER`."""
BATCH = 64
_WRITTEN_ANEW = ("format", "format_version", "weights", "onnx", CHECKSUM)


@dataclass(frozen=True)
class Config:
    run: Annotated[Path, tyro.conf.Positional]
    """Run or artifact folder of a BBC or student."""
    output: Path | None = None
    """Folder to write; the artifact's own by default."""
    bbc: Path | None = None
    """With a student: folder of the controller of its training, where its run does not say so."""
    steps: int = 300
    """Control steps that each behaviour is driven for; of a student, decisions."""
    seed: int = 0
    """Of the start states."""


@dataclass(frozen=True)
class Exportable:
    """A network, and what it has to answer.

    Attributes:
        artifact: where it comes from.
        network: for deployment.
        inputs: names of its inputs.
        outputs: names of its outputs.
        example: one row of inputs.
        seen: inputs ``[M, ...]`` that were recorded.
        expected: what the training's own policy answered to them.
        by_onnx: the same network of an artifact with an ONNX file.
        facts: what the manifest has to say besides.
        what: to print.
        allowed: largest difference (:func:`difference`) where rows are answered one by one, or by onnxruntime.
    """

    artifact: Artifact
    network: nn.Module
    inputs: Sequence[str]
    outputs: Sequence[str]
    example: tuple[Tensor, ...]
    seen: tuple[Tensor, ...]
    expected: tuple[Tensor, ...]
    by_onnx: Callable[[Artifact], Callable[..., tuple[Tensor, ...]]]
    facts: Mapping[str, Any]
    what: str
    allowed: float

    @property
    def size(self) -> int:
        """Number of recorded inputs."""
        return len(self.seen[0])


def recorded_inputs(controller: Controller, steps: int, seed: int) -> TensorDict:
    """What the controller saw, ``[steps x 5]``, in roll-outs from standing, each behaviour in mid-range (Table S2)."""
    low, high = command_bounds()
    schedule = [(steps, torch.arange(NUM_BEHAVIOURS), (low + high) / 2)]
    env = make_env(NUM_BEHAVIOURS, controller, None, num_threads=1, seed=seed)
    seen = [td.select(*behaviour.INPUTS) for td in drive(controller.bbc, env, schedule)]
    env.close()
    return torch.cat(seen)  # type: ignore[arg-type]


def controller_to_export(cfg: Config) -> Exportable:
    """A Basic Behaviour Controller, and what it answers."""
    controller = load_controller(cfg.run)
    seen = recorded_inputs(controller, cfg.steps, cfg.seed)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        said = controller.bbc.deployable_policy()(seen.clone())
    return Exportable(
        controller.artifact,
        behaviour.BBCNetwork(controller.bbc.eval().requires_grad_(False)),
        behaviour.INPUTS,
        behaviour.OUTPUTS,
        behaviour.example_inputs(),
        tuple(seen[name] for name in behaviour.INPUTS),
        (said[keys.ACTION], said[keys.ESTIMATE]),
        behaviour.onnx_network,
        {
            "simulation": {
                "friction_loss": controller.friction_loss,
                **controller.artifact.manifest.get("simulation", {}),
            }
        },
        ", ".join(BEHAVIOURS),
        SAME_ANSWER,
    )


def student_to_export(cfg: Config) -> Exportable:
    """A student, and what it decides on its course."""
    trained = load_trained(cfg.run, "student")
    student = trained.network
    assert isinstance(student, RecurrentStudent)
    seen, said = recorded_steps(trained, cfg.bbc, cfg.steps, cfg.seed)
    return Exportable(
        trained.artifact,
        task.StudentNetwork(student.eval().requires_grad_(False)),
        task.INPUTS,
        task.OUTPUTS,
        task.example_inputs(student.memory.size),
        tuple(seen[name] for name in task.INPUTS),
        tuple(said[name] for name in SAID),
        task.onnx_student,
        {},
        f"decisions on the course {trained.course!r}",
        SAME_DECISION,
    )


def to_onnx(export: Exportable, metadata: dict[str, Any]) -> bytes:
    """The network as an ONNX model that carries JSON values."""
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # the exporter's remarks about packages it could use
    with warnings.catch_warnings(), redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            export.network,
            export.example,
            input_names=list(export.inputs),
            output_names=list(export.outputs),
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


def difference(ours: Sequence[Tensor], theirs: Sequence[Tensor]) -> float:
    """Largest ``|a - b| / max(1, |b|)``; NaN counts as infinite."""
    shares = [(a - b).abs() / b.abs().clamp(min=1.0) for a, b in zip(ours, theirs, strict=True)]
    return max(float(share.nan_to_num(torch.inf).max()) for share in shares)


@torch.no_grad()
def check_network(export: Exportable) -> tuple[Tensor, ...]:
    """Answers of the deployed network row by row, which must be the training policy's, as those in batches.

    Raises:
        ArtifactError: if they differ.
    """
    rows, batches = (
        tuple(torch.cat(column) for column in zip(*map(export.network, *inputs), strict=True))
        for inputs in ([values.split(size) for values in export.seen] for size in (1, BATCH))
    )
    for answers, allowed in ((batches, SAME_ANSWER), (rows, export.allowed)):
        worst = difference(answers, export.expected)
        if not worst <= allowed:
            raise ArtifactError(
                f"{export.artifact.folder}: the network for deployment differs from the training policy by "
                f"{worst:.2e}, expected at most {allowed:.0e}; nothing was exported"
            )
    return rows


def check_onnx(export: Exportable, artifact: Artifact, answers: Sequence[Tensor]) -> float:
    """Largest difference between onnxruntime and PyTorch.

    Raises:
        ArtifactError: if it is too large.
    """
    run, size = export.by_onnx(artifact), export.size
    rows = [run(*(values[index : index + 1] for values in export.seen)) for index in range(size)]
    worst = difference([torch.cat(column) for column in zip(*rows, strict=True)], answers)
    if not worst <= export.allowed:
        raise ArtifactError(
            f"{artifact.folder}: onnxruntime and PyTorch differ by {worst:.2e} on {size} recorded inputs, "
            f"expected at most {export.allowed:.0e}; nothing was exported"
        )
    return worst


def complete_manifest(export: Exportable) -> dict[str, Any]:
    """The manifest of the training, with what the present format asks for besides."""
    trained = {k: v for k, v in export.artifact.manifest.items() if k not in _WRITTEN_ANEW}
    for name, layout in features.CONTROLLER_LAYOUTS.items():
        export.artifact.check_layout(name, layout)
    now = build_manifest(trained["kind"], features.CONTROLLER_LAYOUTS, control_period=trained["control_period"])
    return {**now, **trained, "units": now["units"], **export.facts, "exported_with": now["versions"]}


def main(cfg: Config) -> Path:
    """Export, check, write; returns the folder."""
    if cfg.steps < 1:
        raise ValueError(f"expected --steps of at least 1, got {cfg.steps}")
    torch.set_num_threads(1)  # a few robots: threads would only wait for each other
    of_student = cfg.run.is_dir() and Artifact.load(cfg.run).manifest["kind"] == "student"
    export = student_to_export(cfg) if of_student else controller_to_export(cfg)
    source, output = export.artifact, cfg.output or export.artifact.folder
    weights = source.manifest["weights"]["sha256"]
    there = Artifact.load(output).manifest["weights"]["sha256"] if (output / MANIFEST_FILE).is_file() else weights
    if there != weights or (output / "policy" / MANIFEST_FILE).is_file():  # which it would hide
        raise FileExistsError(f"--output {output} holds another policy already; choose another folder, or remove it")
    manifest, answers = complete_manifest(export), check_network(export)
    content = to_onnx(export, {**manifest, "weights_sha256": weights})
    digest = hashlib.sha256(content).hexdigest()
    entry = {
        "file": f"policy-{digest[:16]}.onnx",
        "sha256": digest,
        "weights_sha256": weights,
        "inputs": {name: list(value.shape) for name, value in zip(export.inputs, export.example, strict=True)},
        "outputs": list(export.outputs),
        "checked_on": f"{export.size} recorded inputs",
    }
    output.mkdir(parents=True, exist_ok=True)
    onnx_file = output / entry["file"]
    present = onnx_file.is_file() and onnx_file.read_bytes() == content
    if not present:
        staged = output / f".{onnx_file.name}.incoming"
        staged.write_bytes(content)
        publish(staged, onnx_file)
    try:
        trial = Artifact(source.state, {**source.manifest, "onnx": entry}, output)
        entry["largest_difference"] = check_onnx(export, trial, answers)
    except BaseException:
        if not present:
            onnx_file.unlink()
        raise
    artifact = Artifact.save(output, source.state, {**manifest, "onnx": entry})
    for old in output.glob("policy-*.onnx"):
        if old.name != entry["file"]:
            old.unlink()
    if artifact.manifest["weights"]["sha256"] != weights:
        raise ArtifactError(f"{output}: the weights changed while they were written; export again")
    print(
        f"{output}: {export.what} checked on {entry['checked_on']}; PyTorch and onnxruntime differ by "
        f"{entry['largest_difference']:.1e} at most (allowed {export.allowed:.0e})\n"
        f"{onnx_file.name}: {len(content) / 1e6:.2f} MB"
    )
    return output


if __name__ == "__main__":
    with cli.one_line_errors():
        main(cli.from_arguments(Config, doc=__doc__))
