# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The usual mistakes, tried out: units, conventions, joints, the wrong arm. Named, never mended.

Where the nominal arm misses the measurements by more than faulty arms do, each suspect changes
some samples, or the chain, and base and tool are found anew in closed form (`start.py`). Of the
best few they are polished by least squares. A suspect is named when the typical error so is
NEARER times that as given and within what faulty arms show; those that explain the same are named
together.

The typical error is the median over the samples of the distance and the angle times LEVER, in
units of the spread of the positions.
Nothing can be told where a mistake makes no difference: a first joint's zero is the base's turn,
a last one's the tool's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib_ros.identification.identifiability import excited
from calib_ros.identification.leastsquares import Samples, System, minimise, triangular_factor
from calib_ros.identification.observations import Observations
from calib_ros.identification.problem import Problem
from calib_ros.identification.reasons import Reason, Rule
from calib_ros.identification.start import closed_forms
from calib_ros.identification.validation import MOST_OUTLIERS
from calib_ros.kinematics import se3
from calib_ros.kinematics.chain import Chain, Frame
from calib_ros.kinematics.chain_file import shipped_chains
from calib_ros.kinematics.parameter import parameters_of
from calib_ros.kinematics.se3 import FloatArray

if TYPE_CHECKING:
    from calib_ros.identification.identification import Identification

Sets: TypeAlias = tuple[Observations, ...]
Change: TypeAlias = Callable[[Observations], Observations]
Made: TypeAlias = Callable[[], Sets]
DEGREE = np.pi / 180.0
SAMPLES = 48
"""Samples of a set, spread evenly, by which suspects are tried."""
FEWEST = 6
LEVER = 0.3
"""Distance [m] at which an angle counts as much as a position."""
NEARER = 0.3
"""Ratio of the typical errors from which a suspect is named."""
ALIKE = 1.5
"""Ratio of the typical errors of suspects that explain the same."""
POLISHED = 6
"""Suspects that are polished."""
ITERATIONS = 12
CONVINCING = 0.25
"""Share of the spread of the positions from which an error explains nothing."""
ROWS = (1, -1, 2, -2)
"""Rows by which joint values may stand beside another measurement."""
QUARTERS = {'+90': 0.5 * np.pi, '-90': -0.5 * np.pi, '+180': np.pi}
"""Zeros of joints [rad] that differ between conventions."""
SCALES = {'mm': 1e-3, 'cm': 1e-2, 'in': 0.0254}


@dataclass(frozen=True, eq=False)
class Suspect:
    """A mistake that may have been made.

    Attributes
    ----------
    what : str
        What was done, in words.
    remedy : str
        The option to give.
    chain : Chain
        The nominal chain, as it had to be.
    sets : callable
        Makes the samples that should have been given.
    rank : int
        Of those that explain the same, the lowest are named.

    """

    what: str
    remedy: str
    chain: Chain
    sets: Made
    rank: int = 1


@dataclass(frozen=True, eq=False)
class Explained:
    """What explains the measurements, and their typical errors [m] as given and so."""

    suspects: tuple[Suspect, ...]
    given: float
    so: float

    def __str__(self) -> str:
        """Return the mistake and the option to give."""
        whats = [f'{each.what}: {each.remedy}' for each in self.suspects]
        return (
            f'{" -- or ".join(whats)} (typical error so {1e3 * self.so:.2f} mm, as given '
            f'{1e3 * self.given:.4g} mm)'
        )


def remarked(problem: Problem, result: Identification) -> Identification:
    """Return the result with the mistake that explains its errors, if there are such.

    It stands first among the refusals, or among the remarks of a result that is not refused.
    """
    if not _suspicious(problem, result):
        return result
    found = explained(problem)
    if found is None:
        return result
    if result.refusals:
        return replace(result, refusals=(Reason(Rule.MISTAKE, str(found)), *result.refusals))
    return replace(result, remarks=(str(found), *result.remarks))


