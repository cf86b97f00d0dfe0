# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Update an earlier calibration with a few poses: what has changed since, and by how much.

The earlier parameters x have the covariance C, and each of the arm's parameters has drifted since
by a growth g per root of a year (a random walk). The residuals r of the new poses at the earlier
arm determine the change dx by A = J^T W J and b = J^T W r, with the prior dx ~ N(0, C + g^2 t). A
larger change must have a cause that affects few parameters (`changes.py`). These become free (of
both causes if indistinguishable), and the estimate is the mean of dx given A and b, relinearised
until it converges. From there the cause of a large change is searched again. Smooth device errors
(`nuisances.py`), then and now, are no change of the arm.
The result is used if the arm is then known about as well as before, or far better than it changed:
few or similar poses let one cause imitate another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from calib_ros.annotated import NotNegative, as_annotated
from calib_ros.decision import changes, mistakes
from calib_ros.decision.another import is_another
from calib_ros.decision.changes import SCALES, ChangeColumns, Explanation, Information
from calib_ros.decision.comparison import Comparison, compare
from calib_ros.decision.cross_validation import fold_residuals
from calib_ros.decision.moved import name_of
from calib_ros.decision.residuals import residuals
from calib_ros.decision.several import likelier, one_by_one
from calib_ros.errors import InputError
from calib_ros.estimation.configurations import count_distinct
from calib_ros.estimation.gain import about_nominal
from calib_ros.estimation.levels import SCALE, SEVERAL, TRIED, chance_of
from calib_ros.estimation.normal import products_of
from calib_ros.estimation.nuisances import Nuisances, nuisance_products
from calib_ros.estimation.observations import SOME_POSES, Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.start import in_new_frames, reframed
from calib_ros.estimation.system import System
from calib_ros.estimation.visits import frames_of_sets, numbered
from calib_ros.estimation.weights import OUTLIER
from calib_ros.identification.age import drift_of, recorded_time
from calib_ros.identification.calibration import Calibration, about, provenance
from calib_ros.identification.fingerprint import Fingerprint
from calib_ros.identification.orientations import with_known_turns
from calib_ros.identification.recalibrated import Recalibration
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import IN_A_FRAME, Parameter, parameters_of
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, FloatArray, invert, norms
from calib_ros.settings import GROWTH


@as_annotated
def recalibrate(
    previous: Calibration,
    problem: Problem,
    years: NotNegative,
    growth: NotNegative = GROWTH,
    new: Sequence[str] = (),
    stated: Sequence[str] = (),
) -> Recalibration:
    """Update a calibration with the poses of a problem.

    The poses are new, between frames of the calibration; the problem has their noise: that of the
    calibration for default sigmas, unless `stated` names them. Since then `years` have passed.
    `growth` is the standard deviation [m] of the drift of lengths in a year; of angles twice that
    [rad]. `new` are frames of moved devices and of remounted targets. Raises InputError if the
    calibration has no covariance or lacks a frame, or for a mistake.
    """
    previous.require_frames(problem.all_sets)
    judging = problem.held_out and with_known_turns(previous, problem.judging)
    problem = problem.with_sets(with_known_turns(previous, problem.sets), held_out=judging)
    previous = _released(previous, new)
    ours = [name for name in new if name in problem.chain.frame_names]
    problem = replace(problem, chain=reframed(problem.chain, ours, fixed=False))
    if mistake := mistakes.diagnose(problem, far=True):
        raise InputError(f'the new poses do not fit the arm: {mistake}')
    problem = previous.noise.expected_in(problem, stated) if previous.noise else problem
    try:
        found, arm = _recalibrated(previous, problem, years, growth, new)
    except (np.linalg.LinAlgError, FloatingPointError) as error:  # some are kilometres off
        raise InputError('the new poses do not fit the arm at all: check their units') from error
    movable = _movable(arm, problem.all_sets, new) if found.perhaps_moved else []
    again = partial(_recalibrated, previous, problem, years, growth)
    if moved := _moved_far(again, movable, new):
        return moved[1].with_moved(moved[0], previous.chain, found)
    if found.accepted or found.reused:
        return found
    if not found.explained and (mistake := mistakes.diagnose_alone(problem, arm)):
        raise InputError(f'the new poses do not fit the arm: {mistake}')
    if found.out_of_scale:
        return found
    for number, pose, rest in _without_one(problem, arm):
        try:
            others, _ = _recalibrated(previous, rest, years, growth, new)
        except (np.linalg.LinAlgError, FloatingPointError, InputError):  # too few
            continue
        seen = problem.all_sets[number]
        away = residuals(others.calibration.chain, seen).position[pose]
        if others.accepted and 1e3 * np.linalg.norm(away) > OUTLIER * others.after.rms_mm:
            return replace(found, odd=name_of(problem, number, pose))
    step = None if found.explained else previous.step(problem.all_sets, problem.of_messages)
    return replace(found, step=step)


