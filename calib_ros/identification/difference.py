# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The difference between two calibrations of one robot, tested with both covariances.

Frames are free: device and target may have been moved. The second arm is expressed in the
parameters of the first by a fit to its poses over the joint range, which removes gauge freedoms.
The parameter difference d is tested by d^T C^-1 d with C = C_1 + C_2; then the changed parameters
are searched for (`several.py`). The difference of predicted positions, in the best frames, is a
quadratic form of d; its limit is the quantile for d ~ N(d, C).

Wobble that the models lack is the same in both, so C has the covariance of the difference of its
effects on the parameters (`unmodelled.py`): nothing for the same poses. The usual drift (`age.py`)
is no change either. Smooth errors of a moved device (`distortion.py`) give differences at other
poses; a difference that is significant only without them is reported as such.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from calib_ros.annotated import as_annotated
from calib_ros.decision import changes
from calib_ros.decision.another import is_another
from calib_ros.decision.changes import ChangeColumns, Explanation, Information
from calib_ros.decision.several import likelier, names_of, one_by_one, question
from calib_ros.errors import InputError
from calib_ros.estimation.gain import inverse_root
from calib_ros.estimation.identifiability import structurally_independent
from calib_ros.estimation.levels import CONFIDENT, SCALE, chance_of
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.posterior import size_group
from calib_ros.estimation.sizes import TYPICAL
from calib_ros.estimation.start import fit_to_arm
from calib_ros.identification.age import drift_of, years_between
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.parameter import Parameter, parameters_of
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, FloatArray
from calib_ros.shown import Shown, as_html, rounded


@dataclass(frozen=True, eq=False, repr=False)
class Difference(Shown):
    """The second of two calibrations minus the first.

    P parameters `names` differ by `change` (P,) with standard deviations `sigma` (P,) [m, rad].
    `chance` is the probability of such a difference by the noise of both, `beyond` by device
    errors and unmodelled effects too. Predicted positions differ by `rms` [m] over the joint range
    in the best frames, by `limit` [m] at most (95 %); the first model cannot follow `left` [m] of
    it. `changed` lists the changes, each with those indistinguishable from it; `unexplained` is
    the probability of the remaining difference, 0 if another robot is likelier.
    """

    names: tuple[Parameter, ...]
    change: FloatArray
    sigma: FloatArray
    chance: float
    beyond: float
    rms: float
    limit: float
    left: float
    changed: tuple[tuple[Explanation, ...], ...]
    unexplained: float

    @property
    def same(self) -> bool:
        """Tell whether no change was detected."""
        return self.chance > changes.FALSE_ALARM and not self.changed

    def in_words(self) -> str:
        """Return the difference in words."""
        if self.same:
            return f'unchanged within {rounded(1e3 * self.limit)} mm'
        rms, limit = 1e3 * self.rms, 1e3 * self.limit
        size = f'{rounded(rms)} mm RMS over the joint range (at most {rounded(limit)} mm)'
        known = bool(self.changed) and self.unexplained > changes.FALSE_ALARM
        warmer = known and all(
            reason.names[0] in changes.SCALES and abs(reason.change[0]) > SCALE  # less is usual
            for reason, *_ in self.changed
        )
        if self.beyond > changes.FALSE_ALARM and not warmer:
            return (
                f'different by {size}: not noise, but perhaps warmth, smooth device errors or '
                'what the models lack; to find out, measure the same poses from the same place'
            )
        if known:
            reasons = changes.changes_in_words(self.changed)
            why = 'is the arm warmer, or the device another?' if warmer else question(self.changed)
            return f'{reasons}; nothing else: {why} Predictions differ by {size}'
        return f'many parameters differ, by {size}: are both of one robot? Identify again'

    def _repr_html_(self) -> str:
        return as_html(self.in_words(), (), (('parameter', 'change'), *self.rows()))

    def document(self) -> dict[str, Any]:
        """Return the difference as plain values; distances in mm."""
        rows = zip(self.names, self.change.tolist(), self.sigma.tolist(), strict=True)
        return {
            'same': self.same,
            'words': self.in_words(),
            'rms_mm': 1e3 * self.rms,
            'limit_mm': 1e3 * self.limit,
            'left_mm': 1e3 * self.left,
            'chance': self.chance,
            'chance_beyond_models': self.beyond,
            'changed': [changes.reasons_document(each) for each in self.changed],
            'unexplained': self.unexplained,
            'parameters': {str(n): {'change': x, 'sigma': s} for n, x, s in rows},
        }

    def rows(self) -> tuple[tuple[str, str], ...]:
        """Return the six parameters with the largest change in sigmas, and their changes."""
        order = np.argsort(-np.abs(self.change) / self.sigma)[:6].tolist()
        names = [self.names[k] for k in order]
        sizes = [changes.with_limits(self.names[k], self.change[k], self.sigma[k]) for k in order]
        return tuple(zip(names, sizes, strict=True))


def _rows_in_words(chain: Chain) -> str:
    rows = (f'{j.name} ({j.type}{", turned" * (j.sign < 0)})' for j in chain.joints)
    return f'{", ".join(rows)} ({chain.convention})'


