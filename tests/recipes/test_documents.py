"""Commands in the documents are ones that the recipes understand, and what they name is there."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest
import tyro

from agility_rl.deploy.artifact import Artifact
from agility_rl.training import cli

REPOSITORY = Path(__file__).parents[2]
DOCUMENTS = sorted(
    [REPOSITORY / "README.md", *REPOSITORY.glob("docs/*.md"), *REPOSITORY.glob("pretrained/*/README.md")]
)
COMMAND = re.compile(r"(?:python|torchrun)\S* (?:-\S+ \S+ )*((?:recipes|benchmarks)/\w+\.py)([^`\n]*)")
EXAMPLE = re.compile(r"```python\n(.*?)```", re.DOTALL)
FOLDER = re.compile(r"pretrained/\w+")


def commands(document: Path) -> list[tuple[str, list[str]]]:
    """Script and arguments of every command, without comments; what stands for something is left as it is."""
    text = re.sub(r"\s*\\\n\s*", " ", document.read_text(encoding="utf-8"))
    found = []
    for script, rest in COMMAND.findall(text):
        line = re.split(r"\s+#|\s*;|\s\|\s", rest)[0].replace("...", "")
        found.append((script, shlex.split(line)))
    return found


ALL = [(document, *command) for document in DOCUMENTS for command in commands(document)]


@pytest.mark.parametrize("example", EXAMPLE.findall((REPOSITORY / "README.md").read_text(encoding="utf-8")))
def test_an_example_of_the_readme_runs(example: str) -> None:
    exec(compile(example, "README.md", "exec"), {})


def test_commands_are_found() -> None:
    assert len(ALL) > 60
    assert {document.name for document, *_ in ALL} >= {"README.md", "bbc.md", "agility.md", "results.md"}


@pytest.mark.parametrize(
    ("document", "script", "arguments"),
    ALL,
    ids=[
        f"{document.relative_to(REPOSITORY)}-{Path(script).stem}-{number}"
        for number, (document, script, _) in enumerate(ALL)
    ],
)
def test_a_command_is_understood(
    document: Path,
    script: str,
    arguments: list[str],
    module: Callable[[str], ModuleType],
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = REPOSITORY / script
    assert file.is_file(), f"{document.name} names {script}, which is not there"
    for argument in arguments:
        if FOLDER.fullmatch(argument):
            assert (REPOSITORY / argument).is_dir(), f"{document.name} names {argument}, which is not there"
    if file.parent.name == "benchmarks":
        source = file.read_text(encoding="utf-8")
        missing = [
            argument for argument in arguments if argument.startswith("--") and argument.split("=")[0] not in source
        ]
        assert not missing, f"{document.name}: {script} has no {missing}"
        return
    if "--help" in arguments:
        return
    recipe = module(file.stem)
    default = re.search(r'from_presets\(.*default="(\w+)"', file.read_text(encoding="utf-8"))
    try:
        if hasattr(recipe, "PRESETS"):
            cli.from_presets(recipe.PRESETS, arguments, default=default and default[1])
        else:
            tyro.cli(recipe.Config, args=arguments)
    except SystemExit:
        pytest.fail(f"{document.name}: {script} {' '.join(arguments)}\n{capsys.readouterr()}")


def test_weights_of_the_results_are_those_that_are_shipped() -> None:
    text = (REPOSITORY / "docs" / "results.md").read_text(encoding="utf-8")
    named = dict(re.findall(r"\| `(pretrained/\w+)` \| `([0-9a-f]{12})` \|", text))
    shipped = {
        folder.relative_to(REPOSITORY).as_posix(): Artifact.load(folder).manifest["weights"]["sha256"][:12]
        for folder in sorted((REPOSITORY / "pretrained").iterdir())
    }
    assert named == shipped, "measure again what has changed, and write it into docs/results.md"


def test_every_figure_is_shown_and_every_figure_shown_is_there() -> None:
    shown = {
        name for document in DOCUMENTS for name in re.findall(r"figures/(\w+\.png)\)", document.read_text("utf-8"))
    }
    there = {file.name for file in (REPOSITORY / "docs" / "figures").iterdir() if file.suffix == ".png"}
    assert shown == there
    results = (REPOSITORY / "docs" / "results.md").read_text(encoding="utf-8")
    assert set(re.findall(r"`docs/figures/(\w+\.png)`", results)) <= there
