"""The recipe of stage 2a on a few robots, called in this process: a start of Python costs more than a search."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from agility_rl.collectors import EvolutionStrategy, ParameterSpace, RobotLog, record_robot_log
from agility_rl.collectors.parameters import Parameter
from agility_rl.record.mcap_logger import read_scalars
from agility_rl.simulation import make_simulator
from agility_rl.training.checkpoint import RunCheckpoint

Module = Callable[[str], ModuleType]
GAINS = ParameterSpace().names


@pytest.fixture
def easi(module: Module) -> ModuleType:
    return module("easi")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of 2 s with its truth, and no recipe behind it."""
    folder = tmp_path_factory.mktemp("logs")
    simulator = make_simulator(num_simulations=1, num_threads=1)
    generator = torch.Generator().manual_seed(0)

    def shake(measured: Any) -> torch.Tensor:
        return 0.4 * torch.randn(1, 12, generator=generator)

    record_robot_log(simulator, shake, 110, generator=generator).save(folder / "log.csv")
    simulator.close()
    parameters = {name: {"value": 50.0 if "stiffness" in name else 1.5} for name in GAINS}
    recording = {"policy": "open-loop trot", "latency": 0}
    (folder / "log.truth.json").write_text(json.dumps({"parameters": parameters, "recording": recording}))
    return folder / "log.csv"


def smoke(easi: ModuleType, log: Path, folder: Path, name: str = "run", **options: Any) -> Any:
    return replace(easi.PRESETS["smoke"], log=log, runs=folder, name=name, num_threads=1, **options)