def _suspicious(problem: Problem, result: Identification) -> bool:
    """Tell whether errors, before or after, are larger than those of faulty arms."""
    judged = result.fitted if result.validation is None else result.validation
    before, after = judged.before, judged.after
    for each in (before, after, result.fitted.before):
        sizes = np.linalg.norm(each.position, axis=1)
        if np.sqrt(np.mean(sizes**2)) > problem.largest_error:
            return True
        turns = np.linalg.norm(each.orientation, axis=1)
        turns = turns[~np.isnan(turns)]
        if turns.size and np.sqrt(np.mean(turns**2)) > problem.largest_angle:
            return True
    if judged.outliers > MOST_OUTLIERS * len(judged.judged):
        return True
    arm = problem.chain.joint_names
    return any(
        p.std is not None
        and p.name.owner in arm
        and abs(p.offset) - 3.0 * p.std
        > (problem.largest_length if p.name.is_length else problem.largest_angle)
        for p in result.parameters
    )


def explained(problem: Problem) -> Explained | None:
    """Return what explains the measurements much better than what was given, if anything does."""
    sets = tuple(each for each in problem.sets if each.distances is None)
    if not sets or max(map(len, sets)) < FEWEST:
        return None
    if not any(each.socket for each in sets):
        sets = (max(sets, key=len),)
    chain = replace(
        problem.chain, base=_known(problem.chain.base), tool=_known(problem.chain.tool)
    )
    few = tuple(_few(each) for each in sets)
    given = _tried(chain, few)
    if given is None:
        return None
    rough = []
    for k, each in enumerate(_suspects(problem, chain, sets)):
        found = _tried(each.chain, each.sets())
        if found is not None and found.share < given.share:
            rough.append((found.share, k, each, found))
    tried = []
    for _, k, each, found in sorted(rough, key=lambda one: one[:2])[:POLISHED]:
        so = _polished(problem, found)
        tried.append((so.share, k, each, so))
    if not tried:
        return None
    tried.sort(key=lambda one: one[:2])
    best = tried[0][3]
    largest = problem.largest_error + LEVER * problem.largest_angle / 3.0
    if best.error > min(largest, NEARER * given.error):
        return None
    if best.share > min(NEARER * given.share, CONVINCING):
        return None
    given = min(given, _polished(problem, given), key=lambda one: one.share)
    if best.share > NEARER * given.share or best.error > NEARER * given.error:
        return None
    same = [each for share, _, each, _ in tried if share <= ALIKE * best.share]
    lowest = min(each.rank for each in same)
    named = tuple(each for each in same if each.rank == lowest)[:3]
    return Explained(named, given.error, best.error)


def _known(frame: Frame | None) -> Frame | None:
    return frame if frame is not None and frame.fixed else None


def _few(observations: Observations) -> Observations:
    count = len(observations)
    index = np.linspace(0, count - 1, min(count, SAMPLES)).round().astype(int)
    return observations.select(np.unique(index))


@dataclass(frozen=True, eq=False)
class _Trial:
    """A chain with its frames for some samples, and their typical error [m].

    `share` is the error in units of the spread of the positions, of the flange or measured, which
    is less: with metres taken for millimetres, or radians for degrees, every error is small.
    """

    chain: Chain
    sets: Sets
    error: float
    share: float


def _tried(chain: Chain, sets: Sets) -> _Trial | None:
    """Return the chain with its frames for some samples in closed form, set by set."""
    spreads = []
    for each in sets:
        best: tuple[float, Chain] | None = None
        alone = (replace(each, base='base', tool='tool'),)
        for start in closed_forms(chain, alone[0]):
            error = _error(start, alone)
            if np.isfinite(error) and (best is None or error < best[0]):
                best = error, start
        if best is None:
            return None
        bare = replace(best[1], base=None, tool=None).forward(each.joints)[:, :3, 3]
        seen = bare if each.socket else each.positions  # in sockets there is no measured place
        spreads.append(min(float(np.sqrt(one.var(axis=0).sum())) for one in (bare, seen)))
        chain = chain.with_frame(each.base, best[1].frame('base'))
        chain = chain.with_frame(each.tool, best[1].frame('tool'))
    return _trial(chain, sets, float(np.median(spreads)))


