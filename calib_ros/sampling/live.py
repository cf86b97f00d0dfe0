# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The estimate during sampling: what is known so far, and how many more samples are needed.

An information filter (Maybeck 1979; docs/model.md, Samples and time): each sample adds J^T W J and
J^T W r, so estimate and covariance follow each sample at the cost of that sample alone. The point
of linearisation moves to the estimate when that leaves the range of the linear model. Wide priors
stand for what no sample has determined yet.

A sample far from the prediction of the others is left out as suspicious. The first ones cannot be
judged so, because the estimate follows them. So each time the number of samples has grown by a
quarter it restarts with the robust fit (`robust.py`): an early gross error is found, and samples
wrongly left out return. A sample costs 0.02 s on average, restarts included; the robust fit alone,
after each one, takes 0.2 s with 100 samples and 4 s with thirty targets.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from calib_ros.errors import CalibrationError
from calib_ros.estimation.configurations import configurations, distinct
from calib_ros.estimation.fitting import SOME
from calib_ros.estimation.identifiability import structurally_independent
from calib_ros.estimation.leastsquares import (
    SMALL_STEP,
    STEP_TOLERANCE,
    Prior,
    System,
    products_of,
)
from calib_ros.estimation.observations import SOME_POSES, Observations
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.robust import OUTER, robust_fit, thorough_fit
from calib_ros.estimation.samples import Samples, residual_arrays
from calib_ros.estimation.sizes import solved
from calib_ros.estimation.start import start_frames
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import DELAY, DH_ANGLES, IN_A_FRAME, Parameter
from calib_ros.kinematics.se3 import ROUNDS, FloatArray
from calib_ros.sampling.dataset import collect
from calib_ros.sampling.sample import Frames, Sample
from calib_ros.settings import EXCEPTION, Settings

WIDE = (Settings.largest_length / 5.0, Settings.largest_angle / 5.0)
"""Prior standard deviations [m, rad] of arm parameters: five times as much is another robot."""
START = IN_A_FRAME
"""Configurations needed to find two frames: three coordinates each for two unknowns."""
MOST_THOROUGH = 60
"""Largest number of parameters for the thorough fit, which takes 4 s instead of 1 s for 200."""
GROWN = (1.0 - EXCEPTION) ** -2
"""Growth of the number of samples at which all are judged again: it shrinks standard deviations by
EXCEPTION."""
MOST_AT_ONCE = 4 * SOME  # samples per update at most
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
    rms: float  # of position residuals [m]
    excess: float | None

    def enough(self, wanted: float) -> bool:
        """Tell whether a wanted sigma [m] is reached, and not by the priors."""
        return self.excess is not None and self.sigma <= wanted

    def astray(self, largest_error: float) -> bool:
        """Tell whether position residuals are further off than any arm [m]."""
        return bool(self.excess) and self.rms > largest_error

    def more_for(self, wanted: float) -> int:
        """Return how many more samples are expected for a wanted sigma [m]."""
        return max(0, int(np.ceil(self.samples * ((self.sigma / wanted) ** 2 - 1.0))))


class Update(NamedTuple):
    """What an update has found."""

    estimate: Estimate | None = None  # None with too few samples
    refused: str = ''  # why the samples make no valid problem; empty if they do
    suspicious: tuple[Sample, ...] = ()  # too far from the prediction of the others, ignored