def test_a_smoke_run_writes_everything(
    easi: ModuleType, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = easi.train(smoke(easi, log, tmp_path, truth=log.with_name("log.truth.json")))
    result = json.loads((folder / "result.json").read_text())
    assert list(result["parameters"]) == list(GAINS) and result["generations"] == 3
    entry = result["parameters"]["hip_stiffness"]
    assert entry["unit"] == "N m/rad" and entry["truth"] == 50.0
    assert entry["error"] == pytest.approx(abs(entry["mean"] - 50.0) / 50.0)
    assert entry["multiple"]["mean"] == pytest.approx(entry["mean"] / 40.0)
    assert len(result["search"]["covariance"]) == 6
    scalars = read_scalars(folder)
    for name in ("mean/calf_damping", "std/calf_damping", "loss_discriminator", "score/best", "error/mean"):
        assert scalars[name][0].tolist() == [1, 2, 3], name
    assert scalars["mean/hip_stiffness"][1][-1] == pytest.approx(entry["mean"])
    assert scalars["error/mean"][1][-1] == pytest.approx(result["mean_error"])
    assert (folder / "figures" / "convergence.png").stat().st_size > 1000
    assert RunCheckpoint(folder / "checkpoints", counters={}).steps() == (2, 3)
    output = capsys.readouterr().out
    assert "hip_stiffness" in output and "mean parameter error" in output
    assert "the log was recorded with noise None, the search has 0.0" in output


@pytest.mark.parametrize("collection", ["replay", "policy"])
def test_a_resumed_search_equals_an_uninterrupted_one_bit_for_bit(
    easi: ModuleType, log: Path, tmp_path: Path, collection: str
) -> None:
    replays, preset = collection == "replay", easi.PRESETS["smoke"]
    critic = replace(preset.critic, matched=replays)
    search = preset.search if replays else replace(preset.search, response=None)
    options = {"noise": 0.5, "collection": collection, "critic": critic, "search": search}
    whole = easi.train(smoke(easi, log, tmp_path, "whole", **options))
    halves = easi.train(smoke(easi, log, tmp_path, "halves", generations=1, **options))
    # What a resume was started with does not matter but for how long and how fast.
    easi.train(replace(easi.PRESETS["paper"], resume=halves, generations=3, num_threads=2))
    assert (whole / "result.json").read_text() == (halves / "result.json").read_text()
    expected, got = read_scalars(whole), read_scalars(halves)
    assert expected.keys() == got.keys()
    timeless = [name for name in expected if not name.startswith("time/")]
    different = [name for name in timeless if not torch.equal(expected[name][1], got[name][1])]
    assert not different


def test_the_number_of_threads_does_not_change_the_result(easi: ModuleType, log: Path, tmp_path: Path) -> None:
    before = torch.get_num_threads()
    results = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        try:
            cfg = replace(smoke(easi, log, tmp_path, f"threads_{threads}", generations=2), num_threads=threads)
            results.append((easi.train(cfg) / "result.json").read_text())
        finally:
            torch.set_num_threads(before)
    assert results[0] == results[1]


def test_ctrl_c_saves_what_a_resume_goes_on_from(
    easi: ModuleType, log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    evolve = easi.evolve

    def interrupted(*arguments: Any) -> dict[str, float]:
        os.kill(os.getpid(), signal.SIGINT)
        return evolve(*arguments)

    monkeypatch.setattr(easi, "evolve", interrupted)
    folder = easi.train(smoke(easi, log, tmp_path, checkpoint_every=100))
    assert json.loads((folder / "result.json").read_text())["generations"] == 1
    monkeypatch.setattr(easi, "evolve", evolve)
    easi.train(replace(easi.PRESETS["smoke"], resume=folder, generations=2, num_threads=1))
    assert read_scalars(folder)["score/best"][0].tolist() == [1, 2]


def test_a_search_that_was_killed_before_its_first_checkpoint_begins_anew(
    easi: ModuleType, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = easi.train(smoke(easi, log, tmp_path, "whole"))
    cut = easi.train(smoke(easi, log, tmp_path, "cut"))
    shutil.rmtree(cut / "checkpoints")
    easi.train(replace(easi.PRESETS["smoke"], resume=cut, num_threads=1))
    assert "has no checkpoint yet: it begins anew" in capsys.readouterr().out
    assert (whole / "result.json").read_text() == (cut / "result.json").read_text()


def test_a_search_goes_on_as_far_as_it_was_to_go_and_names_what_it_does_not_heed(
    easi: ModuleType, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = easi.train(smoke(easi, log, tmp_path, generations=2, max_minutes=1e-6))
    arguments = ["smoke", "--resume", str(folder), "--max-minutes", "None", "--search.span", "2"]
    monkeypatch.setattr("sys.argv", ["easi.py", *arguments])
    easi.train(easi.cli.from_presets(easi.PRESETS, kept=easi.easi_config.KEPT))
    assert json.loads((folder / "result.json").read_text())["generations"] == 2, "the preset says 3"
    assert "but for --generations, --max-minutes, --num-threads; not heeded: --search.span (3.0)" in (
        capsys.readouterr().out
    )


def test_a_friction_that_is_searched_in_part_is_the_log_s_elsewhere(
    easi: ModuleType, log: Path, tmp_path: Path
) -> None:
    cfg = smoke(easi, log, tmp_path, friction_loss=0.05)
    parts = easi.build(replace(cfg, search=replace(cfg.search, parameters=("hip_friction_loss",))))
    fields = parts.space.fields(torch.tensor([[0.4]], dtype=torch.float64))
    assert fields["friction_loss"][0].tolist() == pytest.approx([0.4, 0.05, 0.05] * 4)
    parts.simulator.close()


def test_another_log_is_no_resume(easi: ModuleType, log: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.csv"
    copy.write_bytes(log.read_bytes())
    folder = easi.train(smoke(easi, copy, tmp_path, generations=1))
    copy.write_text(copy.read_text().rsplit("\n", 2)[0] + "\n")
    with pytest.raises(ValueError, match="began with log"):
        easi.train(replace(easi.PRESETS["smoke"], resume=folder, num_threads=1))


def test_the_paper_preset_is_table_s3(easi: ModuleType) -> None:
    paper = easi.PRESETS["paper"]
    assert (paper.num_robots, paper.trajectory_length) == (300, 500)
    assert (paper.critic.updates, paper.critic.learning_rate, paper.search.survival_rate) == (10, 3e-4, 0.5)
    assert paper.search.parameters == GAINS
    assert paper.collection == "policy" and not paper.critic.matched, "individuals roll out the policy"
    critic = (paper.critic.optimizer, paper.critic.weight_clip, paper.critic.gradient_penalty, paper.critic.hidden)
    assert critic == ("rmsprop", 0.01, None, (128, 128))
    own = (paper.search.response, paper.search.averaged, paper.search.min_std)
    assert own == (None, 0.0, 0.0), "survivors move the mean, and the last one is the result"


def test_a_noisy_log_takes_longer_windows_and_a_wide_search(easi: ModuleType, log: Path, tmp_path: Path) -> None:
    cpu = easi.PRESETS["cpu"]
    known = [
        easi.replay_window(replace(cpu, **options))
        for options in ({}, {"noise": 1.0, "latency": 1}, {"latency": 1}, {"window": 8}, {"noise": 1.0, "window": 1})
    ]
    assert known == [(1, 0), (8, 2), (1, 0), (8, 0), (1, 0)]
    at_once = [easi.replayed_at_once(cfg) for cfg in (cpu, replace(cpu, noise=1.0), replace(cpu, trajectory_length=7))]
    assert at_once == [6, 6, 1], "of 150, 18 and 7 windows: divisors, so that no robot idles"
    paper, settled = easi.PRESETS["paper"], replace(cpu.search, min_std=0.0)
    searches = (cpu, replace(cpu, noise=1.0), replace(cpu, noise=1.0, search=settled), replace(paper, noise=1.0))
    assert [easi.least_std(cfg) for cfg in searches] == [0.005, 0.02, 0.0, 0.0]
    narrow = replace(cpu, noise=1.0, search=replace(cpu.search, span=math.sqrt(3.0)))
    assert easi.least_std(narrow) == pytest.approx(0.04), "half the range in logarithms, the same gains"
    linear = replace(cpu, noise=1.0, search=replace(cpu.search, span=2.0, scale="linear"))
    assert easi.least_std(linear) == pytest.approx(0.02 * (3 - 1 / 3) / (2 - 1 / 2))
    for noise, count, length, counted in ((0.0, 20, 1, 1), (1.0, 2, 8, 6)):
        parts = easi.build(smoke(easi, log, tmp_path, noise=noise))
        assert parts.collector.num_steps == count * length and parts.search.min_std == (0.02 if noise else 0.005)
        assert parts.collector.collect(parts.search.ask()).shape == (8, count * counted)
        parts.simulator.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "give --log FILE"),
        (("--log", "nowhere.csv"), "no robot log at nowhere.csv"),
        (("--log", "{tmp}/gap.csv"), "row 50, time comes 220.0 ms"),
        (("--log", "{log}", "--serch.span", "2"), "did you mean --search.span"),
        (("--log", "{log}", "--search.parameters", "knee_stiffness"), "unknown parameter 'knee_stiffness'"),
        (("--log", "{log}", "--search.covariance", "round"), "full"),
        (("--log", "{log}", "--truth", "{log}"), "no truth of record_log.py"),
        (("--log", "{log}", "--truth", "{truth}", "--search.parameters", "armature"), "does not know armature"),
        (("--log", "{log}", "--policy", "nowhere"), "nowhere"),
        (("--log", "{log}", "--critic.gradient-penalty", "None"), "bound on its slope"),
        (("--log", "{log}", "--collection", "policy"), "--critic.matched needs --collection replay"),
        (("--log", "{log}", "--collection", "policy", "--critic.no-matched"), "--search.response needs --collection"),
        (("--log", "{log}", "--search.response", "1.5"), "expected share from above 0 to 1"),
        (("--log", "{log}", "--search.averaged", "-1"), "expected averaged, a share of the generations"),
        (("--log", "{log}", "--window", "0"), "expected --window from 1 to --trajectory-length 20, got 0"),
        (("--log", "{log}", "--latency", "-1"), "expected --noise and --latency from 0, got 0.0 and -1"),
        (("--log", "{log}", "--window", "21"), "expected --window from 1 to --trajectory-length 20, got 21"),
        (("--log", "{log}", "--window", "3", "--skip", "3"), "0 <= skip < window, got 3 and 3"),
        (("--log", "{log}", "--critic.difference"), "relative to one state"),
        (("--log", "{log}", "--num-robots", "2"), "survivors"),
        (("--resume", "nowhere"), "nothing to resume"),
        (("--log", "{log}", "--checkpoint-every", "0"), "expected --checkpoint-every of at least 1, got 0"),
        (("--log", "{log}", "--critic.batch-per-robot", "0"), "expected --critic.batch-per-robot of at least 1, got 0"),
    ],
)
def test_bad_options_and_logs_give_one_clear_line(
    easi: ModuleType,
    log: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    options: tuple[str, ...],
    message: str,
) -> None:
    rows = log.read_text().splitlines(keepends=True)
    (tmp_path / "gap.csv").write_text("".join([*rows[:51], *rows[61:]]))
    truth = log.with_name("log.truth.json")
    arguments = [option.format(tmp=tmp_path, log=log, truth=truth) for option in options]
    with pytest.raises(SystemExit) as stop, easi.cli.one_line_errors():
        easi.train(easi.cli.from_presets(easi.PRESETS, ["smoke", "--runs", str(tmp_path / "runs"), *arguments]))
    assert stop.value.code == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


def test_a_log_without_actions_names_what_is_missing(easi: ModuleType, log: Path, tmp_path: Path) -> None:
    header, *rows = [line.split(",") for line in log.read_text().splitlines()]
    kept = [index for index, name in enumerate(header) if not name.startswith("action")]
    lines = [",".join(row[index] for index in kept) for row in (header, *rows)]
    (tmp_path / "mute.csv").write_text("\n".join(lines) + "\n")
    with pytest.raises(ValueError, match="has no action"):
        easi.train(smoke(easi, tmp_path / "mute.csv", tmp_path))


def searched(
    space: ParameterSpace, score: Callable[[torch.Tensor], torch.Tensor], form: str, report: ModuleType
) -> Any:
    """Search a known function; returns what the report says about it."""
    size = len(space)
    search = EvolutionStrategy([0.0] * size, [1.0] * size, covariance=form, generator=torch.Generator().manual_seed(0))
    survivors = torch.zeros(size, size, dtype=torch.float64)
    for _ in range(12):
        individuals = search.ask()
        scores = score(individuals)
        search.tell(individuals, scores)
        survivors += report.survivor_correlation(search, individuals, scores)
    return report.identify(search, space, survivors / search.generation)


@pytest.mark.parametrize("form", ["diagonal", "full"])
def test_the_table_warns_of_what_the_log_does_not_tell(module: Module, form: str) -> None:
    space, report = ParameterSpace(GAINS[:4]), module("easi_report")

    def blind(x: torch.Tensor) -> torch.Tensor:
        """Shows the sum of 0 and 1, shows 2, does not show 3."""
        return -((x[:, 0] + x[:, 1] - 1.0) ** 2 + 0.5 * (x[:, 2] - 0.3) ** 2)

    found = searched(space, blind, form, report)
    text = "\n".join(found.warnings)
    assert "hip_stiffness and hip_damping: the log cannot tell them apart" in text and "product" in text
    assert "thigh_damping: the log hardly shows it" in text
    assert "thigh_stiffness" not in text
    sharp = searched(space, lambda x: -((x - 0.4) ** 2).sum(-1), form, report)
    assert sharp.warnings == ()
    dice = torch.Generator().manual_seed(1)
    chance = [searched(space, lambda x: torch.rand(len(x), generator=dice), form, report) for _ in range(10)]
    shown = [sum("hardly shows" in warning for warning in found.warnings) for found in chance]
    assert sum(shown) >= 0.75 * 40, "nine of ten parameters of no effect are expected to be named"
    assert 0.5 < float(found.spread[3]) / found.chance < 2.0


def test_the_error_by_hand(module: Module) -> None:
    report = module("easi_report")
    space = ParameterSpace([Parameter.named("hip_stiffness"), Parameter.named("trunk_mass_offset")])
    error = report.relative_error(torch.tensor([45.0, 1.0]), torch.tensor([50.0, 0.0]), space)
    assert error.tolist() == pytest.approx([0.1, 0.25])
    search = EvolutionStrategy([0.0, 0.0], [1.0, 1.0], generator=torch.Generator())
    centre, deviation = report.physical(search, space)
    first = 1.0 / math.sqrt(12.0)
    assert centre.tolist() == pytest.approx([40.0, 1.0])
    assert deviation.tolist() == pytest.approx([40.0 * math.sinh(first * math.log(9.0)), 4.0 * first])


def test_a_log_of_the_recorder_is_found_again(module: Module, tmp_path: Path) -> None:
    """The recorder's defaults and the search's are the same, so that nobody is warned for nothing."""
    record, easi = module("record_log"), module("easi")
    file = record.main(replace(record.PRESETS["smoke"], steps=100, log=tmp_path / "target.npz"))
    truth = file.with_suffix(".truth.json")
    parts = easi.build(smoke(easi, file, tmp_path, truth=truth))
    parts.simulator.close()
    recording = json.loads(truth.read_text())["recording"]
    del recording["model"]  # contacts, which a search cannot change
    assert {name: parts.inputs[name] for name in recording} == recording
    assert parts.truth is not None and parts.truth.tolist() == ParameterSpace().nominal.tolist()
    assert len(parts.real) == int((~RobotLog.load(file).start[1:]).sum())