def _trial(chain: Chain, sets: Sets, spread: float) -> _Trial:
    error = _error(chain, sets)
    return _Trial(chain, sets, error, error / max(spread, 1e-9))


def _polished(problem: Problem, trial: _Trial) -> _Trial:
    """Return a trial with its frames by least squares."""
    chain, sets = trial.chain, trial.sets
    samples = [Samples(each, problem.sigma_position, problem.sigma_orientation) for each in sets]
    system = System(tuple(samples))
    frames = dict.fromkeys(name for each in sets for name in (each.base, each.tool))
    sockets = {each.base for each in sets if each.socket}
    names = [
        name
        for frame in frames
        if not chain.frame(frame).fixed
        for name in parameters_of(frame)
        if name.is_length or frame not in sockets
    ]
    known = excited(triangular_factor(chain, names, system), names)
    fitted = minimise(chain, known, system, tolerance=1e-2, iterations=ITERATIONS).chain
    spread = trial.error / trial.share if trial.share > 0.0 else np.inf
    return min(trial, _trial(fitted, sets, spread), key=lambda one: one.error)


def _error(chain: Chain, sets: Sets) -> float:
    """Return the median of the samples' errors [m]."""
    sizes = []
    for each in sets:
        found = chain.forward(each.joints, base=each.base, tool=each.tool)
        away = np.linalg.norm(each.positions - found[:, :3, 3], axis=1)
        if each.oriented.any():
            relative = np.swapaxes(found[:, :3, :3], 1, 2) @ each.rotations
            turns = np.linalg.norm(se3.log_rotation(relative), axis=1)
            away = away + LEVER * np.where(each.oriented, turns, 0.0)
        sizes.append(away)
    return float(np.median(np.concatenate(sizes)))


def _suspects(problem: Problem, chain: Chain, sets: Sets) -> Iterator[Suspect]:
    """Yield what may have gone wrong, the most usual first."""
    few = tuple(_few(each) for each in sets)
    measured = not any(each.socket for each in sets)

    def each_set(change: Change) -> Made:
        return lambda: tuple(change(each) for each in few)

    def joints(change: Callable[[FloatArray], FloatArray]) -> Made:
        return each_set(lambda each: replace(each, joints=change(each.joints)))

    def turned(rows: FloatArray, factor: float) -> FloatArray:
        return np.where(revolute, factor, 1.0) * rows

    revolute = np.array([joint.type == 'revolute' for joint in chain.joints])
    if measured:
        yield from _units(chain, few, each_set, turned)
        if all(each.oriented.any() for each in few):
            yield from _conventions(chain, few, each_set, turned)
        yield Suspect(
            'the axes of the measuring device are left-handed',
            'turn one of them round, --columns y=-y (of poses qx=-qx,qz=-qz as well)',
            chain,
            each_set(_mirrored),
            3,
        )
    yield Suspect(
        'the joint values are in degrees, not radians',
        '--joint-angle deg',
        chain,
        joints(lambda q: turned(q, DEGREE)),
    )
    yield Suspect(
        'the joint values are in radians, not degrees',
        '--joint-angle rad',
        chain,
        joints(lambda q: turned(q, 1.0 / DEGREE)),
    )
    yield from _of_joints(chain, joints, revolute)
    other = 'modified' if chain.convention == 'standard' else 'standard'
    yield Suspect(
        f'the DH table is in the {other} convention, not the {chain.convention} one',
        f'convention: {other} in the chain file',
        replace(
            chain, convention='modified' if other == 'modified' else 'standard', parallel=None
        ),
        lambda: few,
        3,
    )
    types = [joint.type for joint in chain.joints]
    for ours in shipped_chains():
        if [joint.type for joint in ours.joints] == types and not _same(ours, chain):
            yield Suspect(
                f'the arm is a {ours.name}, not a {chain.name}',
                f'--chain {ours.name}',
                replace(ours, base=chain.base, tool=chain.tool),
                lambda: few,
                2,
            )
    for rows in ROWS:
        where = 'below' if rows > 0 else 'above'
        count = f'{abs(rows)} row{"s" if abs(rows) > 1 else ""}'
        yield Suspect(
            f'the joint values stand {count} {where} the measurement that they belong to',
            f'--shift {rows}',
            chain,
            partial(_all_moved, problem, sets, rows),
            2,
        )


