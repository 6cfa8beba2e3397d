"""The metrics file: complete, exact, readable at every moment, and never lost by a resume."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from mcap.reader import make_reader
from tensordict import TensorDict

from agility_rl.record.mcap_logger import MCAPLogger, read_hparams, read_scalars
from agility_rl.record.messages import DamageError, read_messages


def values(folder: Path, name: str) -> tuple[list[int], list[float]]:
    steps, numbers = read_scalars(folder)[name]
    return steps.tolist(), numbers.tolist()


def test_values_are_exact(tmp_path: Path) -> None:
    logger = MCAPLogger("run", tmp_path)
    numbers = [0.1, float("inf"), -0.0, 1e-300, float(torch.tensor(0.1))]
    for step, number in enumerate(numbers):
        logger.log_scalar("a/b", number, step=10 * step)
    logger.log_scalar("nan", float("nan"))
    logger.log_scalar("nan", torch.tensor(2.0))
    logger.log_metrics({"tensor": torch.tensor([1.0, 2.0]), "int": 3}, step=7)
    logger.log_metrics(TensorDict({"deep": {"loss": torch.tensor(0.5)}}), step=8)
    logger.close()
    logger.close()
    assert values(tmp_path / "run", "a/b") == ([0, 10, 20, 30, 40], numbers)
    steps, nan = read_scalars(tmp_path / "run" / "metrics.mcap")["nan"]
    assert steps.tolist() == [0, 1] and nan[0].isnan() and nan[1] == 2
    assert values(tmp_path / "run", "tensor/1") == ([7], [2.0])
    assert values(tmp_path / "run", "deep/loss") == ([8], [0.5])


def test_the_file_is_indexed_and_described(tmp_path: Path) -> None:
    """What Foxglove needs: a summary with channels, protobuf schemas and statistics."""
    logger = MCAPLogger("run", tmp_path)
    logger.log_scalar("loss", 1.0)
    logger.log_histogram("weights", torch.tensor([0.0, 1.0, 1.0, float("nan")]), bins=2, step=3)
    logger.log_video("view", torch.zeros(1, 2, 3, 8, 10, dtype=torch.uint8), fps=25)
    logger.log_hparams({"lr": 1e-3, "hidden": [8, 4]})
    logger.close()
    with open(logger.path, "rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None and summary.statistics.message_count == 4
    topics = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
    assert topics == {
        "/loss": "agility_rl.Scalar",
        "/weights": "agility_rl.Histogram",
        "/view": "foxglove.CompressedImage",
    }
    assert {c.message_encoding for c in summary.channels.values()} == {"protobuf"}
    histogram = next(record.value for record in read_messages(logger.path) if record.topic == "/weights")
    assert (histogram.step, list(histogram.counts), list(histogram.edges)) == (3, [1.0, 2.0], [0.0, 0.5, 1.0])
    times = [record.time for record in read_messages(logger.path) if record.topic == "/view"]
    assert times[1] - times[0] == 40_000_000
    assert read_hparams(tmp_path / "run") == {"lr": 1e-3, "hidden": [8, 4]}


def test_another_process_can_read_while_it_is_written(tmp_path: Path) -> None:
    logger = MCAPLogger("run", tmp_path, flush_interval=0)
    for step in range(3):
        logger.log_scalar("loss", step, step)
        assert values(tmp_path / "run", "loss")[0] == list(range(step + 1))
    lazy = MCAPLogger("lazy", tmp_path, flush_interval=1e9)
    lazy.log_scalar("loss", 1.0)
    assert read_scalars(tmp_path / "lazy") == {}
    lazy.flush()
    assert values(tmp_path / "lazy", "loss") == ([0], [1.0])


def test_every_truncation_reads_up_to_the_last_whole_chunk(tmp_path: Path) -> None:
    logger = MCAPLogger("run", tmp_path, flush_interval=0)
    for step in range(2):
        logger.log_scalar("loss", step, step)
    logger.close()
    content = logger.path.read_bytes()
    cut, seen = tmp_path / "cut.mcap", []
    for length in range(len(content)):
        cut.write_bytes(content[:length])
        found = read_scalars(cut)
        steps = found["loss"][0].tolist() if found else []
        assert steps == list(range(len(steps)))
        seen.append(len(steps))
    assert seen == sorted(seen) and seen[0] == 0 and seen[-1] == 2


def test_resume_continues_the_same_file_and_replaces_what_is_run_again(tmp_path: Path) -> None:
    logger = MCAPLogger("run", tmp_path)
    logger.log_hparams({"seed": 3})
    for step in range(5):
        logger.log_scalar("loss", step, step)
    logger.log_scalar("eval", 9.0, 0)
    logger.log_scalar("eval", 8.0, 4)
    logger.close()
    with pytest.raises(FileExistsError, match=r"already exists; .* continue with resume=True"):
        MCAPLogger("run", tmp_path)
    second = MCAPLogger("run", tmp_path, resume=True)
    assert second.session == 1
    second.log_scalar("loss", 30.0, 3)
    second.log_scalar("new", 1.0, 3)
    second.log_histogram("h", [1.0, 2.0])
    second.close()
    assert values(tmp_path / "run", "loss") == ([0, 1, 2, 3], [0.0, 1.0, 2.0, 30.0])
    assert values(tmp_path / "run", "eval") == ([0], [9.0]), "step 4 came after the checkpoint that was resumed"
    third = MCAPLogger("run", tmp_path, resume=True)
    third.log_scalar("loss", 40.0)
    third.close()
    assert third.session == 2 and values(tmp_path / "run", "loss")[0] == [0, 1, 2, 3, 4]
    assert read_hparams(tmp_path / "run") == {"seed": 3}
    assert [path.name for path in (tmp_path / "run").iterdir()] == ["metrics.mcap"]
    assert sum(1 for _ in read_messages(third.path)) == 11, "the superseded values are still in the file"


def test_a_resumed_run_may_log_what_has_steps_of_its_own(tmp_path: Path) -> None:
    with_steps = MCAPLogger("run", tmp_path)
    for step in range(100):
        with_steps.log_scalar("loss", 0.1, step=step)
    for _ in range(5):
        with_steps.log_scalar("episode_return", 1.0)
    counters = with_steps.state_dict()
    with_steps.close()
    resumed = MCAPLogger("run", tmp_path, resume=True)
    resumed.load_state_dict(counters)
    resumed.log_scalar("episode_return", 2.0)
    resumed.log_scalar("final_evaluation", 0.8)
    resumed.close()
    assert values(tmp_path / "run", "loss")[0] == list(range(100))
    assert values(tmp_path / "run", "episode_return") == ([0, 1, 2, 3, 4, 5], [1.0] * 5 + [2.0])
    assert values(tmp_path / "run", "final_evaluation") == ([0], [0.8])


def test_histograms_go_on_too(tmp_path: Path) -> None:
    for _ in range(3):
        logger = MCAPLogger("run", tmp_path, resume=(tmp_path / "run").exists())
        logger.log_histogram("weights", torch.arange(4.0))
        logger.log_histogram("weights", torch.arange(4.0))
        logger.close()
    logged = [(record.value.step, record.value.session) for record in read_messages(logger.path)]
    assert logged == [(0, 0), (1, 0), (2, 1), (3, 1), (4, 2), (5, 2)]


def test_resume_after_a_cut_keeps_what_is_readable(tmp_path: Path) -> None:
    logger = MCAPLogger("run", tmp_path, flush_interval=0)
    for step in range(4):
        logger.log_scalar("loss", step, step)
    logger.flush()
    content = logger.path.read_bytes()
    logger.close()
    logger.path.write_bytes(content[:-40])  # the message index of the last chunk, and a bit of the chunk
    MCAPLogger("run", tmp_path, resume=True).close()
    assert values(tmp_path / "run", "loss")[0] == [0, 1, 2]


def test_a_damaged_file_is_kept_beside(tmp_path: Path) -> None:
    logger = MCAPLogger("run", tmp_path, flush_interval=0)
    for step in range(4):
        logger.log_scalar("loss", step, step)
    logger.close()
    content = bytearray(logger.path.read_bytes())
    second_chunk = content.index(b"zstd", content.index(b"zstd") + 1)
    content[second_chunk + 20] ^= 0xFF
    logger.path.write_bytes(content)
    with pytest.raises(DamageError, match="is damaged or no MCAP file") as error:
        read_scalars(logger.path)
    assert "\n" not in str(error.value)
    MCAPLogger("run", tmp_path, resume=True).close()
    assert (tmp_path / "run" / "metrics.damaged-1.mcap").read_bytes() == bytes(content)
    assert values(tmp_path / "run", "loss")[0] == [0], "what came before the damage goes on"


def test_a_flipped_byte_anywhere_gives_the_values_or_one_error(tmp_path: Path) -> None:
    logger = MCAPLogger("run", tmp_path, flush_interval=0)
    for step in range(2):
        logger.log_scalar("loss", step, step)
    logger.close()
    content = logger.path.read_bytes()
    errors = 0
    for place in range(0, len(content), 3):
        logger.path.write_bytes(content[:place] + bytes([content[place] ^ 0xFF]) + content[place + 1 :])
        try:
            assert all(len(steps) <= 2 for steps, _ in read_scalars(logger.path).values())
        except DamageError:
            errors += 1
    assert errors > len(content) // 12


WRITERS = """
import os, signal, sys, time
from agility_rl.record.mcap_logger import MCAPLogger, read_scalars
runs = sys.argv[1]
child = os.fork()
if child == 0:
    logger = MCAPLogger("run", runs, flush_interval=0)
    for step in range(10**9):
        logger.log_metrics({"a": float(step), "b": 2.0}, step=step)