@as_annotated
def difference(first: Calibration, second: Calibration) -> Difference:
    """Compare two calibrations of one robot.

    Raises InputError if they have different joints, or no covariance.
    """
    arms = first.chain, second.chain
    ours, theirs = map(_rows_in_words, arms)
    if ours != theirs:
        raise InputError(f'the joints {ours} and {theirs} belong to different robots')
    names, chain, change, left = _in_parameters_of(first, second)
    if not names:
        raise InputError('neither calibration fitted a parameter of the arm')
    square, lacking = _squares((first, second), names)
    freedom = min(first.freedom, second.freedom)
    columns = ChangeColumns(chain, names, scaled=True)
    every = _information(names, change, square)
    chance = _chance(every, freedom)
    beyond = _chance(_information(names, change, lacking), freedom)

    def reasons_beside(found: Sequence[tuple[Explanation, ...]]) -> tuple[Explanation, ...]:
        left_over = every.marginalised(columns.covariance(found))
        return changes.reasons_of(left_over, columns, freedom)

    changed = likelier(every, columns, freedom, one_by_one(reasons_beside))
    left_over = every.marginalised(columns.covariance(changed))
    another = is_another(every, columns, changed, first.chain, first.before)
    predicted = changes.mean_square_change(chain, names)
    rng = np.random.default_rng(0)
    draws = rng.multivariate_normal(change, square, 10 * SOME_POSES, method='eigh')
    squares = np.einsum('np,pq,nq->n', draws, predicted, draws, optimize=True)
    return Difference(
        names,
        change,
        np.sqrt(np.diag(square)),
        chance,
        beyond,
        float(np.sqrt(change @ predicted @ change)),
        float(np.sqrt(np.quantile(squares, CONFIDENT))),
        left,
        tuple(changed),
        0.0 if another else _chance(left_over, freedom, len(names_of(changed))),
    )


def _squares(
    pair: Sequence[Calibration], names: tuple[Parameter, ...]
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (P, P) of differences, without and with smooth device errors."""
    square, lacking = np.zeros((2, len(names), len(names)))
    size, apart = 0.0, np.zeros((len(names), 1))
    for number, each in enumerate(pair, 1):
        if each.covariance is None:
            raise InputError(
                f'calibration {number} has no parameter covariance: identify it again with this '
                'version'
            )
        waves = each.unmodelled.for_names(each.names)
        alone, size = each.covariance - waves.square, max(size, waves.waves)
        apart = _change(each.chain, names, each.names) @ waves.followed - apart
        own = whole = _in_names(each.chain, names, each.names, alone)
        region = each.region
        if region is not None:
            arm, device = region.square, region.device @ region.device.T
            if any(Parameter(n).of_dh and n not in each.names for n in region.names):
                own = _in_names(region.chain, names, region.names, arm)
            whole = own + _in_names(region.chain, names, region.names, device)
        square += own
        lacking += whole
    years = years_between(*(each.record for each in pair))
    more = size**2 * apart @ apart.T + years * np.diag(drift_of(names))
    return square + more, lacking + more


def _in_parameters_of(
    first: Calibration, second: Calibration
) -> tuple[tuple[Parameter, ...], Chain, FloatArray, float]:
    """Express the second arm in the parameters of the first.

    Returns these parameters, the first chain with all of them, their differences (P,), and the RMS
    distance [m] left.
    """
    effects = [name for each in (first, second) for name, _ in each.chain.effects]
    chain = first.chain.with_effects(effects)
    other = second.chain
    frames = [name for end in ('base', 'tool') for name in parameters_of(end)]
    every = dict.fromkeys((*first.names, *second.names, *effects))
    arm = [Parameter(n) for n in every if not (chain.owns_frame(n) or other.owns_frame(n))]
    nominal = first.before.with_effects(effects)  # corrected axes are never quite parallel
    independent = structurally_independent(nominal, [*frames, *arm])
    names = tuple(Parameter(name) for name in independent if name in arm)
    joints = chain.random_joints(SOME_POSES, np.random.default_rng(0))
    start = replace(chain, base=other.base, tool=other.tool)
    fitted, left = fit_to_arm(start, independent, other, joints)
    return names, chain, np.array([fitted.offset(name, chain) for name in names]), left


def _in_names(
    chain: Chain, names: Sequence[Parameter], own: Sequence[str], square: FloatArray
) -> FloatArray:
    """Return the covariance of the names; parameters that were not fitted have typical sizes."""
    change = _change(chain, names, own)
    whole = change @ square @ change.T
    unknown = np.abs(change).max(axis=1) < HALF_THE_DIGITS
    sizes = [TYPICAL[size_group(chain, name) or 'length'] for name in names]
    return np.asarray(whole + np.diag(unknown * np.square(sizes)))


def _change(chain: Chain, names: Sequence[Parameter], own: Sequence[str]) -> FloatArray:
    """Return how the names (P,) change with a unit of each of a calibration's own (P, K)."""
    chain = chain.with_effects([n for n in names if not (n.of_dh or chain.owns_frame(n))])
    parameters = [Parameter(name) for name in own]
    change = np.array([[float(name == other) for other in parameters] for name in names])
    others = [k for k, name in enumerate(parameters) if name.of_dh and name not in names]
    if others:
        change[:, others] = changes.gauge_map(
            chain, names, [parameters[k] for k in others], free=True
        )[0]
    return change


def _information(
    names: tuple[Parameter, ...], change: FloatArray, square: FloatArray
) -> Information:
    root = inverse_root(square, np.diag(square))
    inverse = root @ root.T
    return Information(names, inverse, inverse @ change)


def _chance(information: Information, freedom: float, explained: int = 0) -> float:
    rank = len(information.names) - explained
    return chance_of(information.explained(np.eye(len(information.names)))[0], rank, freedom)