def _units(
    chain: Chain,
    few: Sets,
    each_set: Callable[[Change], Made],
    turned: Callable[[FloatArray, float], FloatArray],
) -> Iterator[Suspect]:
    """Yield units of lengths, and of angles at the same time."""
    for unit, size in SCALES.items():
        for way, factor in (
            (f'in {unit}, not metres', size),
            (f'in metres, not {unit}', 1 / size),
        ):
            option = f'--length {unit}' if factor == size else '--length m'
            for more, degrees in (('', 1.0), (' and the joint values in degrees', DEGREE)):

                def scaled(
                    each: Observations, factor: float = factor, degrees: float = degrees
                ) -> Observations:
                    return replace(
                        each,
                        positions=factor * each.positions,
                        joints=turned(each.joints, degrees),
                    )

                yield Suspect(
                    f'the positions are {way}{more}',
                    f'{option}{" --joint-angle deg" if more else ""}',
                    chain,
                    each_set(scaled),
                    1 if not more else 2,
                )


def _conventions(
    chain: Chain,
    few: Sets,
    each_set: Callable[[Change], Made],
    turned: Callable[[FloatArray, float], FloatArray],
) -> Iterator[Suspect]:
    """Yield ways to write a pose, with lengths in millimetres or joint values in degrees, too."""
    inverse = any(each.inverse for each in few)
    flange = (
        'the poses are those of the world in the target, as by a camera on the flange',
        '--eye-in-hand (or --inverse, where the device stands)',
    )
    if inverse:
        flange = ('the camera is not on the flange', 'leave out --eye-in-hand (or eye_in_hand)')
    ways: tuple[tuple[str, str, Change, bool], ...] = (
        ('the quaternions are w x y z, not x y z w', '--quaternion wxyz', _first_is_w, inverse),
        ('the quaternions are x y z w, not w x y z', '--quaternion xyzw', _last_is_w, inverse),
        (
            'the rotations are transposed, those of the device in the target',
            '--columns qx=-qx,qy=-qy,qz=-qz',
            _transposed,
            inverse,
        ),
        (*flange, _as_it_is, not inverse),
    )
    for what, remedy, change, again in ways:
        for more, option, size, angle in (
            ('', '', 1.0, 1.0),
            (', and the positions in mm', ' --length mm', 1e-3, 1.0),
            (', and the joint values in degrees', ' --joint-angle deg', 1.0, DEGREE),
            (
                ', the positions in mm and the joint values in degrees',
                ' --length mm --joint-angle deg',
                1e-3,
                DEGREE,
            ),
        ):

            def changed(
                each: Observations,
                change: Change = change,
                again: bool = again,
                size: float = size,
                angle: float = angle,
            ) -> Observations:
                each = each.inverted() if each.inverse else each  # as it was measured
                each = change(replace(each, positions=size * each.positions))
                each = replace(each, joints=turned(each.joints, angle))
                return each.inverted() if again else each

            rank = 2 if more else 1
            yield Suspect(f'{what}{more}', f'{remedy}{option}', chain, each_set(changed), rank)