class LiveEstimate:
    """Information filter over the parameters of a growing problem.

    One thread may update it while others read what is `known`.
    """

    def __init__(self, problem_of: Callable[[Sequence[Sample]], Problem]) -> None:
        self._problem_of = problem_of
        self.known = Update()  # by the last update
        self.restart()

    def restart(self) -> None:
        """Start again with the next update."""
        self._frames = Frames()
        self._names: tuple[str, ...] = ()
        self._chain: Chain | None = None
        self._added: list[Sample] = []
        self._begun = 0  # samples at the start
        self._seen: list[Sample] = []
        self._pending: list[Sample] = []
        self.suspicious: list[Sample] = []

    def update(self, samples: Sequence[Sample]) -> Estimate | None:
        """Add the samples that are new since the last call, or restart with another list.

        Returns None while there are too few. An update takes at most MOST_AT_ONCE samples.
        """
        self.known = self._updated(samples)
        return self.known.estimate

    def _updated(self, samples: Sequence[Sample]) -> Update:
        known = len(self._seen)
        if self._seen != list(samples[:known]):
            self.restart()
        elif self._chain is not None and len(samples) == known and not self._pending:
            return self.known
        self._pending += [each for each in samples[len(self._seen) :] if not each.validation]
        self._seen = list(samples)
        fresh = self._pending[:MOST_AT_ONCE]
        count = len(self._added) + len(self.suspicious) + len(fresh)
        outgrown = self._chain is None or GROWN * self._begun < count <= SOME
        framed = set(self._chain.frame_names) if self._chain else set()
        if outgrown or any(not framed.issuperset(self._frames.of(each)) for each in fresh):
            fitted = [sample for sample in samples if not sample.validation]
            first = _spread(fitted)
            joints = np.array([sample.joints for sample in first])
            if distinct(configurations(joints)) < START:
                return Update()
            if failed := self._begin(first):
                return failed
            chosen = set(first)
            self._begun = len(fitted)
            self._seen = list(samples)
            self._pending = [sample for sample in fitted if sample not in chosen]
        elif fresh:
            del self._pending[: len(fresh)]
            self._add(fresh)
            self._settle()
        return Update(self._result(), suspicious=tuple(self.suspicious))

    def _begin(self, fitted: Sequence[Sample]) -> Update | None:
        """Choose the parameters, fit robustly, and add rejected samples within the sigmas.

        Returns an update if that is not possible.
        """
        self.restart()
        try:
            problem = self._problem_of(fitted)
        except CalibrationError as err:
            return Update(refused=str(err))
        model = problem.model
        self._sigmas = (problem.sigma_position, problem.sigma_orientation)
        try:
            self._names = structurally_independent(model, problem.free, problem.kinds)
            chain = start_frames(problem)
        except (CalibrationError, np.linalg.LinAlgError):
            return Update()
        wide: dict[str, float] = {
            name: 1.0 if name.kind == DELAY else WIDE[name.kind in DH_ANGLES]
            for name in map(Parameter, self._names)
            if not model.owns_frame(name)
        }
        self._prior = Prior(model, {**wide, **problem.prior_sigmas})
        self._joints = chain.random_joints(SOME_POSES, np.random.default_rng(0))
        groups = self._groups(fitted)
        system = self._system(groups, self._prior)
        loss = 'redescending' if self._enough(system.rows) else 'none'
        fit = thorough_fit if len(self._names) <= MOST_THOROUGH else robust_fit
        robust = fit(chain, self._names, system, loss)
        members = [sample for group, _ in groups for sample in group]
        judged = list(zip(members, robust.outliers.tolist(), strict=True))
        self._added = [sample for sample, gross in judged if not gross]
        self._linearise(robust.fit.chain)
        self._add([sample for sample, gross in judged if gross])
        self._settle()
        return None

    def _settle(self) -> None:
        for _ in range(ROUNDS):
            chain, step, *_ = self._estimate()
            if np.abs(step).max() < SMALL_STEP or len(self._added) > SOME:
                break
            self._linearise(chain)

    def _linearise(self, chain: Chain) -> None:
        inverse, residual = self._prior.rows(chain, self._names)
        rows = np.column_stack([np.diag(inverse), residual])
        self._chain, self._products, self._rows = chain, rows.T @ rows, 0
        added, self._added = self._added, []
        self._add(added)

    def _add(self, samples: Sequence[Sample]) -> None:
        assert self._chain is not None
        if self._enough(self._rows):
            samples = self._plausible(samples)
        system = self._system(self._groups(samples))
        self._products = self._products + products_of(self._chain, self._names, system)[0].sum(0)
        self._rows += system.rows
        self._added += samples

    def _enough(self, rows: int) -> bool:
        return rows > 2 * len(self._names)

    def _groups(self, samples: Sequence[Sample]) -> list[tuple[list[Sample], Observations]]:
        found = collect(samples, self._sigmas, self._frames, posed=True)
        return [([samples[k] for k in members], each) for members, each in found]

    def _system(
        self, groups: Sequence[tuple[list[Sample], Observations]], prior: Prior | None = None
    ) -> System:
        return System(tuple(Samples(each, *self._sigmas) for _, each in groups), prior)

    def _plausible(self, samples: Sequence[Sample]) -> list[Sample]:
        chain, _, covariance, noise = self._estimate()
        # samples of one place may agree better than the model holds elsewhere
        covariance, noise = covariance * max(1.0 / noise, 1.0), max(noise, 1.0)
        good: list[Sample] = []
        for members, some in self._groups(samples):
            placed = Samples(replace(some, covariance=None), *self._sigmas)
            width = 3 if some.distances is None else 1
            *rows, left = placed.rows_of(chain, self._names)[:, :width].transpose(0, 2, 1)
            jacobian = np.stack(rows, axis=2)
            spread = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2) + noise * np.eye(width)
            size = (left * np.linalg.solve(spread, left[..., np.newaxis])[..., 0]).sum(axis=1)
            for sample, far in zip(members, (size > OUTER**2).tolist(), strict=True):
                (self.suspicious if far else good).append(sample)
        return good

    def _estimate(self) -> tuple[Chain, FloatArray, FloatArray, float]:
        """Return the chain, the step (P,) to it, its covariance, and the variance of the noise.

        The covariance (P, P) is for the noise of the residuals.
        """
        assert self._chain is not None
        vector = self._products[:-1, -1]
        step, root = solved(self._products[:-1, :-1], vector, np.zeros(len(vector)))
        left = max(float(self._products[-1, -1] - step @ vector), 0.0)
        freedom = self._rows - len(vector)
        noise = max(left / freedom, STEP_TOLERANCE**2) if freedom > 0 else 1.0
        chain = self._chain.with_offsets(dict(zip(self._names, step, strict=True)))
        return chain, step, noise * root @ root.T, noise

    def _result(self) -> Estimate:
        chain, _, covariance, noise = self._estimate()
        jacobian = ErrorModel(chain, self._names).jacobian(self._joints)[:, :3]
        variance = ((jacobian @ covariance) * jacobian).sum(axis=(1, 2))
        rms, ratio = self._left(chain)
        return Estimate(
            chain=chain,
            names=self._names,
            covariance=covariance,
            samples=len(self._added),
            sigma=float(np.sqrt(variance.mean())),
            noise=float(np.sqrt(noise)),
            rms=rms,
            excess=ratio if self._enough(self._rows) else None,
        )

    def _left(self, chain: Chain) -> tuple[float, float]:
        """Return the RMS position residual [m], and in units of the measurement scatter."""
        chosen = np.linspace(0, len(self._added) - 1, SOME).round().astype(int)
        some = [self._added[k] for k in np.unique(chosen)]
        total = squares = 0.0
        for members, each in self._groups(some):
            left = residual_arrays(chain, each)[0]
            scatter = np.full(len(each), self._sigmas[0] ** 2)
            if each.covariance is not None:
                own = np.trace(each.covariance[:, :3, :3], axis1=1, axis2=2) / 3.0
                scatter = np.where(np.isnan(own), scatter, own)
            spread = np.array([sample.spread for sample in members])
            squares += float((left**2).sum())
            total += float(((left**2).mean(axis=1) / np.maximum(scatter, spread**2)).sum())
        return math.sqrt(squares / len(some)), math.sqrt(total / len(some))


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
