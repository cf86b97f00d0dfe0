# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The correction of a program: joint commands that reach the intended pose.

A controller assumes the nominal arm N, the real one is the calibrated arm C. A command q means the
pose N(q) of the flange in the arm's base frame; it is replaced by the nearest q' with

    C(q') = N(q)

Base and tool frames of the measurement (tracker, reflector) cancel if equal: T_base C(q') T_tool =
T_base N(q) T_tool. docs/compensation.md explains what a calibration leaves open, where the base
stands and the tool sits. Samples that cannot be corrected within the limits are refused with the
reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from calib_ros.annotated import as_annotated, check_fields
from calib_ros.decision.region import Region
from calib_ros.errors import ConfigError, InputError
from calib_ros.kinematics.chain import Chain, refuse_other_joints
from calib_ros.kinematics.follower import Follower, Solution
from calib_ros.kinematics.inverse import a_turn_away
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.progress import Notify, quiet
from calib_ros.settings import EXACT, LEVER, TURN_IN_PART, Limits, refuse_larger
from calib_ros.shown import Shown

BESIDE = LEVER / 3.0
"""Distance [m] from the tool at which the effect of a turn is reported: a small tool's length."""


@dataclass(frozen=True, eq=False, repr=False)
class Compensator(Shown, Limits):
    """The arm the controller assumes, the real arm, and the limits of a correction (`Limits`)."""

    nominal: Chain
    """The arm the controller assumes, with its joint limits."""
    calibrated: Chain
    """The identified arm. Base and tool frames of both are ignored."""
    tool: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Tool point [m] in the flange frame. It matters for arms that cannot reach every
    orientation, and for the reported errors."""
    region: Region | None = None
    """Where the calibration may be used; samples elsewhere are refused."""

    def __post_init__(self) -> None:
        check_fields(self)
        known = 'the nominal chain', self.nominal
        refuse_other_joints('the calibrated chain', self.calibrated, *known)
        if not (np.abs(self.tool) <= 5.0).all():
            raise ConfigError(f'tool must be within 5 m, not {self.tool}: 150 mm is 0.15')
        for item in fields(Limits):
            value = getattr(self, item.name)
            if value is not None and not 0.0 < value < np.inf:
                raise ConfigError(f'{item.name} must be a positive number, not {value}')
            refuse_larger(item.name, value or 0.0, item.metadata)

    @cached_property
    def follower(self) -> Follower:
        """Return the solver of the corrections."""
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
    """A sample that cannot be corrected, and why."""

    sample: int
    reason: str


@dataclass(frozen=True, eq=False, repr=False)
class Compensation(Solution):
    """Corrected joint commands, their remaining errors (`Solution`), and refusals."""

    command: FloatArray
    """(N, n) joint values [rad or m] before correction."""
    joints: FloatArray
    """(N, n) the corrected ones; NaN in refused samples."""
    refusals: tuple[Refusal, ...] = ()
    """In the order of the samples."""

    @property
    def correction(self) -> FloatArray:
        """Return the change of the command (N, n)."""
        return self.joints - self.command


@as_annotated
def compensate(
    compensator: Compensator,
    joints: FloatArray,
    approach: FloatArray | None = None,
    progress: Notify = quiet,
) -> Compensation:
    """Correct joint commands (N, n) [rad or m], given in their order of execution.

    `approach` (N, n) holds the signs of the preceding velocities, for backlash; `progress`
    receives the share done.

    Raises InputError for joint values of the wrong shape, or not finite.
    """
    command = compensator.nominal.joint_values(joints).copy()
    if not len(command):
        raise InputError('there are no joint values to correct')
    if approach is not None and np.shape(approach) != command.shape:
        raise InputError(f'approach must have the shape {command.shape} of the joint values')
    follower = compensator.follower
    solution = follower.solve(command, approach, progress=progress)
    joints = np.clip(command + solution.change, follower.lower, follower.upper)  # rounding
    result = Compensation(**vars(solution), command=command, joints=joints)
    result = add_refusals(result, _outside(compensator, result))
    result = add_refusals(result, _unreached(compensator, result))
    moves, changes = (
        np.abs(np.diff(each, axis=0)) for each in (result.command, result.correction)
    )  # NaN beside refused samples
    words = 'jumps by {:.4g} while the joints move by {:.4g} at most'
    return add_refusals(result, too_fast(compensator, changes, moves, words, first=1))


def in_words(compensator: Compensator, result: Compensation) -> str:
    """Return the largest correction and the errors before and after, in a line."""
    kept = np.asarray(~np.isnan(result.joints).any(axis=1))
    text = f'{np.count_nonzero(kept)} of {len(kept)} points corrected'
    if not kept.any():
        return text
    size = np.abs(result.correction[kept]).max(axis=0)
    for kind, unit in (('revolute', 'mrad'), ('prismatic', 'mm')):
        columns = [k for k, joint in enumerate(compensator.nominal.joints) if joint.type == kind]
        if columns:
            worst = max(columns, key=lambda k: float(size[k]))
            name = compensator.nominal.joint_names[worst]
            text += f', by {1e3 * size[worst]:.3f} {unit} at most ({name})'
    turn, turned = result.orientation[kept].max(), result.orientation_before[kept].max()
    shift, shifted = result.position[kept].max(), result.position_before[kept].max()
    text += f'; largest error by the calibration {1e3 * shifted:.3f} -> {1e3 * shift:.3f} mm, '
    text += f'{1e3 * turned:.3f} -> {1e3 * turn:.3f} mrad'
    if not compensator.follower.complete and turn > turned:
        x, y, z = compensator.tool
        text += (
            '; this arm cannot keep every orientation: the position is corrected at the '
            f'point {x:g} {y:g} {z:g} m in the flange (--tool); {BESIDE:g} m away it may be '
            f'{1e3 * BESIDE * turn:.3f} mm off, {1e3 * BESIDE * turned:.3f} mm before'
        )
    if not compensator.follower.anywhere:
        squares = result.position[kept] ** 2 - result.reachable[kept] ** 2
        across = np.sqrt(max(float(squares.max()), 0.0))  # less than zero is rounding
        text += (
            '; this arm cannot move its target in every direction: of the position '
            f'{1e3 * across:.3f} mm are left, which no joint can correct'
        )
    if result.damped[kept].any():
        text += f'; {np.count_nonzero(result.damped[kept])} corrected in part'
    return text


def _outside(compensator: Compensator, result: Compensation) -> list[Refusal]:
    region = compensator.region
    if region is None or region.whole:
        return []
    errors = region.known(result.command)
    outside = np.flatnonzero(errors > region.limit)
    share = 100.0 * len(outside) / len(errors)
    return [
        Refusal(
            k,
            f'the calibration is not valid in {share:.0f} % of the program, as here: the '
            f'expected error by its parameters, {1e3 * errors[k]:.3f} mm, exceeds the limit of '
            f'{1e3 * region.limit:.3f} mm; identify again with poses near it',
        )
        for k in outside.tolist()
    ]


def _unreached(compensator: Compensator, result: Compensation) -> list[Refusal]:
    follower, names = compensator.follower, compensator.nominal.joint_names
    tolerated = compensator.largest_orientation_error
    if tolerated is None:
        tolerated = EXACT if follower.complete else TURN_IN_PART
    command, correction = result.command, result.correction
    apart, most = result.position, compensator.largest_position_error
    if most is None:
        apart, most = result.reachable, EXACT
    beyond = (command < follower.lower - EXACT) | (command > follower.upper + EXACT)
    too_large = np.abs(correction) > compensator.largest
    remaining = (apart > most) | (result.orientation > tolerated)
    # a redundant arm may oscillate among solutions, all correct, one in part among orientations
    away = (result.reachable > EXACT) | (follower.complete & (result.orientation > EXACT))
    astray = ~result.converged & away
    wrong = beyond.any(axis=1) | too_large.any(axis=1) | remaining | astray
    largest = f'{compensator.largest_turn:g} rad or {compensator.largest_shift:g} m'
    found = []
    for k in np.flatnonzero(wrong).tolist():
        left = f'{1e3 * result.position[k]:.4f} mm and {1e3 * result.orientation[k]:.4f} mrad'
        if beyond[k].any():
            i = int(beyond[k].argmax())
            reason = (
                f'the command {command[k, i]:.6g} of {names[i]} is beyond its limits '
                f'{follower.lower[i]:.6g} to {follower.upper[i]:.6g} (rad or m, not degrees)'
                + a_turn_away(compensator.nominal.joints[i], float(command[k, i]))
            )
        elif result.limited[k].any():
            held = [name for name, at in zip(names, result.limited[k], strict=True) if at]
            reason = f'{", ".join(held)} would go beyond a limit; held there, {left} remain'
        elif result.damped[k] and remaining[k]:
            reason = (
                f'near a singularity, or the calibration of another robot: corrections within '
                f'{largest} leave {left}'
            )
        elif too_large[k].any():
            i = int(too_large[k].argmax())
            size = f'a correction of {correction[k, i]:.6g}'
            reason = f'{names[i]} would need {size}, more than {largest}'
        elif result.converged[k] and not follower.complete:
            reason = (
                f'this arm cannot reach every pose: {left} remain, more than {1e3 * most:g} mm '
                f'or {1e3 * tolerated:g} mrad (--largest-orientation-error)'
            )
        else:
            how = '' if result.converged[k] else ', without convergence'
            reason = f'at the end of the reach, or near a singularity: {left} remain{how}'
        found.append(Refusal(k, reason))
    return found


def too_fast(
    compensator: Compensator, changes: FloatArray, moves: FloatArray, words: str, first: int = 0
) -> list[Refusal]:
    """Return the samples, from `first` on, whose correction changes too much.

    `changes` (N, n) of the correction are compared with `moves` (N, n) of the joints, both
    positive; `words` have places for change and move.
    """
    shares = (changes - EXACT) / compensator.largest
    allowed = compensator.largest_change * (moves / compensator.largest).max(axis=1)
    names, found = compensator.nominal.joint_names, []
    for k in np.flatnonzero(shares.max(axis=1) > allowed).tolist():
        i = int(shares[k].argmax())
        excess = words.format(changes[k, i], moves[k].max())
        found.append(Refusal(first + k, f'the correction of {names[i]} {excess}'))
    return found


def add_refusals(result: Compensation, more: Sequence[Refusal]) -> Compensation:
    """Return the result with further samples refused, their joint values NaN."""
    joints = result.joints.copy()
    joints[[refusal.sample for refusal in more]] = np.nan
    known = {refusal.sample for refusal in result.refusals}
    new = [refusal for refusal in more if refusal.sample not in known]
    refusals = sorted([*result.refusals, *new], key=lambda refusal: refusal.sample)
    return replace(result, joints=joints, refusals=tuple(refusals))
