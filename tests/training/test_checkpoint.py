"""Checkpoints: bit-exact, durable against a kill at every file operation, and honest about damage."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.checkpoint import CheckpointError
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from agility_rl.training import checkpoint as module
from agility_rl.training.checkpoint import RunCheckpoint, find_damage, publish, step_of
from agility_rl.training.seeding import Seeds, seed_everything


def bits(tensor: torch.Tensor) -> bytes:
    return tensor.detach().contiguous().view(-1).view(torch.uint8).numpy().tobytes()


def test_values_survive_bit_for_bit(tmp_path: Path) -> None:
    values = {
        "float": torch.tensor([0.1, float("nan"), float("inf"), -0.0, 1e-45]),
        "double": torch.tensor(1 / 3, dtype=torch.float64),
        "half": torch.tensor([1.5, 2.5], dtype=torch.bfloat16),
        "long": torch.tensor([[2**62, -1]]),
        "bool": torch.tensor([True, False]),
        "empty": torch.zeros(0, 3),
        "strided": torch.arange(12.0).reshape(3, 4).t(),
        "nested": {"count": 3, "rate": 0.1, "name": "trot", "none": None, "list": [1, 2.5], "yes": True},
        "array": np.arange(3, dtype=np.int16),
        "tuple": (1, torch.tensor([7.0])),
    }
    RunCheckpoint(tmp_path, values=values).save(1)
    restored: dict = {}
    RunCheckpoint(tmp_path, values=restored).load()
    assert list(restored) == list(values)
    for name in ("float", "double", "half", "long", "bool", "empty", "strided"):
        assert restored[name].dtype == values[name].dtype and restored[name].shape == values[name].shape
        assert bits(restored[name]) == bits(values[name])
    assert restored["nested"] == values["nested"]
    assert isinstance(restored["tuple"], tuple) and restored["tuple"][1].item() == 7.0
    assert restored["array"].dtype == np.int16


def test_tensors_and_tensordicts_are_restored_in_place(tmp_path: Path) -> None:
    tensor, replay = torch.arange(4.0), TensorDict({"motion": torch.rand(5, 2), "deep": {"n": torch.arange(5)}}, [5])
    mapping = {"buffer": torch.ones(2), "deep": {"buffer": torch.ones(3)}}
    alias, deep, before = mapping["buffer"], mapping["deep"]["buffer"], replay.clone()
    checkpoint = RunCheckpoint(tmp_path, tensor=tensor, replay=replay, mapping=mapping)
    checkpoint.save(0)
    tensor.zero_(), replay.zero_(), alias.zero_(), deep.zero_()
    mapping["since"] = mapping["deep"]["since"] = 1
    checkpoint.load()
    assert tensor.tolist() == [0, 1, 2, 3] and (replay == before).all()
    assert alias.tolist() == [1, 1] and deep.tolist() == [1, 1, 1], "the same tensors, not new ones"
    assert list(mapping) == ["buffer", "deep"] and list(mapping["deep"]) == ["buffer"], "nothing that came since"


def train(folder: Path, iterations: int, resume: bool) -> dict[str, bytes]:
    """A tiny run with dropout, Adam, a schedule, a TorchRL replay buffer and three kinds of random numbers."""
    seeds = seed_everything(3)
    model = nn.Sequential(nn.Linear(4, 8), nn.Dropout(0.3), nn.Linear(8, 1))
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-2)
    schedule = torch.optim.lr_scheduler.StepLR(optimizer, 2, 0.5)
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(32), batch_size=8)
    ring, generator = TensorDict({"x": torch.zeros(16, 4)}, [16]), torch.Generator().manual_seed(8)
    counters = {"iteration": 0}
    checkpoint = RunCheckpoint(
        folder, model=model, optimizer=optimizer, schedule=schedule, replay=replay, ring=ring, generator=generator,
        seeds=seeds, counters=counters,
    )  # fmt: skip
    if resume:
        assert checkpoint.load() == counters["iteration"]
    for iteration in range(counters["iteration"], iterations):
        noise = float(np.random.rand()) + float(seeds.numpy("data").random())  # noqa: NPY002
        x = torch.randn(8, 4, generator=seeds.generator("data")) + torch.rand(4, generator=generator) * noise
        ring["x"][8 * (iteration % 2) : 8 * (iteration % 2) + 8] = x
        replay.extend(TensorDict({"x": x}, [8]))
        batch = replay.sample()["x"]
        optimizer.zero_grad()
        model(torch.cat((batch, ring["x"]))).square().mean().backward()
        optimizer.step()
        schedule.step()
        counters["iteration"] = iteration + 1
        checkpoint.save(iteration + 1, {"noise": noise})
    state = {f"model.{name}": bits(value) for name, value in model.state_dict().items()}
    for index, entry in optimizer.state_dict()["state"].items():
        state |= {f"adam.{index}.{name}": bits(value) for name, value in entry.items()}
    return state | {"ring": bits(ring["x"]), "next": bits(torch.rand(3)), "replay": bits(replay[:]["x"])}


def test_a_resumed_run_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    whole = train(tmp_path / "whole", 6, resume=False)
    train(tmp_path / "parts", 3, resume=False)
    assert train(tmp_path / "parts", 6, resume=True) == whole


def test_rotation_keeps_the_last_and_the_best(tmp_path: Path) -> None:
    checkpoint = RunCheckpoint(tmp_path, keep_last=2, keep_best=("return", "max"), counters={"n": 0})
    for step, value in enumerate((1.0, 9.0, 3.0, 4.0, 5.0)):
        checkpoint.save(step, {"return": value})
    assert checkpoint.steps() == (1, 3, 4)
    assert checkpoint.load(1) == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"checkpoint-{s:012d}.torchrl" for s in (1, 3, 4)]
    with pytest.raises(FileNotFoundError, match=r"no checkpoint of step 2 in .*it has \[1, 3, 4\]"):
        checkpoint.load(2)


def test_saving_a_step_again_replaces_it(tmp_path: Path) -> None:
    counters = {"n": 0}
    checkpoint = RunCheckpoint(tmp_path, keep_last=1, counters=counters)
    for counters["n"] in (1, 2):
        checkpoint.save(5)
    counters["n"] = 0
    assert checkpoint.load() == 5 and counters == {"n": 2} and checkpoint.steps() == (5,)


def test_who_goes_back_goes_on_from_there(tmp_path: Path) -> None:
    value = torch.zeros(1)
    checkpoint = RunCheckpoint(tmp_path, keep_last=1, value=value)
    for step in (10, 20, 30):
        value.fill_(step)
        checkpoint.save(step)
    checkpoint = RunCheckpoint(tmp_path, keep_last=2, value=value)
    value.fill_(21)
    assert checkpoint.save(21).is_file(), "complete and on the disk when this returns"
    assert checkpoint.steps() == (21,) and checkpoint.load() == 21 and value.item() == 21
    assert len(list(tmp_path.glob("*30.torchrl.left"))) == 1, "nothing is lost"


def test_components_can_be_chosen(tmp_path: Path) -> None:
    policy, other = torch.ones(2), torch.ones(2)
    RunCheckpoint(tmp_path, policy=policy, other=other).save(1)
    policy.zero_(), other.zero_()
    state = torch.get_rng_state()
    RunCheckpoint(tmp_path, policy=policy).load(components=["policy"])
    assert policy.tolist() == [1, 1] and other.tolist() == [0, 0]
    assert torch.equal(state, torch.get_rng_state()), "the random states belong to a full restore"


@pytest.mark.parametrize("keep", [0, 1, 100, 0.5, -1])
def test_a_truncated_file_is_refused_in_one_line_and_changes_nothing(tmp_path: Path, keep: float) -> None:
    model, counters = nn.Linear(64, 64), {"n": 1}
    checkpoint = RunCheckpoint(tmp_path, model=model, counters=counters)
    checkpoint.save(1)
    path = checkpoint.save(2)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * keep) if isinstance(keep, float) else keep])
    nn.init.zeros_(model.weight)
    with pytest.raises(
        CheckpointError, match=r"is damaged: .*probably truncated.*intact: step 1, load\(step=1\)"
    ) as error:
        checkpoint.load()
    assert "\n" not in str(error.value)
    assert not model.weight.any()
    assert checkpoint.load(1) == 1 and model.weight.any()


@pytest.mark.parametrize("place", [6, 10])  # version needed, and method of compression, of the first listed member
def test_a_header_that_nobody_wrote_is_damage_too(tmp_path: Path, place: int) -> None:
    checkpoint = RunCheckpoint(tmp_path, counters={"n": 1})
    checkpoint.save(1)
    path = checkpoint.save(2)
    content = bytearray(path.read_bytes())
    content[content.index(b"PK\1\2") + place] = 99
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match=r"is damaged: .*intact: step 1, .*or remove the damaged file to resume"):
        checkpoint.load()


def test_a_flipped_bit_is_found(tmp_path: Path) -> None:
    path = RunCheckpoint(tmp_path, model=nn.Linear(64, 64)).save(1)
    content = bytearray(path.read_bytes())
    place = content.index(b"tensor_00000001") + 200  # inside the weights that follow the first member's header
    content[place] ^= 1
    path.write_bytes(content)
    assert "checksum" in str(find_damage(path))
    with pytest.raises(CheckpointError, match="no other one is intact"):
        RunCheckpoint(tmp_path, model=nn.Linear(64, 64)).load()


def test_weights_that_are_not_finite_take_no_checkpoints_place(tmp_path: Path) -> None:
    policy = nn.Linear(2, 1)
    checkpoint = RunCheckpoint(tmp_path, keep_last=1, policy=policy, counters={"iteration": 1})
    with torch.no_grad():
        policy.bias.fill_(torch.inf)
    with pytest.raises(CheckpointError, match=r"policy: bias holds NaN or infinity, .* and there is no earlier one"):
        checkpoint.save(1)
    assert checkpoint.steps() == ()
    with torch.no_grad():
        policy.bias.zero_()
    checkpoint.save(2)
    with torch.no_grad():
        policy.weight[0, 1] = torch.nan
    with pytest.raises(CheckpointError, match=r"policy: weight holds NaN .* that of step 2 stays"):
        checkpoint.save(3)
    assert checkpoint.steps() == (2,) and checkpoint.load() == 2 and bool(policy.weight.isfinite().all())


def test_errors_say_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no checkpoint in"):
        RunCheckpoint(tmp_path / "none", counters={}).load()
    with pytest.raises(TypeError, match="component 'policy' is a int; expected something with state_dict"):
        RunCheckpoint(tmp_path, policy=3)
    RunCheckpoint(tmp_path, model=nn.Linear(2, 2), counters={}).save(1)
    with pytest.raises(CheckpointError, match=r"missing \['critic'\], unexpected \['model'\]"):
        RunCheckpoint(tmp_path, critic=nn.Linear(2, 2), counters={}).load()
    with pytest.raises(CheckpointError, match="size mismatch for weight") as error:
        RunCheckpoint(tmp_path, model=nn.Linear(3, 2), counters={}).load()
    assert "\n" not in str(error.value)
    with pytest.raises(KeyError, match="never registered"):
        RunCheckpoint(tmp_path, counters={}).load(components=["policy"])
    RunCheckpoint(tmp_path / "tensor", value=torch.zeros(2)).save(1)
    with pytest.raises(CheckpointError, match=r"expected torch.float32 \(3,\), got torch.float32 \(2,\)"):
        RunCheckpoint(tmp_path / "tensor", value=torch.zeros(3)).load()
    RunCheckpoint(tmp_path / "keys", value=TensorDict({"x": torch.ones(2), "y": torch.ones(2)}, [2])).save(1)
    fewer = TensorDict({"x": torch.zeros(2)}, [2])
    with pytest.raises(CheckpointError, match=r"expected the keys \['x'\], got \['x', 'y'\]"):
        RunCheckpoint(tmp_path / "keys", value=fewer).load()
    assert not fewer["x"].any()


def test_publish_replaces_and_step_is_read_from_the_name(tmp_path: Path) -> None:
    (tmp_path / "new").write_text("new")
    (tmp_path / "old").write_text("old")
    publish(tmp_path / "new", tmp_path / "old")
    assert [path.read_text() for path in tmp_path.iterdir()] == ["new"]
    assert step_of(tmp_path / f"{module.PREFIX}-000000000007{module.SUFFIX}") == 7


def test_every_write_is_durable_before_the_rename(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The order that a power cut needs: fsync of the file, rename, fsync of the folder."""
    calls: list[str] = []
    replace, fsync = module.os.replace, module.os.fsync

    def recorded_replace(source: Path, destination: Path) -> None:
        if Path(destination).suffix == module.SUFFIX:
            calls.append("replace")
        replace(source, destination)

    def recorded_fsync(descriptor: int) -> None:
        calls.append("fsync")
        fsync(descriptor)

    monkeypatch.setattr(module.os, "replace", recorded_replace)
    monkeypatch.setattr(module.os, "fsync", recorded_fsync)
    RunCheckpoint(tmp_path, counters={"n": 1}).save(1)
    assert calls == ["fsync", "replace", "fsync"]


