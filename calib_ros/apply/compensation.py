# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The correction in the robot's program: joint commands that reach the pose that was meant.

A controller believes the nominal arm N, the real one is the calibrated arm C. A command q means
the pose N(q) of the flange in the arm's base frame; it is replaced by the q' nearest to it with

    C(q') = N(q)

Both arms are taken without the base and tool frames of the measurement (tracker, reflector). In
equal frames these cancel: T_base C(q') T_tool = T_base N(q) T_tool. What a calibration leaves
open, where the base frame stands and the tool sits, is the subject of docs/compensation.md.

What cannot be corrected within the limits given is refused, sample by sample, with the reason.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib_ros.errors import ConfigError, InputError, UnknownNameError
from calib_ros.identification.region import Region
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.following import Follower
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.shown import Shown

EXACT, COMPROMISE = 1e-6, 0.02
"""Orientation errors [rad] tolerated of arms that can reach every orientation, and of others."""
NUDGE = 0.01
"""Step of the differences for velocities, in units of the largest correction."""
CHANGE_FLOOR = 1e-5
"""Changes of the correction that are never a jump, in units of the largest correction."""
ON_LIMIT = 1e-6
"""How far [rad or m] a command may lie beyond a limit by rounding."""
POSITIVE = (
    *('largest_turn', 'largest_shift', 'largest_position_error', 'largest_orientation_error'),
    *('orientation_weight', 'largest_change'),
)


@dataclass(frozen=True, eq=False, repr=False)
class Compensator(Shown):
    """What the controller believes, what the arm is, and how far a correction may go.

    Parameters
    ----------
    nominal : Chain
        The arm as the controller believes it, with the limits of its joints.
    calibrated : Chain
        The arm as identified. Base and tool frames of both are left aside.
    tool : three floats
        The point [m] in the flange frame whose position counts. It matters for arms that cannot
        reach every orientation, and for the errors reported.
    largest_turn, largest_shift : float
        Largest correction of a revolute [rad] and of a prismatic joint [m].
    largest_position_error : float
        Position error [m] that may remain.
    largest_orientation_error : float, optional
        Orientation error [rad] that may remain; by default 1e-6, and 0.02 of arms that cannot
        reach every orientation.
    orientation_weight : float, optional
        Metres of position error that a radian of orientation error counts for, where not both can
        vanish. By default 0.3, and 0.001 of arms that cannot reach every orientation: position
        first.
    largest_change : float
        Largest change of the correction between successive samples, relative to the move between
        them. Beyond it the correction jumps.
    region : Region, optional
        Where the calibration may be used; samples elsewhere are refused.

    """

    nominal: Chain
    calibrated: Chain
    tool: tuple[float, float, float] = (0.0, 0.0, 0.0)
    largest_turn: float = 0.1
    largest_shift: float = 0.05
    largest_position_error: float = 1e-6
    largest_orientation_error: float | None = None
    orientation_weight: float | None = None
    largest_change: float = 0.5
    region: Region | None = None

    def __post_init__(self) -> None:
        """Refuse chains that are not of one robot, and limits that are none."""
        ours, theirs = (
            [(joint.name, joint.type) for joint in chain.joints]
            for chain in (self.nominal, self.calibrated)
        )
        if ours != theirs:
            raise ConfigError(
                'the nominal and the calibrated chain must have the same joints in one order, not '
                f'{_listed(ours)} and {_listed(theirs)}'
            )
        if len(self.tool) != 3 or not np.isfinite(self.tool).all():
            raise ConfigError(f'tool must be three finite numbers [m], not {self.tool}')
        for name in POSITIVE:
            value = getattr(self, name)
            if value is not None and not 0.0 < value < np.inf:
                raise ConfigError(f'{name} must be a positive number, not {value}')

    @cached_property
    def follower(self) -> Follower:
        """Return what finds the corrections."""
        return Follower(
            self.nominal, self.calibrated, self.tool, self.largest, self.orientation_weight
        )

    @property
    def largest(self) -> FloatArray:
        """Return the largest correction (n,) of each joint [rad or m]."""
        sizes = {'revolute': self.largest_turn, 'prismatic': self.largest_shift}
        return np.array([sizes[joint.type] for joint in self.nominal.joints])


@dataclass(frozen=True)
class Refusal:
    """A sample that cannot be corrected as asked for, and why."""

    sample: int
    reason: str


@dataclass(frozen=True, eq=False, repr=False)
class Compensation(Shown):
    """Corrected joint commands, with what they leave and what was refused.

    Attributes
    ----------
    command : (N, n)
        Joint values [rad or m] as the controller believes them.
    joints : (N, n)
        The corrected ones; NaN in samples that are refused.
    position, orientation : (N,)
        Errors that remain [m], [rad], of refused samples as well: what could be reached.
    position_before, orientation_before : (N,)
        Errors without correction.
    iterations : int
        Of the slowest sample.
    converged : (N,) bool
    limited : (N, n) bool
        Joints that are held at a limit.
    damped : (N,) bool
        Samples whose full correction would exceed the largest one: corrected in part.
    refusals : tuple of Refusal
        In the order of the samples.

    """

    command: FloatArray
    joints: FloatArray
    position: FloatArray
    orientation: FloatArray
    position_before: FloatArray
    orientation_before: FloatArray
    iterations: int
    converged: NDArray[np.bool_]
    limited: NDArray[np.bool_]
    damped: NDArray[np.bool_]
    refusals: tuple[Refusal, ...]

    @property
    def correction(self) -> FloatArray:
        """Return what is added to the command (N, n)."""
        return self.joints - self.command


@dataclass(frozen=True, eq=False, repr=False)
class Program(Shown):
    """A robot's program as joint values by name.

    Attributes
    ----------
    names : tuple of str
        Columns of the arrays; joints that are not of the arm may be among them.
    positions : (N, m)
        Joint values [rad or m], in the order in which they are run through.
    velocities, accelerations : (N, m), optional
        Their derivatives.
    approach : (N, n), optional
        Signs of the velocities with which the arm's joints come to their values, for backlash.
        Found from the order of the positions when None.

    """

    names: tuple[str, ...]
    positions: FloatArray
    velocities: FloatArray | None = None
    accelerations: FloatArray | None = None
    approach: FloatArray | None = None


def compensate(
    compensator: Compensator, joints: FloatArray, approach: FloatArray | None = None
) -> Compensation:
    """Correct joint commands (N, n) [rad or m], given in the order in which they are run through.

    `approach` (N, n) holds the signs of the velocities before, for backlash.

    Raises
    ------
    InputError
        For joint values of a wrong shape, or that are no finite numbers.

    """
    command = np.array(joints, dtype=np.float64)
    count = len(compensator.nominal.joints)
    if command.ndim != 2 or command.shape[1] != count or not len(command):
        raise InputError(f'joint values must have the shape (N, {count}), not {command.shape}')
    bad = np.flatnonzero(~np.isfinite(command).all(axis=1))
    if bad.size:
        raise InputError(f'joint values of sample {bad[0]} are not all finite numbers')
    if approach is not None and np.shape(approach) != command.shape:
        raise InputError(f'approach must have the shape {command.shape} of the joint values')
    follower = compensator.follower
    solution = follower.solve(command, approach)
    result = Compensation(
        command=command,
        joints=np.clip(command + solution.change, follower.lower, follower.upper),  # rounding
        position=solution.errors[:, 0],
        orientation=solution.errors[:, 1],
        position_before=solution.errors_before[:, 0],
        orientation_before=solution.errors_before[:, 1],
        iterations=solution.iterations,
        converged=solution.converged,
        limited=solution.held,
        damped=solution.damped,
        refusals=(),
    )
    result = _refused(result, _outside(compensator, result))
    result = _refused(result, _unreached(compensator, result))
    return _refused(result, _jumps(compensator, result))


def compensate_program(compensator: Compensator, program: Program) -> tuple[Program, Compensation]:
    """Return a program with corrected joint values, and what became of each sample.

    Velocities and accelerations follow the corrected path; times stay. Joints that are not of the
    arm stay as they are. Refused samples are NaN.

    Raises
    ------
    InputError, UnknownNameError
        For a joint of the arm that is missing, and arrays that do not fit the names.

    """
    columns = _columns(compensator.nominal.joint_names, program)
    positions = program.positions[:, columns]
    approach = approaches(positions) if program.approach is None else program.approach
    result = compensate(compensator, positions, approach)
    if program.velocities is None:
        return replace(program, positions=_put(program.positions, columns, result.joints)), result
    given = program.accelerations
    curve = np.zeros_like(program.velocities) if given is None else given
    speeds = program.velocities[:, columns]
    velocities, accelerations = _derivatives(
        compensator, result, speeds, curve[:, columns], approach
    )
    result = _refused(result, _held(result))
    result = _refused(result, _swings(compensator, result, speeds, velocities - speeds))
    refused = np.where(np.isnan(result.joints), np.nan, 0.0)
    return (
        replace(
            program,
            positions=_put(program.positions, columns, result.joints),
            velocities=_put(program.velocities, columns, velocities + refused),
            accelerations=None if given is None else _put(given, columns, accelerations + refused),
        ),
        result,
    )


def approaches(positions: FloatArray) -> FloatArray:
    """Return the sign (N, n) of the last move of each joint, 0 before it first moves."""
    moves = np.sign(np.diff(positions, axis=0, prepend=positions[:1]))
    last = np.where(moves != 0.0, np.arange(len(moves))[:, np.newaxis], 0)
    return np.asarray(np.take_along_axis(moves, np.maximum.accumulate(last, axis=0), axis=0))


def in_words(compensator: Compensator, result: Compensation) -> str:
    """Return the largest correction and the errors before and after, in a line."""
    kept = np.asarray(~np.isnan(result.joints).any(axis=1))
    text = f'{np.count_nonzero(kept)} of {len(kept)} samples corrected'
    if not kept.any():
        return text
    size = np.abs(result.correction[kept]).max(axis=0)
    for kind, unit in (('revolute', 'mrad'), ('prismatic', 'mm')):
        columns = [k for k, joint in enumerate(compensator.nominal.joints) if joint.type == kind]
        if columns:
            worst = max(columns, key=lambda k: float(size[k]))
            name = compensator.nominal.joint_names[worst]
            text += f', by {1e3 * size[worst]:.3f} {unit} at most ({name})'
    text += (
        f'; by the calibration, largest error {1e3 * result.position_before[kept].max():.3f} mm, '
    )
    text += f'{1e3 * result.orientation_before[kept].max():.3f} mrad'
    text += f' -> {1e3 * result.position[kept].max():.6f} mm, '
    text += f'{1e3 * result.orientation[kept].max():.6f} mrad'
    if result.damped[kept].any():
        text += f'; {np.count_nonzero(result.damped[kept])} corrected in part'
    return text


def _outside(compensator: Compensator, result: Compensation) -> list[Refusal]:
    """Return the samples at which the calibration may not be used."""
    region = compensator.region
    if region is None or region.whole:
        return []
    errors = region.sigma(result.command)
    outside = np.flatnonzero(errors > region.limit)
    share = 100.0 * len(outside) / len(errors)
    return [
        Refusal(
            k,
            f'outside the region of the calibration, like {share:.0f} % of the program: expected '
            f'error {1e3 * errors[k]:.3f} mm, at most {1e3 * region.limit:.3f} mm is allowed; '
            'identify again with poses near it',
        )
        for k in outside.tolist()
    ]


def _unreached(compensator: Compensator, result: Compensation) -> list[Refusal]:
    """Return the samples that are not corrected as asked for."""
    follower, names = compensator.follower, compensator.nominal.joint_names
    tolerated = compensator.largest_orientation_error
    if tolerated is None:
        tolerated = EXACT if follower.complete else COMPROMISE
    command, correction = result.command, result.correction
    beyond = (command < follower.lower - ON_LIMIT) | (command > follower.upper + ON_LIMIT)
    too_large = np.abs(correction) > compensator.largest
    remaining = result.position > compensator.largest_position_error
    remaining |= result.orientation > tolerated
    wrong = beyond.any(axis=1) | too_large.any(axis=1) | remaining | ~result.converged
    largest = f'{compensator.largest_turn:g} rad or {compensator.largest_shift:g} m'
    found = []
    for k in np.flatnonzero(wrong).tolist():
        left = f'{1e3 * result.position[k]:.4f} mm and {1e3 * result.orientation[k]:.4f} mrad'
        if beyond[k].any():
            i = int(beyond[k].argmax())
            reason = (
                f'the command {command[k, i]:.6g} of {names[i]} is beyond its limits '
                f'{follower.lower[i]:.6g} to {follower.upper[i]:.6g}'
            )
        elif result.limited[k].any():
            held = [name for name, at in zip(names, result.limited[k], strict=True) if at]
            reason = f'{", ".join(held)} would go beyond a limit; held there, {left} remain'
        elif result.damped[k]:
            reason = (
                f'near a singularity, or the calibration of another robot: corrections within '
                f'{largest} leave {left}'
            )
        elif too_large[k].any():
            i = int(too_large[k].argmax())
            size = f'a correction of {correction[k, i]:.6g}'
            reason = f'{names[i]} would need {size}, more than {largest}'
        else:
            how = 'remain' if result.converged[k] else 'remain, without convergence'
            reason = f'{left} {how}: more than is tolerated'
        found.append(Refusal(k, reason))
    return found


def _jumps(compensator: Compensator, result: Compensation) -> list[Refusal]:
    """Return the samples whose correction jumps against that of the sample before."""
    moves = np.abs(np.diff(result.command, axis=0))
    changes = np.abs(np.diff(result.correction, axis=0))  # NaN beside refused samples
    shares = changes / compensator.largest
    allowed = compensator.largest_change * (moves / compensator.largest).max(axis=1)
    found = []
    for k in np.flatnonzero(shares.max(axis=1) > allowed + CHANGE_FLOOR).tolist():
        i = int(shares[k].argmax())
        reason = (
            f'the correction of {compensator.nominal.joint_names[i]} jumps by {changes[k, i]:.4g} '
            f'while the joints move by {moves[k].max():.4g} at most'
        )
        found.append(Refusal(k + 1, reason))
    return found


def _held(result: Compensation) -> list[Refusal]:
    """Return the samples with a joint at its limit that are not refused yet."""
    held = np.flatnonzero(result.limited.any(axis=1) & ~np.isnan(result.joints).any(axis=1))
    reason = 'a joint is held at its limit, where its velocity is not defined'
    return [Refusal(sample, reason) for sample in held.tolist()]


def _swings(
    compensator: Compensator, result: Compensation, speeds: FloatArray, changes: FloatArray
) -> list[Refusal]:
    """Return the samples whose correction changes (N, n) too fast for their speeds (N, n).

    The limit is that of jumps, which samples far from each other do not show.
    """
    sizes = np.where(np.isnan(result.joints), 0.0, np.abs(changes))
    shares = sizes / compensator.largest
    allowed = compensator.largest_change * np.abs(speeds / compensator.largest).max(axis=1)
    found = []
    for k in np.flatnonzero(shares.max(axis=1) > allowed + CHANGE_FLOOR).tolist():
        i = int(shares[k].argmax())
        reason = (
            f'the correction of {compensator.nominal.joint_names[i]} moves at {sizes[k, i]:.4g} '
            f'while the joints move at {np.abs(speeds[k]).max():.4g} a second at most'
        )
        found.append(Refusal(k, reason))
    return found


def _refused(result: Compensation, more: Sequence[Refusal]) -> Compensation:
    """Return the result with further samples refused, their joint values set to NaN."""
    joints = result.joints.copy()
    joints[[refusal.sample for refusal in more]] = np.nan
    known = {refusal.sample for refusal in result.refusals}
    new = [refusal for refusal in more if refusal.sample not in known]
    refusals = sorted([*result.refusals, *new], key=lambda refusal: refusal.sample)
    return replace(result, joints=joints, refusals=tuple(refusals))


def _derivatives(
    compensator: Compensator,
    result: Compensation,
    velocities: FloatArray,
    accelerations: FloatArray,
    approach: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return velocities and accelerations (N, n) along the corrected path.

    Central differences of the correction along q + v t + a t^2 / 2, with a time step in which the
    command moves by a small part of the largest correction.
    """
    speed, bend = (
        np.abs(rates / compensator.largest).max(axis=1) for rates in (velocities, accelerations)
    )
    moving = speed + np.sqrt(speed**2 + 2.0 * NUDGE * bend)
    step = np.where(moving > 0.0, 2.0 * NUDGE / np.where(moving > 0.0, moving, 1.0), 1.0)
    step = step[:, np.newaxis]

    def correction(time: FloatArray) -> FloatArray:
        joints = result.command + time * velocities + 0.5 * time**2 * accelerations
        return compensator.follower.solve(joints, approach, bounded=False).change

    ahead, here, behind = correction(step), correction(0.0 * step), correction(-step)
    return (
        velocities + (ahead - behind) / (2.0 * step),
        accelerations + (ahead - 2.0 * here + behind) / step**2,
    )


def _columns(names: Sequence[str], program: Program) -> list[int]:
    """Return the columns of the arm's joints in a program."""
    shape = program.positions.shape
    if len(shape) != 2 or shape[1] != len(program.names):
        raise InputError(f'{len(program.names)} joint names do not fit positions of shape {shape}')
    for rates in (program.velocities, program.accelerations):
        if rates is not None and rates.shape != shape:
            raise InputError(f'rates of shape {rates.shape} do not fit positions of shape {shape}')
        if rates is not None and not np.isfinite(rates).all():
            raise InputError('velocities and accelerations must be finite numbers')
    if program.accelerations is not None and program.velocities is None:
        raise InputError('a program with accelerations needs velocities as well')
    for name in names:
        if program.names.count(name) > 1:
            raise InputError(f'joint "{name}" comes twice in the program')
    missing = [name for name in names if name not in program.names]
    others = [name for name in program.names if name not in names]
    if missing and others:
        (strange,) = difflib.get_close_matches(missing[0], others, n=1, cutoff=0.0)
        raise UnknownNameError('joint in the program', strange, names)
    if missing:
        raise InputError(f'the program has no values of {", ".join(missing)}')
    return [program.names.index(name) for name in names]


def _put(values: FloatArray, columns: Sequence[int], new: FloatArray) -> FloatArray:
    """Return values (N, m) with some columns replaced."""
    replaced = values.copy()
    replaced[:, columns] = new
    return replaced


def _listed(joints: Sequence[tuple[str, str]]) -> str:
    return ', '.join(f'{name} ({kind})' for name, kind in joints)