def _of_joints(
    chain: Chain,
    joints: Callable[[Callable[[FloatArray], FloatArray]], Made],
    revolute: FloatArray,
) -> Iterator[Suspect]:
    """Yield signs, zeros, order and couplings of joints."""
    names = chain.joint_names
    count = len(names)
    for k, name in enumerate(names):
        signs = np.ones(count)
        signs[k] = -1.0
        yield Suspect(
            f'{name} counts the other way round',
            f'sign: {-chain.joints[k].sign} in the chain file, or --columns q{k + 1}=-q{k + 1}',
            chain,
            joints(partial(np.multiply, signs)),
        )
        if not revolute[k]:
            continue
        for degrees, angle in QUARTERS.items():
            zero = np.zeros(count)
            zero[k] = angle
            yield Suspect(
                f'{name} has its zero {degrees[1:]} degrees away',
                f'theta {degrees} degrees in the chain file, or --columns '
                f'q{k + 1}=q{k + 1}{degrees[0]}{abs(angle):.16g}',
                chain,
                joints(partial(np.add, zero)),
            )
    for i in range(count):
        for j in range(i + 1, count):
            order = np.arange(count)
            order[[i, j]] = j, i
            yield Suspect(
                f'{names[i]} and {names[j]} are swapped',
                f'--columns q{i + 1}=q{j + 1},q{j + 1}=q{i + 1}',
                chain,
                joints(partial(_ordered, order)),
                2,
            )
    for k in range(1, count):
        for sign in (1.0, -1.0):
            if not (revolute[k] and revolute[k - 1]):
                continue
            coupled = np.eye(count)
            coupled[k, k - 1] = sign
            what = f'{names[k]} is not given against {names[k - 1]}: they are coupled'
            remedy = f'--columns q{k + 1}=q{k + 1}{"+" if sign > 0.0 else "-"}q{k}'
            change = joints(partial(_mixed, coupled))
            yield Suspect(what, remedy, chain, change, 2)


def _same(one: Chain, other: Chain) -> bool:
    return one.table.shape == other.table.shape and np.allclose(one.table, other.table, atol=1e-6)


def _first_is_w(each: Observations) -> Observations:
    quat = se3.to_quat(each.rotations)
    return replace(each, rotations=se3.from_quat(quat[:, [1, 2, 3, 0]]))


def _last_is_w(each: Observations) -> Observations:
    quat = se3.to_quat(each.rotations)
    return replace(each, rotations=se3.from_quat(quat[:, [3, 0, 1, 2]]))


def _transposed(each: Observations) -> Observations:
    return replace(each, rotations=np.swapaxes(each.rotations, 1, 2))


def _as_it_is(each: Observations) -> Observations:
    return each


def _mirrored(each: Observations) -> Observations:
    """Return what a device with its y axis the other way round should have measured."""
    mirror = np.diag([1.0, -1.0, 1.0])
    return replace(
        each, positions=each.positions @ mirror, rotations=mirror @ each.rotations @ mirror
    )


def _ordered(order: NDArray[np.intp], joints: FloatArray) -> FloatArray:
    return joints[:, order]


def _mixed(matrix: FloatArray, joints: FloatArray) -> FloatArray:
    return joints @ matrix.T


def _all_moved(problem: Problem, sets: Sets, rows: int) -> Sets:
    return tuple(_few(_moved(problem, each, rows)) for each in sets)


def _moved(problem: Problem, each: Observations, rows: int) -> Observations:
    """Return each measurement with the joint values so many rows below, held-out rows included."""
    same = [e for e in problem.judging if (e.base, e.tool) == (each.base, each.tool)]
    parts = [replace(e, covariance=None) for e in (each, *same) if e.distances is None]
    stamps = np.concatenate([e.stamps_ns for e in parts])
    order = np.argsort(stamps, kind='stable')
    joined = {
        name: np.concatenate([getattr(e, name) for e in parts])[order]
        for name in ('joints', 'positions', 'rotations', 'oriented')
    }
    here = slice(max(0, -rows), len(order) - max(0, rows))
    there = slice(max(0, rows), len(order) - max(0, -rows))
    return Observations(
        stamps[order][here],
        joined['joints'][there],
        joined['positions'][here],
        joined['rotations'][here],
        joined['oriented'][here],
        base=each.base,
        tool=each.tool,
        socket=each.socket,
    )