KILLER = """
import os, sys
import torch
from agility_rl.training.checkpoint import RunCheckpoint, find_damage
torch.set_num_threads(1)
folder = sys.argv[1]

def components(value):
    return {"model": torch.full((300,), float(value)), "counters": {"value": value}}

def save(value, step):
    RunCheckpoint(folder, keep_last=1, **components(value)).save(step)

def killed_save(value, step, fatal):
    # A child that dies at its fatal-th change of the file system, as from SIGKILL: no handler, no finally, no flush.
    child = os.fork()
    if child == 0:
        count = 0
        def hook(event, arguments):
            nonlocal count
            writes = event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR)
            if writes or event in ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.truncate"):
                count += 1
                if count == fatal:
                    os._exit(9)
        sys.addaudithook(hook)
        save(value, step)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

save(1, 1)
survivor, fatal, outcomes = 1, 0, []
for same_step in (False, True):
    # Staging is the same in both rounds; the second one repeats the end, where a file is replaced by its namesake.
    fatal, step = max(0, fatal - 15), checkpoint.steps()[-1] if same_step else 1
    while True:
        fatal += 1
        value = survivor + 1
        step = step if same_step else step + 1
        status = killed_save(value, step, fatal)
        restored = components(0)
        checkpoint = RunCheckpoint(folder, **restored)
        checkpoint.load()
        assert restored["counters"]["value"] in (survivor, value), (fatal, restored["counters"])
        assert set(restored["model"].tolist()) == {float(restored["counters"]["value"])}, fatal
        survivor = restored["counters"]["value"]
        step = checkpoint.steps()[-1]
        outcomes.append(survivor == value)
        if status == 0:
            break
    print(same_step, fatal)
    assert survivor == value
save(survivor + 1, step + 1)
left = sorted(os.listdir(folder))
assert len(left) == 1 and find_damage(os.path.join(folder, left[0])) is None, left
assert True in outcomes and False in outcomes
"""


