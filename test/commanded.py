# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Arms with errors, commands for them, and how far a corrected command misses what it means."""

from dataclasses import replace

import numpy as np

from calib_ros.apply.compensation import compensate
from calib_ros.apply.compensator import Compensator
from calib_ros.apply.simulation import Cell, faulty
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Frame
from calib_ros.kinematics.chain_file import load_chain, shipped_robots

CELL = Cell(length_error=1e-3, angle_error=1e-3)
ROBOTS = {name: load_chain(name) for name in shipped_robots()}
UR = ROBOTS['ur10e']
UR_TRUE = faulty(UR, CELL, np.random.default_rng(4))


def bare(chain, tool=(0.0, 0.0, 0.0)):
    """Return the arm alone, with a point of the flange as its target."""
    end = Frame(se3.transform(np.eye(3), np.array(tool, dtype=float)))
    return replace(chain, base=Frame(), tool=end)


def pose_errors(compensator, command, joints, approach=None):
    """Return position [m] and orientation error [rad] by forward kinematics alone, as vectors."""
    wanted = bare(compensator.nominal, compensator.tool).forward(command)
    reached = bare(compensator.calibrated, compensator.tool).forward(joints, approach)
    turn = wanted[:, :3, :3] @ np.swapaxes(reached[:, :3, :3], 1, 2)
    return wanted[:, :3, 3] - reached[:, :3, 3], se3.log_rotation(turn)


def missed(compensator, command, joints, approach=None):
    """Return the lengths (2, N) of position [m] and orientation error [rad]."""
    errors = pose_errors(compensator, command, joints, approach)
    return np.linalg.norm(errors, axis=2)


def twist(start, end):
    """Return shifts [m] and turns [rad] (N, 6) from poses to poses (N, 4, 4)."""
    turn = se3.log_rotation(end[:, :3, :3] @ np.swapaxes(start[:, :3, :3], 1, 2))
    return np.concatenate([end[:, :3, 3] - start[:, :3, 3], turn], axis=1)


def numeric_jacobian(chain, q, weight=1.0, step=1e-6):
    """Return (N, 6, n) by central differences of the forward kinematics."""
    chain, columns = bare(chain), []
    for move in step * np.eye(q.shape[1]):
        columns.append(twist(chain.forward(q - move), chain.forward(q + move)) / (2 * step))
    return np.stack(columns, axis=2) * np.repeat([1.0, weight], 3)[:, np.newaxis]


def regular(chain, count, seed=0, margin=0.05, least=None):
    """Draw configurations away from limits and singularities."""
    narrowed = replace(
        chain,
        joints=tuple(
            replace(joint, lower=joint.lower + margin, upper=joint.upper - margin)
            for joint in chain.joints
        ),
    )
    q = narrowed.random_joints(30 * count, np.random.default_rng(seed))
    rank = min(6, len(chain.joints))
    least = least or (0.05 if rank == 6 else 0.02)
    values = np.linalg.svd(numeric_jacobian(chain, q), compute_uv=False)[:, rank - 1]
    kept = q[values > least]
    assert len(kept) >= count
    return kept[:count]


def only_refusal(result):
    (refusal,) = result.refusals
    return refusal


def at_limit(nominal, true, q, joint=2, share=0.5):
    """Return commands with a limit that a share of the correction would reach."""
    correction = compensate(Compensator(nominal, true), q[None]).correction[0, joint]
    end = {'upper' if correction > 0.0 else 'lower': q[joint] + share * correction}
    joints = list(nominal.joints)
    joints[joint] = replace(joints[joint], **end)
    return replace(nominal, joints=tuple(joints))
