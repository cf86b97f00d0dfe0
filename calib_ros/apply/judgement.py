# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The verdict on a calibrated arm by its errors at new measurements.

With the wanted RMS error as limit, and the interval of `confidence.py`, it is

    PASS        the whole interval is within the limit
    FAIL        the whole interval is beyond it
    UNDECIDED   the limit lies in the interval: more poses are needed

Of a device with more noise than that of the calibration, the excess is no error of the arm: it
does not hold only if the interval without it is beyond the limit. Noise that nobody states is
that of `device_noise.py`, at most `largest_error`: rows in another order look like noise, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from calib_ros.apply.confidence import limits_of, moments_of
from calib_ros.apply.device_noise import noise_seen, unstated
from calib_ros.decision import mistakes
from calib_ros.decision.comparison import Comparison, along_base, compare
from calib_ros.decision.diagnosis import Diagnosis
from calib_ros.decision.trials import position_fault_limit
from calib_ros.errors import MOST_ENTRIES
from calib_ros.estimation.levels import CLEARLY, CONFIDENT
from calib_ros.estimation.observations import Observations
from calib_ros.estimation.problem import Problem
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.orientations import with_known_turns
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.se3 import Index
from calib_ros.settings import Settings
from calib_ros.shown import rounded

Verdict: TypeAlias = Literal['PASS', 'FAIL', 'UNDECIDED', 'holds', 'does not hold', 'no verdict']
STANDS: dict[Verdict, Verdict] = {'PASS': 'holds', 'FAIL': 'does not hold'}
DECIDING = 10 * MOST_ENTRIES  # largest number of configurations reported as deciding


def compared(limit: float, lower: float, upper: float) -> Literal['PASS', 'FAIL', 'UNDECIDED']:
    """Return the verdict on an RMS error by its interval."""
    return 'PASS' if upper <= limit else 'FAIL' if lower > limit else 'UNDECIDED'


@dataclass(frozen=True, eq=False, repr=False)
class Judgement:
    """Errors of new measurements before and after a correction, and the verdict."""

    comparison: Comparison
    """Residuals by the nominal and by the calibrated arm, along the axes of its base."""
    limit: float | None
    """The tolerance, or else the largest error [m] of a calibration that holds, if known."""
    confidence: float
    """Of the interval."""
    rms: float
    lower: float
    upper: float
    """RMS position error [m] over poses like these, and its interval."""
    freedom: float
    """Degrees of freedom of that error."""
    verdict: Verdict
    """Without a tolerance 'holds' and 'does not hold' instead of PASS and FAIL, or 'no verdict' if
    the former error is unknown; no verdict either if fitted measurements look good, or if a
    `mistake` explains them."""
    needed: int | None
    """Configurations that would decide with the same RMS error; None if not even DECIDING."""
    reused: float
    """Share of the measurements that the calibration was fitted to (`Calibration.reused`)."""
    mistake: Diagnosis | None
    """What explains measurements that are further off than any arm."""
    noise: float
    """RMS [m] of the noise of a noisier device beyond the former error; 0 if not decisive."""
    unstated: bool
    """Whether nobody stated the noise of some measurements."""
    sigma_position: float | None
    """Stated noise [m] of positions without a covariance."""
    near: tuple[str, ...]
    """Joints that move clearly less than in the calibration, of one that holds."""

    @property
    def failed(self) -> bool:
        """Tell whether the error is beyond the limit."""
        return self.verdict in ('FAIL', 'does not hold')

    @property
    def overstated(self) -> str:
        """Return that the stated noise, which decides, contradicts the errors; empty if not.

        Stated is often the accuracy of a device, a few times its noise.
        """
        if self.noise <= CLEARLY * self.rms:
            return ''
        return (
            f'the noise stated for the device, {rounded(1e3 * self.noise)} mm more than in the '
            f'calibration, contradicts the errors of {rounded(1e3 * self.rms)} mm in all: state '
            'its own (sigma_position)'
        )

    @property
    def group(self) -> Index:
        """Return the configuration (N,) of each measurement; `configurations` counts them."""
        return self.comparison.before.configurations

    @property
    def configurations(self) -> int:
        """Return the number of different configurations."""
        return int(self.group.max()) + 1