def _moved_far(
    again: Callable[..., tuple[Recalibration, Chain]], movable: Sequence[str], new: Sequence[str]
) -> tuple[Sequence[str], Recalibration] | None:
    """Return the frame that moved, or all of them, best without changed joints, and the result."""
    found: dict[tuple[bool, int], list[tuple[Sequence[str], Recalibration]]] = {}
    for frames in (*((frame,) for frame in movable), *[tuple(movable)] * (len(movable) > 1)):
        if len(frames) > 1 and (False, 1) in found:
            break
        with suppress(InputError, np.linalg.LinAlgError, FloatingPointError):
            others, _ = again((*new, *frames))
            if others.accepted and not others.owners.intersection(movable):
                found.setdefault((bool(others.changed), len(frames)), []).append((frames, others))
    likeliest = found[min(found)] if found else []
    return likeliest[0] if len(likeliest) == 1 else None  # either of two may have moved


def _released(previous: Calibration, new: Sequence[str]) -> Calibration:
    """Return a calibration whose new frames are not fixed where they were."""
    if (region := previous.region) is not None:
        region = replace(region, chain=reframed(region.chain, new, fixed=False))
    chain, before = (reframed(x, new, fixed=False) for x in (previous.chain, previous.before))
    return replace(previous, chain=chain, before=before, region=region)


def _without_one(problem: Problem, chain: Chain) -> Iterator[tuple[int, int, Problem]]:
    """Yield set and pose with the largest errors by a chain, and the problem without it."""
    sets = problem.all_sets
    order = np.argsort(-np.concatenate([norms(residuals(chain, s).position) for s in sets]))
    if not len(order) >= IN_A_FRAME or any(each.pixels is not None for each in sets):
        return
    places = [(number, pose) for number, each in enumerate(sets) for pose in range(len(each))]
    for number, pose in (places[k] for k in order[:TRIED].tolist()):
        rest = list(sets)
        rest[number] = rest[number].select(np.arange(len(rest[number])) != pose)
        kept = [each for each in rest if len(each)]
        left = {each.base for each in kept}
        apart = tuple(pair for pair in problem.separations if {*pair[:2]} <= left)
        yield number, pose, problem.with_sets(kept, held_out=None, separations=apart)


@np.errstate(over='raise', invalid='raise')
def _recalibrated(
    previous: Calibration, problem: Problem, years: float, growth: float, new: Sequence[str]
) -> tuple[Recalibration, Chain]:
    """Return the recalibration, and the earlier arm in new frames."""
    sets = problem.all_sets
    arm, system = _Arm.of(previous, years, growth), System(problem.system(sets).sets)
    # corrected axes are never quite parallel
    nominal = previous.before.with_effects([name for name, _ in arm.chain.effects])
    own = [n for end in new for n in parameters_of(end)]
    anywhere = 10.0 * changes.gauge_columns(nominal, arm.names, own)  # m, rad
    if anywhere.size:
        chain = in_new_frames(problem, arm.chain, new, system)
        arm = replace(arm, chain=chain, square=arm.square + anywhere @ anywhere.T)
    movable = _movable(arm.chain, sets, new)
    columns = ChangeColumns(nominal, arm.names, movable, _may_be_scaled(arm.chain, sets))
    named: list[tuple[Parameter, ...]] = []
    then, earlier = arm, arm.changed(np.zeros(len(arm.names)), arm.square)
    found = arm.solve_change(system)
    for _ in range(SEVERAL):  # after a large change the model is linear elsewhere
        changed = then.changes(found.information, columns)
        arm = then.widened(columns, changed)
        found = arm.solve_change(system)
        told, named = named, [each.names for reasons in changed for each in reasons]
        if told == named:
            break
    expected, _ = found.information.mean(changes.root_of(arm.doubted))
    left = found.squares - float(found.information.vector @ expected)
    left_over = found.information.marginalised(then.doubted)
    updated = _updated(arm, found, problem, changed)
    result = Recalibration(
        updated,
        tuple(changed),
        chance_of(left, system.rows, previous.freedom),
        _judged(arm, anywhere, found, system, sets),
        *_rms_positions(arm, then.square, found),
        previous.reused(sets),
        compare(earlier, updated.chain, sets).figures[1].rms_mm,
        another=is_another(left_over, columns, changed, previous.chain, previous.before),
    )
    record = {**updated.record, 'accepted': result.accepted}
    return replace(result, calibration=replace(updated, record=record)), earlier


