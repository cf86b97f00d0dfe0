# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The result of an identification."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import special

from calib_ros.annotated import Count, NotNegative, Share, as_annotated
from calib_ros.decision.comparison import Comparison, GroupVerdict, compare
from calib_ros.decision.misfits import Outlier
from calib_ros.decision.moved import FROM_THERE, Step
from calib_ros.decision.reasons import Reason
from calib_ros.decision.region import Region
from calib_ros.estimation.fitted import ParameterRow
from calib_ros.estimation.levels import CONFIDENT, KNOWN, LEAST_ASIDE
from calib_ros.estimation.noise import Noise
from calib_ros.estimation.observability import correlated
from calib_ros.estimation.posterior import Posterior
from calib_ros.estimation.problem import Problem
from calib_ros.estimation.uncertainty import Uncertainty
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.jacobian import ErrorModel
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.shown import Shown, as_frame, as_html, rounded


@dataclass(frozen=True, eq=False, repr=False)
class Identification(Shown):
    """The result of an identification; a poor fit is data in it, not an error."""

    chain: Chain
    before: Chain
    """The nominal chain. Both have fitted frames."""
    parameters: tuple[ParameterRow, ...]
    names: tuple[str, ...]
    """Fitted parameters, (P,)."""
    uncertainty: Uncertainty
    """Of the fitted parameters, for the noise found in the residuals."""
    fitted: Comparison
    """Residuals of the fitted pairs."""
    validation: Comparison | None
    """Residuals of held-out pairs; None if there are too few poses."""
    validated_by: str
    """How these pairs were held out."""
    noise: Noise
    distances: tuple[FloatArray, ...]
    """Residuals (N,) of each set's samples in units of the usual one (`weights.py`)."""
    outliers: tuple[Outlier, ...]
    """Samples with gross errors; they carry little or no weight in the fit."""
    gauges: dict[str, list[str]]
    """For each omitted parameter, the fitted ones it trades off against."""
    observability: dict[str, float]
    """Observability indices o1 to o5."""
    priors: dict[str, float]
    """Standard deviations [m, rad] known beforehand."""
    problem: Problem
    """The pairs as fitted: corrected where clocks drift or stamps jitter."""
    converged: bool
    chance: float | None
    """Probability that drift of the device, shared by successive measurements, would let the arm's
    parameters explain as much. None for a target in sockets."""
    refusals: tuple[Reason, ...]
    """Failed acceptance rules, in words, in the order of `Rule`; empty if accepted."""
    posterior: Posterior
    """The posterior of the arm, unmodelled effects included."""
    region: Region | None
    """Where the calibration may be used; None if nowhere."""
    weak: tuple[str, ...]
    """Parameters that the poses hardly determine, held near nominal by a prior."""
    step: Step | None
    """What moved during the measurement (`steps.py`)."""
    remarks: tuple[str, ...]
    """What is suspicious despite good figures, and what to do (`plausibility.py`)."""
    coupled: bool
    """Whether unfitted couplings of the wrist explain most of the residuals."""
    surprise: float
    """How many times further off held-out positions are than expected, 0 if not clearly; all
    stated errors are larger accordingly."""
    strain: str
    """That the device stretches space in one direction, in words; empty if not."""
    images: int
    """Number of board images fitted."""
    verdicts: tuple[GroupVerdict, ...] = ()
    """Effects tried if the model was chosen."""

    @property
    def accepted(self) -> bool:
        """Tell whether the result may replace the nominal parameters."""
        return not self.refusals

    @property
    def rank(self) -> int:
        """Return the number of fitted parameters."""
        return len(self.names)

    @property
    def covariance(self) -> FloatArray:
        """Return the covariance (P, P) of the fitted parameters."""
        return self.uncertainty.covariance

    @property
    def comparison(self) -> Comparison:
        """Return the residuals of the held-out pairs, or of the fitted ones if there are none."""
        return self.validation or self.fitted

    @property
    def lateness(self) -> float:
        """Return the RMS error [mm] that jitter of stamps explains, which no figure holds."""
        if all(each.punctual is None for each in self.problem.sets):
            return 0.0
        late = [replace(each, punctual=None) for each in self.problem.sets]
        whole = compare(self.before, self.chain, late, self.fitted.judged).figures[1]
        left = whole.rms_mm**2 - self.fitted.figures[1].rms_mm ** 2
        return float(np.sqrt(max(left, 0.0)))

    @property
    def contradiction(self) -> str:
        """Return how far held-out poses are off, if clearly further than expected."""
        return bool(self.surprise) * (
            f'held-out poses are {self.surprise:.3g} times further off than the fitted ones lead '
            'to expect'
        )

    @property
    def unidentifiable(self) -> tuple[str, ...]:
        """Return the parameters that were free but could not be determined."""
        return tuple(p.name for p in self.parameters if p.status in ('gauge', 'not excited'))

    @property
    def not_excited(self) -> tuple[Parameter, ...]:
        """Return the unidentifiable parameters that other poses would determine."""
        return tuple(p.name for p in self.parameters if p.status == 'not excited')

    def pose_covariance(self, q: FloatArray, approach: FloatArray | None = None) -> FloatArray:
        """Return the expected squares (N, 6, 6) [m, rad] of pose errors at q (N, n).

        In world axes; due to the uncertainty of parameters and to unmodelled effects. `approach`
        (N, n) holds the signs of the preceding moves; without it also due to fitted play.
        """
        return self.posterior.expected(q, approach=approach)

    @as_annotated
    def confidence_ellipsoid(
        self, q: FloatArray, level: Share = CONFIDENT, approach: FloatArray | None = None
    ) -> FloatArray:
        """Return (N, 3, 3): rows are the semi-axes [m] of the region of the predicted position.

        By the F distribution if the noise was estimated, by chi-squared (its limit) if it is
        given; `approach` as in `pose_covariance`.
        """
        jacobian = ErrorModel(self.chain, self.names).jacobian(q, approach)[:, :3]
        sources = self.uncertainty.parts
        shares = np.array([np.einsum('ncp,pr,ncr->n', jacobian, s, jacobian) for s in sources])
        shares[-1] = 0.0  # waves: their size is hardly known
        freedom = self.uncertainty.freedom_of(shares)
        posterior, squares = self.posterior, self.pose_covariance(q, approach)[:, :3, :3]
        model = ErrorModel(posterior.chain, posterior.names)
        biased = model.jacobian(q, approach)[:, :3] @ posterior.shift
        even = np.eye(3) * ((biased**2).sum(axis=1) / 3.0)[:, np.newaxis, np.newaxis]
        squares = squares + even - biased[:, :, np.newaxis] * biased[:, np.newaxis]
        values, vectors = np.linalg.eigh(squares)
        square = 3.0 * special.fdtri(3, np.minimum(freedom, KNOWN), level)
        square = np.where(freedom > KNOWN, special.chdtri(3, 1.0 - level), square)
        length = np.sqrt(square[:, np.newaxis] * np.maximum(values, 0.0))
        return np.asarray(np.swapaxes(vectors * length[:, np.newaxis, :], 1, 2))

    @as_annotated
    def predicted_sigma(self, count: Count = 300) -> FloatArray:
        """Return standard deviations (count,) [m] of positions over the joint range.

        The root of the trace of the position covariance at seeded random configurations.
        """
        q = self.chain.random_joints(count, np.random.default_rng(0))
        return np.asarray(np.sqrt(np.trace(self.pose_covariance(q)[:, :3, :3], axis1=1, axis2=2)))

    @as_annotated
    def correlated(self, threshold: NotNegative = 0.9) -> tuple[tuple[str, str, float], ...]:
        """Return pairs of parameters whose correlation exceeds a threshold, strongest first."""
        return correlated(self.covariance, self.names, threshold)

    @property
    def outdated(self) -> tuple[str, ...]:
        """Return the frames that moved since; all of a set whose last poses are outliers."""
        step, found = self.step, list[str]()
        if step and step.unused == FROM_THERE:
            return step.owners if step.outdated else ()
        for number, each in enumerate(self.problem.sets):
            order = np.argsort(each.stamps_ns, kind='stable')[::-1]
            out = np.isin(order, [one.sample for one in self.outliers if one.set == number])
            last = order[: int(np.argmin(np.append(out, False)))]
            if len({*each.configurations[last].tolist()}) >= LEAST_ASIDE:
                found += [each.base, each.tool]
        return tuple(dict.fromkeys(found))

    def to_frame(self) -> Any:
        """Return the parameters as a pandas.DataFrame [m, rad]; `within_95` are half widths."""
        rows = self.parameters
        return as_frame(
            {
                'parameter': [str(p.name) for p in rows],
                'value': [p.value for p in rows],
                'offset': [None if self.chain.owns_frame(p.name) else p.offset for p in rows],
                'std': [p.std for p in rows],
                'within_95': [p.half_width() for p in rows],
                'unit': [p.name.unit for p in rows],
                'status': [p.status for p in rows],
            }
        )

    def _repr_html_(self) -> str:
        before, after = self.comparison.figures
        rows = [('parameter', 'offset [mm, mrad]', '± (95 %)')]
        rows += [
            (str(p.name), f'{1e3 * p.offset:+.4f}', f'{1e3 * (p.half_width() or 0.0):.4f}')
            for p in self.parameters
            if p.std is not None and not self.chain.owns_frame(p.name)
        ]
        sizes = f'{rounded(before.rms_mm)} → {rounded(after.rms_mm)} mm'
        figures = f'RMS {sizes}, by {self.validated_by}'
        verdict = 'accepted' if self.accepted else 'not accepted'
        notes = (figures, *self.refusals, *self.remarks)
        return as_html(f'{self.chain.name}: {verdict}', notes, rows)
