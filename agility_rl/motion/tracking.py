"""Targets of the joint controller with which the robot follows a recorded motion, as far as that goes without feedback.

A dog's joint angles are no actions: a proportional-derivative controller that is asked for them sags under the robot's
weight and lags behind. What has to be added follows from the same controller.
"""

from __future__ import annotations

import torch
from torch import Tensor

from agility_rl import rotations
from agility_rl.go2 import constants, kinematics
from agility_rl.motion.clip import MotionClip, MotionError


def joint_targets(
    clip: MotionClip,
    stiffness: float = constants.STIFFNESS,
    damping: float = constants.DAMPING + constants.JOINT_DAMPING,
    load: float = 0.8,
) -> Tensor:
    r"""Joint targets that let a proportional-derivative controller follow a clip.

    .. math:: q^*_t = q_{t+1} + \frac{K_d \dot q_{t+1} - w\, J(q_{t+1})^\top f_{t+1}}{K_p}

    with the feet on the ground bearing the weight in equal parts, :math:`f = m g / n` upwards. Dynamic forces are left
    out, so this is a start for learning and no tracking controller.

    Source: quasi-static equilibrium of a legged robot; the choice of terms is ours. On the 12 labelled clips of the
    development data, mean of the behaviours, the joints were 0.11 rad off over half a second (root mean square; 0.15
    with the joint angles alone), and the trunk 5 instead of 8 cm after 0.2 s.

    Args:
        clip: the motion; its frames must be one control step apart.
        stiffness: proportional gain [N m/rad].
        damping: derivative gain together with the joints' own damping [N m s/rad].
        load: share of the weight that is compensated; 1 made trunks rise.

    Returns:
        ``[T, 12]`` [rad]; the last frame asks for itself.

    Raises:
        MotionError: if the frames are not a control step apart.

    Example:
        >>> from agility_rl.motion import synthesize_gait
        >>> clip = synthesize_gait("trot")
        >>> joint_targets(clip).shape == clip.joint_position.shape
        True
    """
    if abs(clip.dt - constants.CONTROL_DT) > 1e-6:
        raise MotionError(
            f"clip {clip.name!r}: frames {clip.dt:g} s apart, expected {constants.CONTROL_DT:g}; resample it first"
        )
    upright = torch.tensor([0.0, 0.0, 1.0]).expand(clip.num_frames, 3)
    up = rotations.rotate_inverse(clip.root_quaternion, upright)
    standing = clip.foot_contact.to(up.dtype)
    share = standing / standing.sum(-1, keepdim=True).clamp(min=1.0)
    force = constants.TOTAL_MASS * constants.GRAVITY * share[..., None] * up[:, None]
    torque = -(foot_jacobian(clip.joint_position).mT @ force[..., None])[..., 0].flatten(-2)
    follower = clip.joint_position + (damping * clip.joint_velocity + load * torque) / stiffness
    return torch.cat((follower[1:], follower[-1:]))


def foot_jacobian(joint_position: Tensor) -> Tensor:
    r"""Derivative of the feet with respect to the joints of their own legs, :math:`J_{leg} = \partial p / \partial q`.

    Args:
        joint_position: ``[*B, 12]`` [rad].

    Returns:
        ``[*B, 4, 3, 3]`` [m/rad]: leg, coordinate in the trunk's frame, joint of the leg.

    Example:
        >>> foot_jacobian(torch.tensor(constants.DEFAULT_POSE)).shape
        torch.Size([4, 3, 3])
    """
    with torch.enable_grad():
        joints = joint_position.detach().requires_grad_()
        feet = kinematics.forward(joints)
        # No leg moves another's foot, so one backward pass serves all four legs.
        rows = [torch.autograd.grad(feet[..., axis].sum(), joints, retain_graph=True)[0] for axis in range(3)]
    return torch.stack([row.unflatten(-1, (4, 3)) for row in rows], -2)