def _movable(chain: Chain, sets: Sequence[Observations], new: Sequence[str]) -> list[str]:
    """Return the frames of the sets that are neither new nor fixed."""
    ends = frames_of_sets(sets, base=True, tool=True)
    return [end for end in ends if end not in new and not chain.frame(end).fixed]


def _rms_positions(arm: _Arm, before: FloatArray, found: _Found) -> tuple[float, float, float]:
    """Return the RMS position [m] of uncertainty before and after, and of the change.

    Over the joint range; `before` (P, P) are expected squares of the parameters' errors.
    """
    positions = changes.mean_square_change(arm.chain, arm.names)
    squares = before, found.covariance, np.outer(found.change, found.change)
    first, second, moved = (float(np.sqrt(np.sum(positions * each))) for each in squares)
    return first, second, moved


def _may_be_scaled(chain: Chain, sets: Sequence[Observations]) -> bool:
    """Tell whether one device measured all, with a scale that positions would show."""
    base, *others = {each.base for each in sets}
    alone = not (others or chain.frame(base).fixed)
    return alone and all(
        each.distances is None and each.points is None and not (each.socket or each.inverse)
        for each in sets
    )


@dataclass(frozen=True, eq=False)
class _Found:
    """The change (P,) by new poses, its covariance, and the information about it.

    `squares` are those of the residuals at the earlier arm, to second order.
    """

    change: FloatArray
    covariance: FloatArray
    information: Information
    squares: float


@dataclass(frozen=True, eq=False)
class _Arm:
    """The earlier arm with considered effects, and the covariance (P, P) of its parameters.

    `device` (P, P) is added for a moved or another device; that is no change of the arm. Nor
    are unmodelled waves in other regions than before.
    """

    previous: Calibration
    chain: Chain
    names: tuple[Parameter, ...]
    square: FloatArray
    device: FloatArray

    @classmethod
    def of(cls, previous: Calibration, years: float, growth: float) -> _Arm:
        """Return the arm of a calibration with covariance."""
        if previous.covariance is None:
            raise InputError(
                'the earlier calibration has no parameter covariance: identify it again with this '
                'version, from its own poses'
            )
        chain, names, square = previous.chain, previous.names, previous.covariance
        square = square - previous.unmodelled.for_names(names).square
        device = np.zeros_like(square)
        if (region := previous.region) is not None:
            chain, names = region.chain, region.names
            square, device = region.square, region.device @ region.device.T
        named = tuple(map(Parameter, names))
        wandered = np.diag(drift_of(named, growth)) * years
        return cls(previous, chain, named, square + wandered, device)

    @cached_property
    def root(self) -> FloatArray:
        """Return a root (P, P) of the covariance."""
        return changes.root_of(self.square)

    @property
    def doubted(self) -> FloatArray:
        """Return the covariance (P, P) of arm and device."""
        return self.square + self.device

    def widened(self, columns: ChangeColumns, changed: Sequence[Sequence[Explanation]]) -> _Arm:
        """Return the arm with changes of unknown size."""
        return replace(self, square=self.square + columns.covariance(changed))

    def changes(
        self, information: Information, columns: ChangeColumns
    ) -> list[tuple[Explanation, ...]]:
        """Return what has changed, each with its likely explanations."""
        found = one_by_one(lambda some: self.widened(columns, some).reasons(information, columns))
        left_over = information.marginalised(self.doubted)
        return likelier(left_over, columns, self.previous.freedom, found)

    def reasons(self, information: Information, columns: ChangeColumns) -> tuple[Explanation, ...]:
        """Return what has changed; of possible device errors only another scale."""
        freedom = self.previous.freedom
        found = changes.reasons_of(information.marginalised(self.square), columns, freedom)
        if not (found and found[0].names == SCALES[:1]):
            left_over = information.marginalised(self.doubted)
            found = changes.reasons_of(left_over, columns, freedom)
        if found and found[0].names[0] in SCALES and abs(found[0].change[0]) < SCALE:
            return self.reasons(information, columns.unscaled())  # as much is usual
        return found

    @property
    def own(self) -> list[int]:
        """Return the indices of the calibration's parameters, fitted or held nominal."""
        return [k for k, n in enumerate(self.names) if n.of_dh or n in self.previous.names]

    def applied(self, change: FloatArray, covariance: FloatArray) -> FloatArray:
        """Return the change (P,) by poses if the considered effects are zero, as in the chain.

        Without them other parameters follow: those of an arm that has the effects do not fit.
        """
        rest = np.setdiff1d(np.arange(len(change)), self.own)
        effects = covariance[np.ix_(rest, rest)]
        return np.asarray(change - covariance[:, rest] @ np.linalg.pinv(effects) @ change[rest])

    def changed(self, change: FloatArray, covariance: FloatArray) -> Chain:
        """Return the chain with the `applied` changes (P,)."""
        applied = self.applied(change, covariance)
        own: dict[str, float] = {self.names[k]: float(applied[k]) for k in self.own}
        return replace(self.chain, effects=self.previous.chain.effects).with_offsets(own)

    def solve_change(self, system: System) -> _Found:
        """Return the mean change given the new poses, relinearised until it converges.

        The prior is a whole covariance, while `leastsquares` takes single sigmas.
        """
        change = np.zeros(len(self.names))
        nuisances = Nuisances(by_device=True, unmodelled=self.previous.unmodelled)
        for _ in range(4 * SEVERAL):  # changes of millimetres converge in two
            chain = self.chain.with_offsets(dict(zip(self.names, change, strict=True)))
            found = nuisance_products(chain, self.names, system, nuisances, most=system.count)
            if not all(np.isfinite(part).all() for part in found):
                raise np.linalg.LinAlgError('the new poses are too far off')
            products = found.reduced
            information = Information(self.names, *about_nominal(products[:-1], change))
            squares = float(products[-1, -1] + change @ (products[:-1, -1] + information.vector))
            last, (change, covariance) = change, information.mean(self.root)
            if np.abs(change - last).max() < HALF_THE_DIGITS:
                break
        return _Found(change, covariance, information, squares)