path = os.path.join(runs, "run", "metrics.mcap")
while not os.path.exists(path) or os.path.getsize(path) < 100_000:
    time.sleep(0.01)
os.kill(child, signal.SIGKILL)
os.waitpid(child, 0)
steps, values = read_scalars(path)["a"]
print(len(steps), steps.tolist() == values.tolist() == list(range(len(steps))), flush=True)
logger = MCAPLogger("run", runs, resume=True, flush_interval=1e9)
logger.log_scalar("a", 0.5)
raise SystemExit(3)
"""


def test_a_killed_writer_leaves_a_readable_file_and_a_forgetful_one_a_finished_file(tmp_path: Path) -> None:
    command = [sys.executable, "-W", "ignore", "-c", WRITERS, str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2], check=False)
    assert result.returncode == 3, result.stderr
    count, whole = result.stdout.split()
    assert int(count) > 50 and whole == "True", "the killed writer's steps 0, 1, 2, ... without a gap"
    with open(tmp_path / "run" / "metrics.mcap", "rb") as file:
        assert make_reader(file).get_summary() is not None
    steps, numbers = values(tmp_path / "run", "a")
    assert steps == list(range(int(count) + 1)) and numbers[-1] == 0.5


def test_state_dict_continues_automatic_steps(tmp_path: Path) -> None:
    logger = MCAPLogger("run", tmp_path)
    logger.log_scalar("loss", 1.0, 41)
    state = logger.state_dict()
    other = MCAPLogger("other", tmp_path)
    other.load_state_dict(state)
    other.log_scalar("loss", 2.0)
    other.close()
    assert values(tmp_path / "other", "loss") == ([42], [2.0])


def test_errors(tmp_path: Path) -> None:
    logger = MCAPLogger("run", tmp_path)
    logger.log_scalar("loss", 1.0)
    with pytest.raises(ValueError, match=r"'loss' was logged as agility_rl.Scalar, got agility_rl.Histogram"):
        logger.log_histogram("loss", [1.0])
    with pytest.raises(ValueError, match=r"expected uint8 \[3 or 1, height, width\]"):
        logger.log_image("view", torch.zeros(3, 4, 4))
    with pytest.raises(ValueError, match=r"\[T, 3, height, width\]"):
        logger.log_video("view", torch.zeros(3, 4, dtype=torch.uint8))
    logger.close()
    with pytest.raises(RuntimeError, match="is closed"):
        logger.log_scalar("loss", 1.0)
    with pytest.raises(FileNotFoundError):
        read_scalars(tmp_path / "none.mcap")
    (tmp_path / "text.mcap").write_text("no MCAP at all")
    with pytest.raises(DamageError, match="no MCAP file"):
        read_scalars(tmp_path / "text.mcap")