def judge(
    arm: Calibration,
    sets: Sequence[Observations],
    found: Comparison | None = None,
    tolerance: float | None = None,
    confidence: float = CONFIDENT,
    lost: int = 0,
    of_messages: bool = False,
    sigma_position: float | None = None,
    chain: Chain | None = None,
) -> Judgement:
    """Judge a calibrated arm by its errors at new measurements, in its frames if not given.

    Each configuration counts once, however often it was measured; fitted frames have absorbed the
    errors of `lost` ones. Without a `tolerance` [m] the limit is that of the calibration. Remedies
    of a mistake are those of messages or of tables. `sigma_position` [m] is the noise of positions
    without a covariance; None that of the earlier device, or more if the errors show it. `chain`
    is the calibrated arm in refitted frames.
    """
    if found is None:
        sets = with_known_turns(arm, sets)
        found = along_base(compare(arm.before, arm.chain, sets), arm.chain, sets)
    moments = moments_of(found.after.position, found.before.configurations)
    rms, numbers, freedom, lower, upper = limits_of(moments, lost, confidence, DECIDING)
    angle = 1e-3 * (found.figures[1].rms_mrad or 0.0)
    mistake = _mistake(arm, sets, rms, angle, of_messages)
    reused, limit = arm.reused(sets), tolerance or arm.limit(sets, found.figures[0].rms_mm)
    beyond = limit is not None and not tolerance and lower[0] > limit
    guessed = unstated(sets) if sigma_position is None else []
    given = sigma_position, chain or arm.chain, guessed
    noise = _noise_beyond(arm, sets, *given) if beyond else 0.0
    least = np.sqrt(np.maximum(lower**2 - noise, 0.0))
    verdict: Verdict = 'no verdict'
    if limit is not None and not mistake:
        verdict = compared(limit, least[0], upper[0])
        decided = numbers[(upper <= limit) | (least > limit)]
        noise *= verdict != compared(limit, lower[0], upper[0])
        decided = decided[:0] if noise and guessed else decided  # its own error is not known
    if reused and verdict != 'FAIL':
        verdict = 'no verdict'
    verdict = STANDS.get(verdict, verdict) if tolerance is None else verdict
    return Judgement(
        comparison=found,
        limit=limit,
        confidence=confidence,
        rms=rms,
        lower=float(lower[0]),
        upper=float(upper[0]),
        freedom=float(freedom[0]),
        verdict=verdict,
        needed=None if verdict == 'no verdict' or not decided.size else int(decided[0]),
        reused=reused,
        mistake=mistake,
        noise=float(np.sqrt(noise)),
        unstated=bool(guessed),
        sigma_position=sigma_position,
        near=_near(arm, sets) if verdict == 'holds' else (),
    )


def _noise_beyond(
    arm: Calibration,
    sets: Sequence[Observations],
    stated: float | None,
    chain: Chain,
    guessed: Sequence[Observations],
) -> float:
    """Return by how much the mean square noise [m^2] exceeds the former noise and error."""
    if arm.noise is None or arm.residual is None or any(s.pixels is not None for s in sets):
        return 0.0
    problem = Problem(arm.before, sets[0], more=sets[1:])  # the earlier device
    then = now = arm.noise.expected_in(problem).sigma_position
    if guessed:
        now = max(now, min(noise_seen(chain, guessed), Settings.largest_error))
    elif stated is not None:
        problem = replace(problem, sigma_position=stated)
        now = arm.noise.expected_in(problem, ('sigma_position',)).sigma_position
    found = np.concatenate([each.covariances((now, 1.0))[:, :3, :3] for each in sets])
    ways = np.concatenate([each.ways for each in sets])
    squares = np.trace(found, axis1=1, axis2=2) * ways / 3.0
    return max(0.0, float(squares.mean()) - max(float(ways.mean()) * then**2, arm.residual**2))


def _near(arm: Calibration, sets: Sequence[Observations]) -> tuple[str, ...]:
    if arm.rows is None:
        return ()
    return tuple(np.array(arm.chain.joint_names)[arm.rows.narrow(sets)].tolist())


def _mistake(
    arm: Calibration, sets: Sequence[Observations], error: float, angle: float, of_messages: bool
) -> Diagnosis | None:
    problem = Problem(arm.before, sets[0], more=sets[1:], of_messages=of_messages)
    most = position_fault_limit(problem)
    if error <= most and angle <= problem.largest_angle:
        return None
    found = mistakes.diagnose(problem, far=True) or mistakes.diagnose_alone(problem, arm.chain)
    known = error > most or (found and found.alone)  # else positions fit
    return found if known else None