def _judged(
    arm: _Arm, frames: FloatArray, found: _Found, system: System, sets: Sequence[Observations]
) -> Comparison:
    """Return the errors of the new poses by the earlier arm, and predicted from the others.

    `frames` (P, K) is a root of the covariance of new frames alone, which the others tell too.
    """
    groups = numbered(sets)
    count = min(SOME_POSES, count_distinct(np.concatenate(groups)))
    folds = [numbers % count for numbers in groups]
    chain = arm.chain.with_offsets(dict(zip(arm.names, found.change, strict=True)))
    chains = []
    parts = products_of(chain, arm.names, system, folds).sum(axis=1)
    for products in parts.sum(axis=0) - parts:
        rest = Information(arm.names, *about_nominal(products[:-1], found.change))
        chains.append((arm.changed(*rest.mean(frames)), arm.changed(*rest.mean(arm.root))))
    before, after = fold_residuals(chains, sets, groups, folds)
    return Comparison(before, after, np.ones(len(before.position), dtype=bool))


def _updated(
    arm: _Arm, found: _Found, problem: Problem, changed: Sequence[Sequence[Explanation]]
) -> Calibration:
    previous, chain = arm.previous, arm.changed(found.change, found.covariance)
    own, region, before = arm.own, previous.region, previous.before
    for name in before.frame_names:
        old, new, current = (each.frame(name) for each in (previous.chain, chain, before))
        moved = new.matrix @ invert(old.matrix) @ current.matrix
        if name.startswith('tool'):
            moved = current.matrix @ invert(old.matrix) @ new.matrix
        before = before.with_frame(name, replace(current, matrix=moved))
    left = found.change - arm.applied(found.change, found.covariance)
    square = found.covariance + np.outer(left, left)
    names = tuple(arm.names[k] for k in own)
    unmodelled = previous.unmodelled.for_names(names)
    if region is not None:
        effects = [name for name, _ in region.chain.effects]
        region = replace(region, chain=chain.with_effects(effects), square=square)
    record = {
        **previous.record,
        **provenance(),
        **about(chain, before, region),
        'previous': {key: previous.record.get(key) for key in ('created', 'table_sha256')},
        'measured': recorded_time(problem.all_sets),
        'new_samples': sum(map(len, problem.all_sets)),
        'outdated': sorted({*previous.outdated} - {*frames_of_sets(problem.all_sets, True, True)}),
        'changed': [changes.reason_in_words(each) for each in changed],
    }
    return replace(
        previous,
        chain=chain,
        before=before,
        names=names,
        covariance=square[np.ix_(own, own)] + unmodelled.square,
        unmodelled=unmodelled,
        region=region,
        record=record,
        rows=Fingerprint.of(problem.all_sets, previous.rows),
    )
