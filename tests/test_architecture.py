"""The rules of the house, read from the syntax trees: who imports whom, public names, tests, loads, random numbers."""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
PACKAGE = REPOSITORY / "agility_rl"

GROUND = {"keys", "behaviours", "rotations", "bending", "tensors"}
MAY_IMPORT: dict[str, set[str]] = {
    "": set(),
    "keys": set(),
    "tensors": set(),
    "behaviours": {"tensors"},
    "rotations": set(),
    "bending": set(),
    "go2": GROUND,
    "simulation": GROUND | {"go2"},
    "motion": GROUND | {"go2"},
    "modules": GROUND | {"go2"},
    "losses": GROUND | {"go2"},
    "envs": GROUND | {"go2", "simulation"},
    # A robot log is read from, and written to, the MCAP form of record; record knows no collector: no circle.
    "collectors": GROUND | {"go2", "simulation", "envs", "record"},
    "deploy": GROUND | {"go2", "modules"},
    "training": {"tensors"},
    "record": GROUND | {"go2"},
}
"""For each part of the package, the other parts that it may import (the part "" is ``agility_rl/__init__.py``)."""

MAY_IMPORT_TORCHRL = {"modules", "losses", "envs", "collectors", "training", "record"}
FORBIDDEN_EVERYWHERE = {"recipes", "benchmarks", "tests", "tensorboard", "tensorboardX"}

PUBLIC: dict[str, tuple[str, ...]] = {
    "modules": (
        "Discriminator",
        "Predictor",
        "SkillPrior",
        "GaussianActor",
        "HybridActor",
        "Critic",
        "StateEstimator",
        "HistoryEncoder",
        "PrivilegedEncoder",
        "ScandotsEncoder",
        "TransitionDiscriminator",
        "BYOL",
        "DepthAugmentation",
        "DepthEncoder",
        "RecurrentStudent",
    ),
    "losses": (
        "DiscriminatorLoss",
        "PredictorLoss",
        "HybridPPOLoss",
        "AdaptationLoss",
        "StateEstimationLoss",
        "TransitionDiscriminatorLoss",
        "BYOLLoss",
        "StudentLoss",
    ),
    "envs": ("AgilityEnv", "Course", "LocomotionEnv"),
    "collectors": (
        "BehaviourPolicy",
        "DAggerCollector",
        "EASICollector",
        "EvolutionStrategy",
        "ParameterSpace",
        "RobotLog",
        "RobotLogRecorder",
        "record_robot_log",
    ),
    "motion": ("MotionClip", "MotionDataset", "load_clip", "retarget", "synthesize_gait", "classify_gait"),
    "simulation": ("Simulator", "make_simulator"),
    "record": ("MCAPLogger", "EpisodeRecorder"),
    "deploy": ("Artifact", "Controller", "DeployedBBC", "BehaviourCommand", "Operator"),
}
"""Names that users import. Taking one away breaks their code: do it on purpose, here and in the changelog."""

RANDOM_FUNCTIONS = {"rand", "randn", "randint", "randperm", "multinomial", "bernoulli", "normal"}
RANDOM_FUNCTIONS |= {"rand_like", "randn_like", "randint_like"}  # which take no generator
OTHER_DRAWS = {"rand", "randn", "random", "randint", "uniform", "normal", "gauss", "choice", "choices", "sample"}
OTHER_DRAWS |= {"shuffle", "permutation", "standard_normal"}
"""Draws by the modules ``random`` and ``numpy.random`` themselves, whose generators are everybody's."""
RANDOM_METHODS = {
    "multinomial",
    "bernoulli",
    "uniform_",
    "normal_",
    "bernoulli_",
    "random_",
    "exponential_",
    "cauchy_",
    "log_normal_",
    "geometric_",
}
PACKAGE_FILES = sorted(PACKAGE.rglob("*.py"))
CODE_FILES = PACKAGE_FILES + sorted(
    file for name in ("recipes", "benchmarks") for file in (REPOSITORY / name).glob("*.py")
)


def relative(file: Path) -> str:
    return file.relative_to(REPOSITORY).as_posix()


