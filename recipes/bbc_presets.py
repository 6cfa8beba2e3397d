"""Presets of stage 1: ``paper`` as published, ``cpu`` tuned for two cores, ``gpu`` the same with four times the robots
on a GPU (docs/gpu.md; not tried to its end), ``half_hour`` for who waits no longer,
``polish`` to go on from a controller that has all behaviours (``bbc_distill.py``), ``quickstart`` and ``smoke`` cut
from ``cpu``."""

from __future__ import annotations

from dataclasses import replace

from bbc_config import AdaptationConfig, Config, EnvConfig, ImitationConfig, MotionConfig, PPOConfig, TrialsConfig

PAPER = Config(
    motion=MotionConfig(mirror=False, standing_weight=1.0),
    env=EnvConfig(
        num_robots=4096,
        terrain="rough",
        action_delay=0.02,
        action_delay_from=20_000,
        jump_reward="window",
        jump_weight=0.2,
        friction_loss=0.0,
    ),
    # Released: 2 surrogate + 5 value - 0.01 entropy + 0.1 privileged, their gradient no longer than 1; here halved.
    ppo=PPOConfig(minibatches=4, value=2.5, entropy=0.005, max_grad_norm=0.5),
    adaptation=AdaptationConfig(privileged=0.05),
)
CPU = Config(
    iterations=1200,
    max_minutes=58.0,
    changes=(
        (350, "ppo.entropy", 0.0005),
        (500, "ppo.desired_kl", 0.008),
        (500, "imitation.imitation_reward", 6.0),
        (500, "env.jump_weight", 20.0),
        (700, "env.canter_stance", 0.03),
        (900, "env.jump_weight", 30.0),
    ),
    motion=MotionConfig(one_sided=("canter",), offsets=(0, 8, 16, 23, 24), standing_weight=0.0),
    env=EnvConfig(
        randomize=False,
        push_interval=None,
        observation_noise=0.0,
        friction_loss=0.0,
        collision_weight=-2.0,
        episode_length=8.0,
        progress_weight=8.0,
        progress_fade=(120, 120),
        progress_left=4.0,
        rhythm_weight=20.0,
        walk_growth=0.8,
        walk_emphasis=2.0,
        jump_weight=16.0,
        jump_width=0.03,
    ),
    ppo=PPOConfig(
        epochs=4,
        minibatches=8,
        learning_rate=3e-4,
        max_learning_rate=2e-3,
        desired_kl=0.02,
        gamma=0.98,
        entropy=0.002,
        precision="auto",
        averaging=0.96,
        initial_std=0.5,
        hidden=(256, 128, 64),
        critic_history=False,
    ),
    imitation=ImitationConfig(
        conditional=True,
        labelled_share=0.5,
        minibatches=3,
        batch_size=1024,
        labelled_batch_size=512,
        replay=400_000,
        discriminator_learning_rate=1e-4,
        encoder_learning_rate=3e-4,
        gradient_penalty=5.0,
        cloning=3000,
        warm_up=300,
        information=0.3,
        information_ramp=(50, 300),
        prior_weight=2e-3,
        prior_temperature=100.0,
        imitation_reward=4.0,
        skill_reward=2.0,
        skill_floor=-15.0,
        gate=1.0,
        task_reward=0.25,
        height_deviation=0.06,
    ),
    adaptation=AdaptationConfig(learning_rate=1e-3, every=20, minibatches=4, privileged_ramp=(100, 200)),
    trials=TrialsConfig(start=1000),
)
GPU = replace(CPU, simulator="warp", max_minutes=None, env=replace(CPU.env, num_robots=4096))
HALF_HOUR = replace(
    CPU,
    name="half_hour",
    iterations=675,
    max_minutes=30.0,
    changes=(
        (300, "ppo.entropy", 0.0005),
        (400, "ppo.desired_kl", 0.008),
        (400, "imitation.imitation_reward", 6.0),
        (400, "env.jump_weight", 20.0),
        (450, "env.canter_stance", 0.04),
        (550, "env.jump_weight", 28.0),
    ),
    ppo=replace(CPU.ppo, by_behaviour=True, compile=True),
    trials=TrialsConfig(start=650),
)
POLISH = replace(
    CPU,
    name="polish",
    iterations=90,
    changes=(),
    motion=replace(CPU.motion, one_sided=("canter", "jump")),
    # No fading: it walks already. No rhythm: those that this preset was made for came without.
    env=replace(CPU.env, progress_weight=4.0, rhythm_weight=0.0, jump_weight=20.0),
    ppo=replace(
        CPU.ppo,
        learning_rate=1e-4,
        max_learning_rate=5e-4,
        desired_kl=0.006,
        entropy=0.0005,
        critic_warm_up=20,
        averaging=0.0,  # what this preset made was made without
    ),
    imitation=replace(
        CPU.imitation,
        cloning=0,
        anchor=5.0,
        imitation_reward=2.0,
        skill_reward=1.0,
        information=0.05,
        information_ramp=(0, 50),
        prior_weight=0.02,
    ),
)
QUICKSTART = replace(
    CPU,
    name="quickstart",
    iterations=110,
    max_minutes=5.0,
    env=replace(CPU.env, num_robots=512, rhythm_weight=0.0),
    ppo=replace(CPU.ppo, averaging=0.0),  # 110 iterations of fast learning are too few to average over 25
    imitation=replace(CPU.imitation, cloning=500),
)
SMOKE = replace(
    CPU,
    name="smoke",
    iterations=2,
    checkpoint_every=1,
    env=replace(CPU.env, num_robots=16),
    ppo=replace(CPU.ppo, steps=8, epochs=1, minibatches=2, hidden=(32, 32)),
    imitation=replace(
        CPU.imitation,
        cloning=5,
        warm_up=5,
        minibatches=2,
        batch_size=32,
        labelled_batch_size=32,
        replay=2048,
        hidden=(32, 32),
    ),
    adaptation=replace(CPU.adaptation, every=2),
)
PRESETS = {
    "smoke": SMOKE,
    "quickstart": QUICKSTART,
    "half_hour": HALF_HOUR,
    "cpu": CPU,
    "gpu": GPU,
    "polish": POLISH,
    "paper": PAPER,
}
