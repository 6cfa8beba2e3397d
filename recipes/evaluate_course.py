"""Measure a Task-Specific Controller on courses: does the robot pass them, how fast, and with which behaviours?

In:  a run folder of ``tsc_teacher.py`` or ``tsc_student.py``, or its ``policy/`` folder; or a script, a behaviour
     and a speed for each obstacle, turned towards the way-points: a baseline that needs only the controller below.
Out: tables on the screen, ``RUN/course_evaluation.json``, ``RUN/figures/course_*.png``; an earlier one is replaced.

    python recipes/evaluate_course.py runs/my_teacher                    # the course that it was trained on
    python recipes/evaluate_course.py runs/my_teacher --course targets   # full, each obstacle alone, box, hurdles
    python recipes/evaluate_course.py --script trot:1.2 --course each --episodes 50
    python recipes/evaluate_course.py --script trot:1.2,bar_jump=jump:1.4 --course bar_jump
    python recipes/evaluate_course.py --script guide --bbc pretrained/bbc_guided --course each full
    MUJOCO_GL=egl python recipes/evaluate_course.py runs/my_teacher --strip  # pictures of a whole course
    python recipes/evaluate_course.py runs/my_student --disturbance all  # rectangles, noise, ..., a late camera

Courses: a preset, a .toml or .json file, ``each`` for every obstacle of the challenge alone, or ``targets``.
Every episode has a course of its own at the released difficulty, starts before the first obstacle, and is driven by the
deterministic deployable teacher (history encoder) or student (depth images, its own memory and headings), with the
frozen BBC and without noise on its commands. Several students, with and without BYOL: ``compare_students.py``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from course_judgement import behaviour_seconds, print_courses, summarise, targets
from course_pictures import typical, view
from course_rollouts import Episode, record_episodes, shares
from course_strip import course_strip
from deciders import Decider, load_decider, load_script
from disturbances import DISTURBANCES, Disturbance, chosen
from judgement import to_json
from rich.console import Console
from rich.progress import Progress
from torch import Tensor
from tsc_setup import course_of, frozen
from unique_names import unique_names

from agility_rl.behaviours import FASTEST_CANTER
from agility_rl.envs import AgilityEnv, Course
from agility_rl.envs.agility import COURSE_RANDOMIZATION
from agility_rl.envs.course_presets import CHALLENGE
from agility_rl.envs.obstacles import OBSTACLES
from agility_rl.envs.randomization import NOMINAL
from agility_rl.go2.constants import CONTROL_DT
from agility_rl.record.course_plots import behaviour_use, plan_view
from agility_rl.record.plots import save_figure
from agility_rl.training import cli, run_folder

GROUPS = {"each": CHALLENGE, "targets": ("full", *CHALLENGE, "box", "hurdles")}
"""Names that stand for several courses; the second holds all that stage 3 has a target for."""
RANDOMIZATIONS = {
    "none": None,
    "friction": replace(NOMINAL, friction=COURSE_RANDOMIZATION.friction),
    "training": COURSE_RANDOMIZATION,
}
"""What is drawn anew for each episode; ``friction`` is what the release evaluates with (method notes, section 8)."""


@dataclass(frozen=True)
class Config:
    run: Annotated[Path | None, tyro.conf.Positional] = None
    """Run or artifact folder of a teacher or student."""
    script: str | None = None
    """BEHAVIOUR:SPEED [m/s], such as trot:1.2, or trot:1.2,bar_jump=jump:1.4,... , in place of it; or ``guide`` or
    ``leap`` (over hurdles), which know in metres where robots stand; they may also decide for one obstacle:
    bar_jump=leap."""
    fastest_canter: float | None = None
    """Fastest canter that a script may command [m/s]; Table S2's by default. A teacher or student says itself."""
    bbc: Path | None = None
    """Folder of the Basic Behaviour Controller: that of the training by default, for a script that of the teachers."""
    course: tuple[str, ...] = ()
    """Courses; by default the one that it was trained on, for a script ``full``."""
    disturbance: tuple[str, ...] = ("none",)
    """Of a student's camera: none, rectangles, noise, blur, dropout, late_1, late_2, pitch; ``all`` for each."""
    strength: int = 1
    """How many times images are disturbed."""
    episodes: int = 500
    """Episodes of each course."""
    robots: int = 125
    """Most robots simulated at once; each of them runs its share of the episodes from start to end."""
    behaviours: tuple[str, ...] | None = None
    """Behaviours that it may choose, by default all that it was trained with."""
    goal_radius: float = 0.45
    """Distance at which a way-point is reached [m]; the release trains with 0.4 and evaluates with 0.45."""
    episode_length: float = 40.0
    """Seconds until an episode counts as failed."""
    randomization: Literal["none", "friction", "training"] = "none"
    """Nominal robot and ground; drawn friction; or friction, mass, centre of mass and delay as in training."""
    push_interval: float | None = None
    """Seconds between pushes (training of the paper: 8)."""
    noise: float = 0.0
    """Factor on the observation noise (training: 0)."""
    misjudgement: float = 0.0
    """Factor on how wrong a teacher is about its place, obstacle and terrain, as a student is
    (``docs/student_experiments.md``)."""
    seed: int = 1000
    """Seed of courses and start places; training draws its own from another generator, so none of them was seen."""
    num_threads: int | None = None
    """Threads of the simulator."""
    strip: bool = False
    """Render the successful episode of median time: before, on and behind every obstacle (``MUJOCO_GL=egl``)."""
    output: Path | None = None
    """Folder of the results; by default the run, for a script ``runs/script_BEHAVIOUR_SPEED``."""