def tree(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"), filename=str(file))


def part(file: Path) -> str:
    """``agility_rl/envs/rewards.py`` -> ``envs``; ``agility_rl/keys.py`` -> ``keys``; the package's init -> ````."""
    steps = file.relative_to(PACKAGE).with_suffix("").parts
    return "" if steps == ("__init__",) else steps[0]


def imports(syntax: ast.Module, package: tuple[str, ...]) -> Iterator[tuple[int, str]]:
    """Line and dotted name of everything imported, at any depth; ``from a import b`` gives ``a.b``."""
    for node in ast.walk(syntax):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            origin = ".".join((*above, *((node.module,) if node.module else ())))
            yield from ((node.lineno, f"{origin}.{alias.name}") for alias in node.names)


def forbidden_imports(syntax: ast.Module, own: str, package: tuple[str, ...]) -> list[str]:
    found = []
    for line, name in imports(syntax, package):
        top, *rest = name.split(".")
        if top in FORBIDDEN_EVERYWHERE or name.startswith("torch.utils.tensorboard"):
            found.append(f"line {line} imports {name}, which nothing in the package may")
        elif top == "torchrl" and own not in MAY_IMPORT_TORCHRL:
            found.append(f"line {line} imports {name}, but {own or 'the package itself'} does without torchrl")
        elif (
            top == "agility_rl" and rest and rest[0] in MAY_IMPORT and rest[0] != own and rest[0] not in MAY_IMPORT[own]
        ):
            allowed = ", ".join(sorted(MAY_IMPORT[own])) or "none"
            found.append(f"line {line} imports {name}; parts that {own or 'the package itself'} may import: {allowed}")
    return found


def name_of(function: ast.expr) -> str:
    """Dotted name of a called expression, as far as it has one."""
    if isinstance(function, ast.Attribute):
        return f"{name_of(function.value)}.{function.attr}"
    return function.id if isinstance(function, ast.Name) else ""


def is_true(node: ast.expr | None) -> bool:
    return isinstance(node, ast.Constant) and node.value is True


def restricts_unpickling(syntax: ast.Module) -> bool:
    """Whether a file defines an unpickler that names the classes it accepts."""
    return any(
        isinstance(node, ast.ClassDef)
        and any(name_of(base).endswith("Unpickler") for base in node.bases)
        and any(isinstance(item, ast.FunctionDef) and item.name == "find_class" for item in node.body)
        for node in ast.walk(syntax)
    )


def unsafe_loads(syntax: ast.Module) -> list[str]:
    """Calls that would run code out of a file."""
    found = []
    for node in ast.walk(syntax):
        if not isinstance(node, ast.Call):
            continue
        name = name_of(node.func)
        options = {keyword.arg: keyword.value for keyword in node.keywords}
        unsafe = (
            name in {"pickle.load", "pickle.loads", "eval", "exec", "yaml.load", "cloudpickle.load", "joblib.load"}
            or (name == "pickle.Unpickler" and not restricts_unpickling(syntax))
            or (name == "torch.load" and not is_true(options.get("weights_only")))
            or is_true(options.get("allow_pickle"))
            or ("weights_only" in options and not is_true(options["weights_only"]))
        )
        if unsafe:
            found.append(f"line {node.lineno} calls {name}")
    return found


def unseeded_draws(syntax: ast.Module) -> list[str]:
    """Draws from a global generator, of torch, NumPy or Python."""
    found = []
    for node in ast.walk(syntax):
        if isinstance(node, ast.Call):
            origin, _, function = name_of(node.func).rpartition(".")
            draws = (
                (origin == "torch" and function in RANDOM_FUNCTIONS)
                or (origin in {"random", "np.random", "numpy.random"} and function in OTHER_DRAWS)
                or (
                    isinstance(node.func, ast.Attribute)
                    and node.func.attr in RANDOM_METHODS
                    and not origin.endswith("init")
                )
            )
            if draws and not any(keyword.arg == "generator" for keyword in node.keywords):
                found.append(f"line {node.lineno} draws by {function or ast.unparse(node.func)} without generator=")
    return found


@pytest.mark.parametrize("file", PACKAGE_FILES, ids=relative)
def test_a_file_imports_only_what_its_layer_may(file: Path) -> None:
    assert part(file) in MAY_IMPORT, f"{relative(file)} belongs to no layer: add its part to MAY_IMPORT"
    assert not forbidden_imports(tree(file), part(file), file.relative_to(REPOSITORY).parent.parts)


@pytest.mark.parametrize(
    ("own", "source", "allowed"),
    [
        ("motion", "from agility_rl.go2 import kinematics", True),
        ("motion", "from agility_rl.modules import Critic", False),
        ("motion", "from agility_rl import modules", False),
        ("motion", "from ..modules import Critic", False),
        ("motion", "from .clip import MotionClip", True),
        ("envs", "import agility_rl.simulation.batch", True),
        ("envs", "def late():\n    import agility_rl.motion", False),
        ("simulation", "import agility_rl.envs", False),
        ("deploy", "import torchrl", False),
        ("record", "from torchrl.record.loggers import Logger", True),
        ("record", "from torch.utils.tensorboard import SummaryWriter", False),
        ("training", "from agility_rl import keys", False),
        ("", "from agility_rl import keys", False),
        ("collectors", "from agility_rl.record.messages import read_messages", True),
        ("collectors", "from agility_rl import modules", False),
        ("record", "from agility_rl import collectors", False),
        ("collectors", "import recipes", False),
    ],
)
def test_the_import_rule_itself(own: str, source: str, allowed: bool) -> None:
    assert (not forbidden_imports(ast.parse(source), own, ("agility_rl", own))) is allowed


@pytest.mark.parametrize("package", sorted(PUBLIC))
def test_public_names_exist_with_documentation_and_example(package: str) -> None:
    module = importlib.import_module(f"agility_rl.{package}")
    assert set(PUBLIC[package]) <= set(module.__all__)
    for name in module.__all__:
        assert hasattr(module, name), f"agility_rl.{package}.__all__ names {name}, which is not there"
    for name in PUBLIC[package]:
        text = getattr(module, name).__doc__ or ""
        assert len(text) > 40, f"agility_rl.{package}.{name} has no docstring"
        assert ">>>" in text, f"agility_rl.{package}.{name} has no example in its docstring"
        if package in {"modules", "losses"}:
            assert "Source:" in text, f"agility_rl.{package}.{name} does not say where its formula comes from"


@pytest.mark.parametrize("file", [file for file in PACKAGE_FILES if file.name != "__init__.py"], ids=relative)
def test_every_module_has_a_test_file(file: Path) -> None:
    expected = REPOSITORY / "tests" / file.relative_to(PACKAGE).with_name(f"test_{file.name}")
    assert expected.is_file(), f"{relative(file)} has no tests: expected {relative(expected)}"


@pytest.mark.parametrize("folder", sorted({file.parent for file in PACKAGE_FILES}), ids=relative)
def test_every_folder_is_a_package(folder: Path) -> None:
    assert (folder / "__init__.py").is_file()


@pytest.mark.parametrize("file", CODE_FILES, ids=relative)
def test_no_file_is_loaded_unsafely(file: Path) -> None:
    assert not unsafe_loads(tree(file))


RESTRICTED = "class Restricted(pickle.Unpickler):\n    def find_class(self, module, name): ...\nRestricted(file).load"


@pytest.mark.parametrize(
    ("call", "arguments", "safe"),
    [
        ("torch.load", "path", False),
        ("pickle.load", "file", False),
        ("pickle.Unpickler(file).load", "", False),
        (RESTRICTED, "", True),
        ("numpy.load", "path", True),
    ],
)
def test_the_rule_on_loads_itself(call: str, arguments: str, safe: bool) -> None:
    assert (not unsafe_loads(ast.parse(f"{call}({arguments})"))) is safe


@pytest.mark.parametrize(
    ("call", "option", "safe"), [("torch.load", "weights_only", True), ("numpy.load", "allow_pickle", False)]
)
def test_the_rule_on_loads_reads_the_option(call: str, option: str, safe: bool) -> None:
    """Safe with the one value of the option, unsafe with the other."""
    assert not unsafe_loads(ast.parse(f"{call}(path, {option}={safe})"))
    assert unsafe_loads(ast.parse(f"{call}(path, {option}={not safe})"))


@pytest.mark.parametrize("file", CODE_FILES, ids=relative)
def test_no_random_number_comes_from_the_global_generator(file: Path) -> None:
    assert not unseeded_draws(tree(file))


@pytest.mark.parametrize(
    ("source", "seeded"),
    [
        ("torch.rand(3)", False),
        ("torch.rand(3, generator=g)", True),
        ("torch.empty(3).uniform_(0, 1)", False),
        ("x.normal_(generator=g)", True),
        ("torch.nn.init.uniform_(weight, -1, 1)", True),
        ("torch.zeros(3)", True),
        ("torch.randn_like(x)", False),
        ("p.multinomial(1)", False),
        ("p.multinomial(1, generator=g)", True),
        ("np.random.rand()", False),
        ("random.choice(rows)", False),
        ("np.random.default_rng(0)", True),
    ],
)
def test_the_rule_on_random_numbers_itself(source: str, seeded: bool) -> None:
    assert (not unseeded_draws(ast.parse(source))) is seeded


@pytest.mark.parametrize("file", CODE_FILES, ids=relative)
def test_a_file_is_one_idea(file: Path) -> None:
    limit = 300 if file.parent.name == "recipes" else 400
    lines = len(file.read_text(encoding="utf-8").splitlines())
    assert lines <= limit, f"{relative(file)} has {lines} lines, expected at most {limit}: it holds two ideas"
    assert file.stem not in {"utils", "util", "helpers", "common", "misc"}, f"{relative(file)}: name the idea"


def test_no_file_names_a_place_on_one_machine() -> None:
    place = re.compile(r"(?<![\w.$}])/(?:" + "|".join(("work", "root", "home", "tmp", "Users")) + r")/")
    texts = [
        file
        for name in ("agility_rl", "recipes", "benchmarks", "tests", "docs", ".ci")
        for file in (REPOSITORY / name).rglob("*")
        if file.is_file() and (file.suffix in {".py", ".md", ".toml", ".json"} or file.parent.name == ".ci")
    ]
    texts += [
        REPOSITORY / name for name in ("README.md", "CHANGELOG.md", "Makefile", "pyproject.toml", "constraints.txt")
    ]
    named = [
        f"{relative(file)}:{number}"
        for file in texts
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1)
        if place.search(line)
    ]
    assert not named
