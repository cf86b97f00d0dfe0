# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The estimate during sampling: what is known so far, and how many more samples are needed.

It is the robust fit (`robust.py`) to the samples so far, or to some of them if they are many. Wide
priors stand for what no sample has determined yet. A fit takes 0.02 s, 0.3 s with thirty
targets.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from calib_ros.errors import CalibrationError
from calib_ros.estimation.configurations import configurations, count_distinct
from calib_ros.estimation.fitting import SOME
from calib_ros.estimation.gross_errors import chance_of_outliers, thorough_fit
from calib_ros.estimation.identifiability import structurally_independent
from calib_ros.estimation.leastsquares import STEP_TOLERANCE
from calib_ros.estimation.levels import SURE
from calib_ros.estimation.normal import normal_equations
from calib_ros.estimation.observations import SOME_POSES, Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.robust import robust_fit
from calib_ros.estimation.samples import residual_arrays
from calib_ros.estimation.sizes import solved
from calib_ros.estimation.start import start_frames
from calib_ros.estimation.system import Prior
from calib_ros.estimation.weights import OUTER
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import DELAY, DH_ANGLES, IN_A_FRAME, Parameter
from calib_ros.kinematics.se3 import Flags, FloatArray, norms
from calib_ros.sampling.sample import Frames, Sample
from calib_ros.sampling.sets import collect
from calib_ros.settings import Settings

