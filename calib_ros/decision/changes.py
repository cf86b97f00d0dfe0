# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Search for the few parameters of an arm that have changed.

Information about the change x of all parameters is a normal likelihood with matrix A and vector
b = A x^ (A may be singular: some poses determine only some parameters). Expected changes
x ~ N(0, K), such as the uncertainty of an earlier calibration, are marginalised first:

    A' = A - A C A        b' = b - A C b        C = R (1 + R^T A R)^-1 R^T,  K = R R^T

An explanation is x = G z: one parameter, all of a joint, with theta and d of the next or not (a
bent link; in the modified convention of the one before), all of a frame (a moved device or
target), a shift of a frame, or the scale of device or arm changed. It reduces chi-squared, with as
many degrees of freedom as z, by

    (G^T b')^T (G^T A' G)^-1 (G^T b')

A change is claimed if chance gains as much, over all explanations tried, with probability FALSE at
most (Bonferroni). Explanations are compared by their evidence with z ~ N(0, s^2 S), S the typical
size of changes, which penalises additional parameters (MacKay 1992). s is the likeliest of 1,
SPREAD and, for zeros and frames, SPREAD^2: a motor may be a turn off, or a belt a tooth. Each
joint and each frame is as likely as another beforehand, whatever the number of its explanations
(joints have many); load and scale are as likely as one parameter of a joint. Those with a share
above 1 - CONFIDENT are indistinguishable from the best.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from scipy import linalg, special

from calib_ros.estimation.considered import travels
from calib_ros.estimation.gain import inverse_root
from calib_ros.estimation.gauges import best_imitation
from calib_ros.estimation.levels import CERTAIN, CONFIDENT, SCALE, SEVERAL, chance_of
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.sizes import SPREAD
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.effects import expected
from calib_ros.kinematics.parameter import DH_KINDS, FRAME_KINDS, Parameter, parameters_of
from calib_ros.kinematics.se3 import HALF_THE_DIGITS, FloatArray
from calib_ros.settings import LEVER
from calib_ros.shown import Shown, rounded

FALSE_ALARM = 0.5 * (1.0 - CERTAIN)
"""False alarms of an unchanged arm: one side of CERTAIN (benchmarks/recalibration.py)."""
LIKELY = float(special.ndtri(0.5 + 0.5 * CONFIDENT))  # half of a 95 % interval in sigmas
SIZES = {'m': 1e-3, 'rad': 2e-3}
"""Typical size [m, rad] of changes by a collision or a replaced motor; a factor of three either
way costs half a unit of log evidence."""
SCALES = (Parameter('device', 'ratio'), Parameter('arm itself', 'ratio'))
"""Of all measured lengths, those to the arm included, and of the arm alone, which is warmer."""
LOAD = 'load'  # owner of what the arm bends under a load at its end
OUTSIDE = (*(name.owner for name in SCALES), LOAD)  # owners of changes that come and go
ORDER = ('theta', 'd', 'a', 'b', 'alpha', 'beta')
"""Order in which a joint's parameters are named if two have the same effect."""


@dataclass(frozen=True, eq=False, repr=False)
class Explanation(Shown):
    """A possible change, its size, and how well it explains the measurements.

    The k parameters `names` of a joint or frame (`owner`) change by `change` (k,) with standard
    deviations `sigma` (k,) [m, rad], which reduces chi-squared by `gain`. `chance` is the
    probability of such a gain for any explanation if nothing has changed, `share` the share of the
    evidence of all explanations, and `times` the size of such changes in typical ones.
    """

    owner: str
    names: tuple[Parameter, ...]
    gain: float
    chance: float
    share: float
    change: FloatArray
    sigma: FloatArray
    times: float = 1.0

    def in_words(self) -> str:
        """Return the changed parameter and its size, or the changed parameters."""
        if self.owner == LOAD:
            return 'the load of the arm'
        if len(self.names) > 1:
            every = self.owner not in {name.owner for name in self.names}  # of all joints
            parts = groupby(self.names, lambda name: self.owner if every else name.owner)
            kinds = ((each, dict.fromkeys(name.kind for name in own)) for each, own in parts)
            return ' with '.join(f'{each} ({", ".join(own)})' for each, own in kinds)
        what = f'the scale of the {self.owner}' if self.names[0] in SCALES else self.names[0]
        return f'{what} by {self.size_in_words()}'

    def size_in_words(self) -> str:
        """Return the size of the change of a single parameter."""
        return with_limits(self.names[0], *self.change.tolist(), *self.sigma.tolist())


def with_limits(name: Parameter, change: float, sigma: float) -> str:
    """Return a change of a parameter in words, with its 95 % interval."""
    if name in SCALES:
        return f'{1e6 * change:+.0f} ± {1e6 * LIKELY * sigma:.0f} ppm (95 %)'
    factor, unit = name.small_unit
    return f'{rounded(factor * change, "+")} ± {rounded(factor * LIKELY * sigma)} {unit} (95 %)'


def reason_in_words(reasons: Sequence[Explanation]) -> str:
    """Return the best explanation and those indistinguishable from it, without parts of others."""
    sets = [set(each.names) for each in reasons]
    part = [len(own) > 1 and any(own < other for other in sets) for own in sets]
    first, *others = (e.in_words() for e, of in zip(reasons, part, strict=True) if not of)
    text = f'changed: {first}'
    return f'{text}, indistinguishable from {" or ".join(others)}' if others else text


def changes_in_words(changed: Sequence[Sequence[Explanation]]) -> str:
    """Return several changes, each with its indistinguishable explanations."""
    return '; '.join(map(reason_in_words, changed))


def reasons_document(reasons: Sequence[Explanation]) -> list[dict[str, Any]]:
    """Return explanations as plain values."""
    return [
        {
            'owner': each.owner,
            'parameters': [str(name) for name in each.names],
            'change': each.change.tolist(),
            'sigma': each.sigma.tolist(),
            'chance': each.chance,
            'share': each.share,
        }
        for each in reasons
    ]


@dataclass(frozen=True, eq=False, repr=False)
class Information(Shown):
    """Matrix (P, P) and vector (P,) of the information about changes of parameters `names`."""

    names: tuple[Parameter, ...]
    matrix: FloatArray
    vector: FloatArray

    def marginalised(self, square: FloatArray) -> Information:
        """Return the information after marginalising expected changes of covariance (P, P)."""
        mean, covariance = self.mean(root_of(square))
        left = self.matrix - self.matrix @ covariance @ self.matrix
        return Information(self.names, left, self.vector - self.matrix @ mean)

    def mean(self, root: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return posterior mean (P,) and covariance (P, P) with the prior N(0, root root^T)."""
        values, axes = np.linalg.eigh(np.eye(root.shape[1]) + root.T @ self.matrix @ root)
        left = (root @ (axes / np.sqrt(np.maximum(values, 1.0)))).T  # below 1 by rounding, far off
        return left.T @ (left @ self.vector), left.T @ left

    def evidence(self, roots: FloatArray) -> FloatArray:
        """Return the log evidence (S,) of changes with priors N(0, root root^T) of (S, P, k)."""
        turned = np.swapaxes(roots, 1, 2)
        whole = np.eye(roots.shape[2]) + turned @ self.matrix @ roots
        seen = (turned @ self.vector)[:, np.newaxis]
        gains = (seen @ np.linalg.solve(whole, np.swapaxes(seen, 1, 2))).ravel()
        return np.asarray(0.5 * (gains - np.linalg.slogdet(whole)[1]))

    def explained(self, columns: FloatArray) -> tuple[float, FloatArray, FloatArray, int]:
        """Return gain, changes, their covariance and its rank for columns (P, k)."""
        inner = columns.T @ self.matrix @ columns
        root = inverse_root(inner, np.abs(np.diag(inner)))  # rounding may leave less than nothing
        along = root.T @ (columns.T @ self.vector)
        rank = max(1, int(root.any(axis=0).sum()))
        return float(along @ along), root @ along, root @ root.T, rank


def root_of(square: FloatArray) -> FloatArray:
    """Return a root (P, P) of a covariance (P, P), also of one that is singular by rounding."""
    scale = np.sqrt(np.maximum(np.diag(square), 1e-300))
    sizes, directions = linalg.eigh(square / np.outer(scale, scale))
    return np.asarray(scale[:, np.newaxis] * directions * np.sqrt(np.maximum(sizes, 0.0)))


def reasons_of(
    information: Information, columns: ChangeColumns, freedom: float, most: float = FALSE_ALARM
) -> tuple[Explanation, ...]:
    """Return the best explanation of a change, and those indistinguishable from it.

    None if all are by chance with a probability above `most`, or no likelier than no change (if
    `most` is below 1). `freedom` are the degrees of freedom of the noise estimate.
    """
    if not columns.sets:
        return ()
    tried = Counter(owner for owner, _ in columns.sets)
    tried |= Counter(dict.fromkeys(OUTSIDE, max(tried.values())))
    evidences = [columns.evidence(information, names) for _, names in columns.sets]
    likely, times = zip(*evidences, strict=True)
    logs = np.subtract(likely, [np.log(tried[owner]) for owner, _ in columns.sets])
    if most < 1.0 and logs.max() <= 0.0:
        return ()
    found = [
        explanation_of(information, columns, freedom, *each, *rest)
        for each, *rest in zip(columns.sets, special.softmax(logs).tolist(), times, strict=True)
    ]
    # smooth errors of a device look like a warmer arm, which explains but does not claim
    if min(e.chance for e in found if e.names != SCALES[1:]) > most:
        return ()
    found.sort(key=lambda each: -each.share)
    return tuple(each for each in found if each.share > 1.0 - CONFIDENT) or (found[0],)


def explanation_of(
    information: Information,
    columns: ChangeColumns,
    freedom: float,
    owner: str,
    names: tuple[Parameter, ...],
    share: float = 1.0,
    times: float | None = None,
) -> Explanation:
    """Return the explanation by parameters of an owner; `times` typical ones, or the likeliest."""
    gain, change, covariance, rank = information.explained(columns.of(names))
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    chance = min(1.0, len(columns.sets) * chance_of(gain, rank, freedom))
    times = columns.evidence(information, names)[1] if times is None else times
    return Explanation(owner, names, gain, chance, share, change, sigma, times)


class ChangeColumns:
    """Effects of an arm's changes on the P parameters `names` with information.

    Changes of others show in these if they are gauge freedoms beside them, otherwise not at all.
    `frames` may have moved; others are free and absorb what they can. `scaled` allows another
    scale of device and arm, with linear joints only if their travel is among the names.
    """

    def __init__(
        self,
        chain: Chain,
        names: Sequence[Parameter],
        frames: Sequence[str] = (),
        scaled: bool = False,
    ) -> None:
        every = [name for joint in chain.joint_names for name in parameters_of(joint, DH_KINDS)]
        every += (name for frame in frames for name in parameters_of(frame))
        mapped, left = gauge_map(chain, names, every, free=not frames)
        shows = np.abs(mapped).max(axis=0, initial=0.0)
        seen = (shows > HALF_THE_DIGITS) & (left < HALF_THE_DIGITS)
        self._columns = {n: c for n, c, yes in zip(every, mapped.T, seen, strict=True) if yes}
        self._columns |= dict(zip(names, np.eye(len(names)), strict=True))
        self._count, self._roots = len(names), dict[tuple[Parameter, ...], FloatArray]()
        sets: list[tuple[str, tuple[Parameter, ...]]] = []
        other = -1 if chain.convention == 'modified' else 1  # at the far end of the row's link
        for k, joint in enumerate(chain.joint_names):
            own = self._distinct(parameters_of(joint, ORDER))
            sets += [(joint, (name,)) for name in own]
            beside = chain.joint_names[k + other : k + other + 1] if k + other >= 0 else ()
            link = (*own, *(name for each in beside for name in parameters_of(each, ORDER[:2])))
            wholes = dict.fromkeys((own, self._distinct(link)))
            sets += [(joint, some) for some in wholes if len(own) > 1]
        for frame in frames:
            own = tuple(name for name in parameters_of(frame) if name in self._columns)
            shifts = tuple(name for name in own if name.is_length)
            sets += [(frame, some) for some in dict.fromkeys((own, shifts)) if some]
        load = f'gravity_{chain.joint_names[-1]}'
        if carried := tuple(name for name in names if name.kind == load):
            sets.append((LOAD, carried))
        grows = {name: chain.value(name) for name in self._columns if name.is_length}
        grows |= {name: 1.0 for name in travels(chain) if name in names}  # else it hardly shows
        of_arm = {name: size for name, size in grows.items() if not chain.owns_frame(name)}
        if scaled and of_arm:
            there = any(frame.startswith('base') for frame in frames)  # else both look alike
            for scale, lengths in list(zip(SCALES, (grows, of_arm), strict=True))[: 1 + there]:
                grown = [size * self._columns[name] for name, size in lengths.items()]
                self._columns[scale] = np.sum(grown, axis=0)
                sets.append((scale.owner, (scale,)))
        self.sets = tuple(sets)
        self.zeros = tuple(j.driven for j in chain.joints if j.driven in self._columns)

    def _distinct(self, names: Sequence[Parameter]) -> tuple[Parameter, ...]:
        """Return the observable parameters, without those equivalent to an earlier one."""
        units: dict[Parameter, FloatArray] = {}
        for name in names:
            if name in self._columns:
                unit = self._columns[name] / np.linalg.norm(self._columns[name])
                if all(abs(unit @ other) <= 1.0 - HALF_THE_DIGITS for other in units.values()):
                    units[name] = unit
        return tuple(units)

    def unscaled(self) -> ChangeColumns:
        """Return the effects without another scale."""
        found = copy.copy(self)
        found.sets = tuple(each for each in self.sets if each[1][0] not in SCALES)
        return found

    def of(self, names: Sequence[Parameter]) -> FloatArray:
        """Return the columns (P, k) of k parameters."""
        return np.array([self._columns[name] for name in names]).reshape(-1, self._count).T

    def root(self, times: Mapping[Parameter, float]) -> FloatArray:
        """Return a root (P, k) of the covariance of changes so many typical ones large."""
        known = SIZES | {SCALES[0].unit: SCALE}
        sizes = [(known.get(n.unit) or expected(n)) * each for n, each in times.items()]
        return self.of([*times]) * sizes

    def evidence(
        self, information: Information, names: Sequence[Parameter]
    ) -> tuple[float, float]:
        """Return the log evidence of changes of k parameters, and how many typical ones."""
        if (roots := self._roots.get(tuple(names))) is None:
            found = []
            for k in range(SEVERAL):
                few = {n: (n.of_dh or n in SCALES) and n not in self.zeros for n in names}
                times = {n: SPREAD ** (min(k, 1) if few[n] else k) for n in names}
                found.append(self.root(times))
            roots = self._roots[tuple(names)] = np.array(found)
        logs = information.evidence(roots) - 0.5 * np.arange(SEVERAL) ** 2
        best = int(logs.argmax())
        return float(logs[best]), SPREAD**best

    def covariance(self, changed: Sequence[Sequence[Explanation]]) -> FloatArray:
        """Return the prior covariance (P, P) of changes whose sizes the data determine."""
        found = np.zeros((self._count, self._count))
        for each in (each for reasons in changed for each in reasons):
            root = self.root(dict.fromkeys(each.names, max(SPREAD, each.times)))
            found += root @ root.T
        return found


def gauge_map(
    chain: Chain, names: Sequence[Parameter], others: Sequence[Parameter], free: bool
) -> tuple[FloatArray, FloatArray]:
    """Return how changes of other parameters show in the named ones, with `free` frames.

    The first array (P, K) holds the changes of P parameters that best reproduce a unit change of
    each of K others over the joint range, the second (K,) the share that is left.
    """
    rng = np.random.default_rng(0)
    q = chain.random_joints(SOME_POSES, rng)
    frames = [n for end in ('base', 'tool') for n in parameters_of(end)] if free else []
    fitted = list(dict.fromkeys([*frames, *names]))
    approach = rng.choice(np.array([-1.0, 1.0]), q.shape)
    turned = any(n.kind in FRAME_KINDS[3:] and not n.owner.startswith('base') for n in fitted)
    lever = LEVER if turned else 0.0  # positions do not show turns of the target
    taken, wanted, left = best_imitation(chain, fitted, others, q, lever, approach=approach)
    size = np.maximum(np.linalg.norm(wanted, axis=0), 1e-300)
    return taken[[fitted.index(name) for name in names]], np.linalg.norm(left, axis=0) / size


def gauge_columns(
    chain: Chain, names: Sequence[Parameter], others: Sequence[Parameter]
) -> FloatArray:
    """Return the changes (P, K) of P named parameters in which unit changes of others show.

    A target at another height on a SCARA shows as a device at another height.
    """
    own = np.eye(len(names))[:, [name in others for name in names]]
    mapped, left = gauge_map(chain, names, [n for n in others if n not in names], free=False)
    mapped = np.where(np.abs(mapped) > HALF_THE_DIGITS, mapped, 0.0)
    shows = (left < HALF_THE_DIGITS) & mapped.any(axis=0)
    return np.column_stack([own, mapped[:, shows]])


def mean_square_change(chain: Chain, names: Sequence[Parameter]) -> FloatArray:
    """Return V (P, P) [m^2], where d^T V d is the mean squared position change by d.

    Over the joint range, in the best frames.
    """
    joints = chain.random_joints(SOME_POSES, np.random.default_rng(0))
    frames = [*parameters_of('base'), *parameters_of('tool')]
    _, _, left = best_imitation(chain, frames, names, joints, 0.0)
    return np.asarray(left.T @ left) / len(joints)