def simulate(
    course: Course,
    decider: Decider,
    config: Config,
    progress: Callable[[], object] = lambda: None,
    disturbance: Disturbance = DISTURBANCES["none"],
) -> list[Episode]:
    """All episodes of one course under one disturbance."""
    quota = shares(config.episodes, config.robots)
    env = AgilityEnv(
        len(quota),
        frozen(decider.controller),
        course,
        simulator_options={"num_threads": config.num_threads, "friction_loss": decider.controller.friction_loss},
        decision_steps=1,
        command_noise=(1.0, 1.0),
        fastest_canter=decider.fastest_canter,
        randomization=RANDOMIZATIONS[config.randomization],
        observation_noise=config.noise,
        episode_length=config.episode_length,
        goal_radius=config.goal_radius,
        start="first",
        push_interval=config.push_interval,
        misjudgement=config.misjudgement,
        seed=config.seed,
    )
    episodes = record_episodes(env, decider, quota, progress, disturbance, config.seed)
    env.close()
    return episodes


def names(config: Config, decider: Decider) -> list[str]:
    """Courses to run, each once, groups taken apart."""
    wanted: dict[str, None] = {}
    for name in config.course or (decider.course,):
        wanted |= dict.fromkeys(GROUPS.get(name, (name,)))
    return list(wanted)


def check(config: Config) -> None:
    """Refuse impossible options before anything is loaded."""
    if config.episodes < 1 or config.robots < 1 or config.episode_length < CONTROL_DT or config.goal_radius <= 0.0:
        raise ValueError("expected --episodes and --robots of at least 1, --episode-length and --goal-radius above 0")
    if config.push_interval is not None and config.push_interval < CONTROL_DT:
        raise ValueError(f"expected --push-interval of at least {CONTROL_DT} s, got {config.push_interval}")
    if (config.run is None) == (config.script is None):
        raise ValueError(
            "expected either the folder of a teacher or student, or --script BEHAVIOUR:SPEED, such as trot:1.2"
        )
    if config.script is not None and config.behaviours is not None:
        raise ValueError("--behaviours limits a teacher or student; a script says itself which it chooses")
    if config.run is not None and config.fastest_canter is not None:
        raise ValueError("--fastest-canter is for a script; what a teacher or student commands was settled in training")