WIDE = (Settings.largest_length / 5.0, Settings.largest_angle / 5.0)
"""Prior standard deviations [m, rad] of arm parameters: five times as much is another robot."""
START = IN_A_FRAME
"""Configurations needed to find two frames: three coordinates each for two unknowns."""
LITTLE = 0.35
"""Range [rad] of a joint over all samples that is too little: 20 degrees (or 0.035 m). A
convention."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """The estimate from the samples so far.

    `excess` is the ratio of position residuals to the scatter of measurements: the given sigma, or
    the spread at a stop if larger. None with too few samples, whose sigma is mostly that of
    priors.
    """

    chain: Chain
    names: tuple[str, ...]
    covariance: FloatArray  # (P, P)
    samples: int
    sigma: float  # RMS standard deviation [m] of positions over the joint range
    noise: float  # of the residuals, used for sigma [sigma given]
    misfit: float  # the same noise, of positions [m]: beyond the arm's own if its parameters are
    rms: float  # of position residuals [m]
    excess: float | None

    def enough(self, wanted: float) -> bool:
        """Tell whether a wanted sigma [m] is reached, and not by the priors."""
        return self.excess is not None and self.sigma <= wanted

    def astray(self, largest_error: float) -> bool:
        """Tell whether positions, or the arm that explains them, are further off than any [m]."""
        left = self.rms if self.excess else 0.0
        return max(left, min(self.misfit, self.sigma)) > largest_error

    def more_for(self, wanted: float) -> int:
        """Return how many more samples are expected for a wanted sigma [m]."""
        return max(0, int(np.ceil(self.samples * ((self.sigma / wanted) ** 2 - 1.0))))


class Update(NamedTuple):
    """What an update has found."""

    estimate: Estimate | None = None  # None with too few samples
    refused: str = ''  # why the samples make no valid problem; empty if they do
    suspicious: tuple[Sample, ...] = ()  # too far from the prediction of the others, ignored


class LiveEstimate:
    """The estimate from a growing list of samples.

    One thread may update it while others read what is `known`.
    """

    def __init__(self, problem_of: Callable[[Sequence[Sample]], Problem]) -> None:
        self._problem_of = problem_of
        self._seen: list[Sample] = []
        self.known = Update()  # by the last update

    def update(self, samples: Sequence[Sample]) -> Estimate | None:
        """Return the estimate from these samples, or None while there are too few."""
        if self._seen != list(samples):
            self.known = self._updated([each for each in samples if not each.validation])
            self._seen = list(samples)
        return self.known.estimate

    def _updated(self, samples: Sequence[Sample]) -> Update:
        some = _spread(samples)
        if count_distinct(configurations(np.array([each.joints for each in some]))) < START:
            return Update()
        try:
            problem = self._problem_of(some)
        except CalibrationError as err:
            return Update(refused=str(err))
        try:
            return _fitted(problem, some, len(samples))
        except (CalibrationError, np.linalg.LinAlgError):
            return Update()


def _fitted(problem: Problem, samples: Sequence[Sample], count: int) -> Update:
    """Return what some samples, which make the problem, tell of all `count` samples."""
    names = structurally_independent(problem.model, problem.free, problem.sets)
    system = replace(problem.system(problem.sets), prior=_priors(problem, names))
    spare = system.rows - len(names)  # the wide priors restrict nothing
    loss = 'redescending' if spare > len(names) else 'none'
    robust = thorough_fit(start_frames(problem), names, system, loss)
    if chance_of_outliers(robust, robust.fit.chain, names, system, spare) > 1.0 - SURE:
        robust = robust_fit(robust.fit.chain, names, system, 'none')
    chain, sigmas = robust.fit.chain, (problem.sigma_position, problem.sigma_orientation)
    good = [
        near | _not_gross(residual_arrays(chain, each), sigmas)
        for near, each in zip(robust.inliers, problem.sets, strict=True)
    ]
    kept = system.select(good)
    normal = normal_equations(chain, names, kept)
    _, root = solved(normal.matrix, normal.gradient, np.zeros(len(names)))
    freedom = kept.rows - len(names)
    noise = max(normal.cost / freedom, STEP_TOLERANCE**2) if freedom > 0 else 1.0
    share = len(samples) / count
    covariance = noise * share * root @ root.T
    joints = chain.random_joints(SOME_POSES, np.random.default_rng(0))
    jacobian = ErrorModel(chain, names).jacobian(joints)[:, :3]
    variance = ((jacobian @ covariance) * jacobian).sum(axis=(1, 2))
    members = [np.array(some) for some, _ in collect(samples, sigmas, Frames(), posed=True)]
    out = [some[~near] for some, near in zip(members, good, strict=True)]
    gross = np.sort(np.concatenate(out)).tolist()
    spreads = np.array([each.spread for each in samples])
    rms, ratio, given = _rms_residuals(
        chain, problem.sets, [spreads[some] for some in members], good, sigmas[0]
    )
    estimate = Estimate(
        chain=chain,
        names=names,
        covariance=covariance,
        samples=round(kept.count / share),
        sigma=float(np.sqrt(variance.mean())),
        noise=float(np.sqrt(noise)),
        misfit=float(np.sqrt(noise)) * given,
        rms=rms,
        excess=ratio if spare > len(names) else None,
    )
    return Update(estimate, suspicious=tuple(samples[k] for k in gross))


def _priors(problem: Problem, names: Sequence[str]) -> Prior:
    wide: dict[str, float] = {
        name: 1.0 if name.kind == DELAY else WIDE[name.kind in DH_ANGLES]
        for name in map(Parameter, names)
        if not problem.model.owns_frame(name)
    }
    return Prior(problem.model, {**wide, **problem.prior_sigmas})


def _not_gross(left: Sequence[FloatArray], sigmas: tuple[float, float]) -> Flags:
    """Return which residuals (N, 3) of position and orientation no sigma makes gross."""
    (position, turn), (length, angle) = left, sigmas  # a turn that is not measured is NaN
    return (norms(position) <= OUTER * length) & ~(norms(turn) > OUTER * angle)


def _rms_residuals(
    chain: Chain,
    sets: Sequence[Observations],
    spreads: Sequence[FloatArray],
    good: Sequence[Flags],
    sigma: float,
) -> tuple[float, float, float]:
    """Return the RMS position residual [m], in units of the scatter, and the sigma given [m]."""
    squares, ratios, given = [], [], []
    for each, spread, near in zip(sets, spreads, good, strict=True):
        left = residual_arrays(chain, each)[0]
        scatter = np.trace(each.covariances((sigma, 1.0))[:, :3, :3], axis1=1, axis2=2) / 3.0
        given.append(scatter[near])
        squares.append((left**2).sum(axis=1)[near])
        ratios.append(((left**2).mean(axis=1) / np.maximum(scatter, spread**2))[near])
    first, second, third = (np.concatenate(each).mean() for each in (squares, ratios, given))
    return math.sqrt(first), math.sqrt(second), math.sqrt(third)


def barely_moved(chain: Chain, joints: FloatArray) -> tuple[str, ...]:
    """Return the movable joints whose values (N, n) span too little to determine them."""
    least = [LITTLE if joint.type == 'revolute' else 0.1 * LITTLE for joint in chain.joints]
    little = np.flatnonzero(np.ptp(joints, axis=0) < least).tolist()
    return tuple(chain.joint_names[k] for k in little if k not in chain.held)


def _spread(samples: Sequence[Sample]) -> list[Sample]:
    """Return about SOME samples, evenly from those between each pair of frames."""
    frames = Frames()
    groups: dict[tuple[str, str], list[int]] = {}
    for k, sample in enumerate(samples):
        groups.setdefault(frames.of(sample), []).append(k)
    chosen: set[int] = set()
    for members in groups.values():
        count = min(len(members), 1 + SOME // len(groups))
        chosen |= {members[k] for k in np.linspace(0, len(members) - 1, count).astype(int)}
    return [samples[k] for k in sorted(chosen)]