def test_a_process_killed_at_any_file_operation_leaves_a_loadable_checkpoint(tmp_path: Path) -> None:
    command = [sys.executable, "-W", "ignore", "-c", KILLER, str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2], check=False)
    assert result.returncode == 0, result.stderr
    operations = [int(line.split()[1]) for line in result.stdout.splitlines()]
    assert len(operations) == 2 and min(operations) > 20, "the hook saw the file operations"


def test_leftovers_of_a_killed_save_are_ignored_and_removed(tmp_path: Path) -> None:
    counters = {"n": 1}
    checkpoint = RunCheckpoint(tmp_path, counters=counters)
    checkpoint.save(1)
    (tmp_path / ".staging" / "half").mkdir(parents=True)
    (tmp_path / ".staging" / "half" / "manifest.json").write_text("{")
    (tmp_path / ".checkpoint-000000000000.torchrl.delete-1").write_text("x")
    (tmp_path / "checkpoint-notes.torchrl").write_text("mine")
    assert checkpoint.load() == 1
    checkpoint.save(2)
    assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith(".")) == []
    assert (tmp_path / "checkpoint-notes.torchrl").read_text() == "mine"


def test_seeds_are_a_component(tmp_path: Path) -> None:
    seeds = Seeds(5)
    seeds.generator("a"), seeds.numpy("b")
    checkpoint = RunCheckpoint(tmp_path, seeds=seeds)
    checkpoint.save(1)
    first = torch.rand(3, generator=seeds.generator("a")), seeds.numpy("b").random(3)
    other = Seeds(5)
    RunCheckpoint(tmp_path, seeds=other).load()
    assert torch.equal(first[0], torch.rand(3, generator=other.generator("a")))
    assert (first[1] == other.numpy("b").random(3)).all()