def draw_strip(course: Course, episodes: Sequence[Episode], file: Path, console: Console) -> None:
    """Render the successful episode of median time, where there is one and this machine can."""
    successes = [episode for episode in typical(episodes) if episode.success]
    if not successes:
        console.print(f"{course.name}: no episode succeeded, so there is none to render")
        return
    try:
        save_figure(course_strip(course, successes[0]), file)
    except Exception as error:  # whatever a graphics driver may raise: the evaluation is worth more
        console.print(f"{file} was not rendered: {type(error).__name__}: {error}; try MUJOCO_GL=egl")


def evaluate(config: Config, console: Console) -> dict[str, Any]:
    """The whole evaluation; writes it and returns it."""
    check(config)
    disturbances = chosen(config.disturbance, config.strength)
    begin = time.monotonic()
    if config.run is not None:
        decider = load_decider(config.run, config.bbc, config.behaviours)
    else:
        fastest = FASTEST_CANTER if config.fastest_canter is None else config.fastest_canter
        decider = load_script(str(config.script), config.bbc, fastest)
    if decider.student is None and set(disturbances) != {"none"}:
        raise ValueError(f"--disturbance: {decider.name} has no camera to disturb; give a student")
    if decider.student is not None and config.misjudgement:
        raise ValueError(f"--misjudgement: {decider.name} misjudges its place by itself; give a teacher")
    if config.run is None and config.misjudgement:
        raise ValueError(f"--misjudgement: {decider.name} knows nothing to do about an unseen obstacle; give a teacher")
    cells = [(name, key) for name in names(config, decider) for key in disturbances]
    courses = {name: course_of(name) for name, _ in cells}
    files = dict(zip(courses, unique_names(list(courses)), strict=True))
    output = config.output or decider.run or Path("runs") / decider.name
    found: dict[str, Any] = {}
    use: dict[str, Tensor] = {}
    with Progress(console=console, transient=True) as bar:
        for name, key in cells:
            course, label, file = courses[name], name, files[name]
            if key != "none":
                label, file = f"{name}, {disturbances[key].label}", f"{file}_{key}"
            if not decider.knows(course):
                console.print(f"{name}: obstacles stand elsewhere than {decider.name} knows, so that it loses its way")
            task = bar.add_task(label, total=config.episodes)
            episodes = simulate(course, decider, config, partial(bar.advance, task), disturbances[key])
            found[label] = summarise(course, episodes)
            figure = plan_view([view(course, episode, config.goal_radius) for episode in typical(episodes)])
            save_figure(figure, output / "figures" / f"course_{file}.png")
            if config.strip:
                draw_strip(course, episodes, output / "figures" / f"course_{file}_strip.png", console)
            seconds = behaviour_seconds(episodes)
            for index, obstacle in enumerate(OBSTACLES):
                if seconds[index].sum() > 0.0:
                    row = obstacle if obstacle == label else f"{file}: {obstacle}"
                    use[row.replace("_", " ")] = seconds[index]
    save_figure(behaviour_use(use), output / "figures" / "course_behaviours.png")
    result = {
        "format": "agility_rl.course_evaluation",
        "format_version": 1,
        "run": decider.name,
        "kind": decider.kind,
        "weights": decider.weights,
        "bbc": decider.controller.artifact.manifest["weights"]["sha256"],
        "decision_period": decider.decision_steps * CONTROL_DT,
        "behaviours": decider.behaviours,
        "fastest_canter": decider.fastest_canter,
        "settings": config,
        "versions": run_folder.versions(),
        "courses": found,
        "targets": targets(found, decider.kind),
        "seconds": time.monotonic() - begin,
    }
    run_folder.write_json(output / "course_evaluation.json", to_json(result))
    print_courses(result, console)
    console.print(
        f"{output / 'course_evaluation.json'} and figures written after {result['seconds']:.0f} s", highlight=False
    )
    return result


def main(arguments: Sequence[str] | None = None) -> None:
    """The command line."""
    config = cli.from_arguments(Config, arguments, doc=__doc__)
    with cli.one_line_errors():
        evaluate(config, cli.console(160))


if __name__ == "__main__":
    main()
