"""Default TensorDict keys of the package, each with shape and unit.

Shapes: ``*B`` any leading batch, ``T`` time, ``J`` = 12 joints (FL, FR, RL, RR x hip, thigh, calf), ``K`` = 5 skills,
``H`` = 2 discriminator frames, ``F`` = 49 features of one frame, ``P`` = 45 proprioceptive numbers.
Every component takes other keys; these are what they use when none are given.
"""

from __future__ import annotations

ACTION = "action"
"""float32 ``[*B, J]``, joint targets in units of the action scale around the default pose."""

PROPRIOCEPTION = "proprioception"
"""float32 ``[*B, P]``, what the robot measures; layout in :data:`agility_rl.go2.features.PROPRIOCEPTION_LAYOUT`."""

EXPLICIT = "explicit"
"""float32 ``[*B, 4]``, true trunk height [m] and base-frame linear velocity x 0.5 [m/s]: the estimator's target."""

ESTIMATE = "estimate"
"""float32 ``[*B, 4]``, the state estimator's guess of :data:`EXPLICIT`."""

PRIVILEGED = "privileged"
"""float32 ``[*B, 29]``, trunk mass offset [kg], its centre offset 3 [m], friction, gain multipliers - 1 (12 + 12)."""

HISTORY = "history"
"""float32 ``[*B, 10, P]``, the newest proprioceptions, oldest first, the present one included."""

LATENT = "latent"
"""float32 ``[*B, 29]``, encoding of the privileged quantities or of the history."""

COMMAND = "command"
"""float32 ``[*B, 11]``, v_x, v_y [m/s], yaw rate [rad/s], jump height, locomotion height [m], shift, one-hot skill."""

PEAK = "peak"
"""float32 ``[*B, 1]``, highest trunk position [m] of the last 0.9 s while jumping, else 0."""

ENCOUNTER = "encounter"
"""float32 ``[*B, 7]``, what lies in the way: one-hot bar, ramp, box; its height, the robot's place along and across it
[m], and the sine of the robot's heading to it. For critics only: no robot sees it."""

MOTION = "motion"
"""float32 ``[*B, H, F]``, consecutive discriminator frames, oldest first."""

SKILL = "skill"
"""int64 ``[*B]``, index into :data:`agility_rl.behaviours.BEHAVIOURS`; the latent c, or a label."""

SHIFT = "shift"
"""float32 ``[*B, 1]``, the latent shifting variable epsilon in [-1, 1]."""

DISCRIMINATOR_LOGIT = "discriminator_logit"
"""float32 ``[*B, 1]``, D(o): trained towards +1 on dogs and -1 on the policy (least squares)."""

SKILL_LOGITS = "skill_logits"
"""float32 ``[*B, K]``, unnormalised log Q^c(. | o)."""

SHIFT_ESTIMATE = "shift_estimate"
"""float32 ``[*B, 1]``, Q^epsilon(o)."""

REWARD_TERMS = "reward_terms"
"""nested: one float32 ``[*B, 1]`` per reward term, already multiplied by weight and time step."""

MEASUREMENT = "measurement"
"""float32 ``[*B, 29]``, roll, pitch, angular velocity, joints; :data:`agility_rl.go2.features.MEASUREMENT_LAYOUT`."""

TRANSITION_LOGIT = "transition_logit"
"""float32 ``[*B, 1]``, D(s, a, s'): high on the robot's transitions, low on the simulator's."""

BEHAVIOUR = "behaviour"
"""int64 ``[*B]``, under :data:`ACTION`: the behaviour that the teacher or student chose; indexes as :data:`SKILL`."""

PARAMETERS = "parameters"
"""float32 ``[*B, K, 6]``, under :data:`ACTION`: v_x, v_y, yaw rate, jump height, locomotion height, shift of each."""

SCANDOTS = "scandots"
"""float32 ``[*B, 132]``, how far the terrain lies below trunk height - 0.3 [m], at 11 x 12 points ahead, flattened."""

TERRAIN_LATENT = "terrain_latent"
"""float32 ``[*B, 32]``, encoding of the scandots, or of depth images."""

HEADING_ERROR = "heading_error"
"""float32 ``[*B, 2]``, angle from the robot's heading to the current and to the next way-point [rad], in (-pi, pi]."""

PLACE = "place"
"""float32 ``[*B, 8]``, where a robot stands: x, y of its current and of its next way-point in its own frame [m]; its
x, y [m], sine and cosine of its yaw in the frame of the obstacle to pass."""

OBSTACLE = "obstacle"
"""float32 ``[*B, 7]``, one-hot type of the obstacle to pass; order of :data:`agility_rl.envs.obstacles.OBSTACLES`. Who
misjudges the place is told none of an obstacle that has not been in view."""

PROGRESS = "progress"
"""float32 ``[*B, S]``, one-hot: which way-point is the present one, of those of each obstacle of each route of the
course, in their order; obstacles of fewer way-points than others leave entries unused."""

OUTCOME = "outcome"
"""nested bool: ``[*B, 1]`` ``success``, ``finished``; ``[*B, 7]`` ``passed``, ``bypassed``, ``failed``, a type each."""

TERMINATIONS = "terminations"
"""nested: one bool ``[*B, 1]`` per reason for which an episode fails, true in the step in which it holds."""

DEPTH = "depth"
"""float32 ``[*B, 58, 87]``, normalised depth image in [-0.5, 0.5], near is small; stored as uint8 or int16 too."""

IMAGE_AGE = "image_age"
"""float32 ``[*B, 1]``, how long ago the depth image was taken [s]."""

DEPTH_FEATURE = "depth_feature"
"""float32 ``[*B, 32]``, what the depth encoder makes of one image."""

HIDDEN = "hidden"
"""float32 ``[*B, 512]``, the student's memory before a step; more of it where that knows a place
(:class:`agility_rl.modules.RecurrentStudent`)."""

HEADING_ESTIMATE = "heading_estimate"
"""float32 ``[*B, 2]``, the student's guess of :data:`HEADING_ERROR` [rad]."""

PLACE_ESTIMATE = "place_estimate"
"""float32 ``[*B, 8]``, the student's guess of :data:`PLACE`, where its teacher reads that."""

SCAN_MATCH = "scan_match"
"""float32 ``[*B, 21]``, where the obstacle ahead is seen by its shape: x, y [m], sine and cosine of its yaw in the
robot's frame, then the variances of x, y [m^2] and yaw [rad^2]; the same of the obstacle after it, and what speaks for
each of its 7 types [nat]."""

PROGRESS_LOGITS = "progress_logits"
"""float32 ``[*B, S]``, the student's log-probabilities of :data:`PROGRESS`, where its teacher reads the place."""

OBSTACLE_LOGITS = "obstacle_logits"
"""float32 ``[*B, 7]``, the student's unnormalised log-probabilities of :data:`OBSTACLE`."""

LABEL = "label"
"""nested: what the teacher would do, ``behaviour`` int64 ``[*B]`` and ``parameters`` float32 ``[*B, K, 6]``."""

PROJECTION = "projection"
"""float32 ``[*B, 64]``, BYOL's projection of an image's feature."""

PREDICTION = "prediction"
"""float32 ``[*B, 64]``, BYOL's prediction of the projection of the same image seen otherwise."""
