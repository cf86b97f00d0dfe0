# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a calibration holds, in words: a verification, and the answers of the node."""

from __future__ import annotations

import numpy as np

from calib_ros.apply.confidence import interval_of
from calib_ros.apply.verification import DECIDING, Verification
from calib_ros.decision.changes import FALSE, changes_in_words
from calib_ros.decision.validation import Comparison
from calib_ros.estimation.levels import NEARER
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.recalibrated import Recalibration
from calib_ros.identification.records import reused_in_words
from calib_ros.report.words import interval_mm
from calib_ros.settings import Settings
from calib_ros.shown import rounded


def likely(found: Verification) -> str:
    """Return the RMS error over poses like these, with its interval."""
    between = interval_mm(1e3 * found.lower, 1e3 * found.upper)
    return f'{rounded(1e3 * found.rms)} mm ({100.0 * found.confidence:g} %: {between} mm)'


def each_in_words(found: Verification) -> list[str]:
    """Return the table lines of the poses [mm]; of ISO 9283 only if the program is known."""
    repeated = any(pose.repeatability is not None for pose in found.each)
    what = 'repeatability' if found.by_program else 'scatter'
    lines = ['  pose   measured   before    after' + repeated * f'   {what} (mean + 3 sigma)']
    for k, pose in enumerate(found.each, 1):
        line = f'  {k:4} {pose.cycles:10} {rounded(pose.before):>8} {rounded(pose.after):>8}'
        again = '' if pose.repeatability is None else f' {rounded(pose.repeatability):>8}'
        lines.append(line + again)
    return lines if found.each else []


def limits(found: Verification) -> list[str]:
    """Return what the verdict leaves open."""
    lines = [warning] if (warning := reused_in_words(found.reused)) else []
    if not found.by_program:
        lines.append(
            'this judges the calibration, not the corrected robot: give the uncorrected program '
            '(--commanded) to test whether the correction reaches the arm'
        )
    turned = found.comparison.figures[1].rms_mrad
    moved = found.common < NEARER
    if turned is not None and turned > 1e3 * Settings.largest_angle and not moved:
        lines.append(
            f'the orientations are {turned:.0f} mrad off, but only positions are judged: check '
            'their format (order of the quaternion or angles, degrees) and the target'
        )
    return lines


def remarks(found: Verification) -> list[str]:
    """Return remarks on the figures, and what to do."""
    return [*limits(found), *hints(found)]


def hints(found: Verification) -> list[str]:
    """Return what was refitted, and possible causes of the error."""
    lines = []
    if found.fitted:
        lines.append(f'{" and ".join(found.fitted)} refitted, before and after alike')
    if found.verdict == 'UNDECIDED':
        enough = f'about {found.needed}' if found.needed else f'not even {DECIDING}'
        lines.append(f'{enough} poses with the same RMS error would decide')
    if found.uncorrected and found.verdict in ('FAIL', 'does not hold'):
        lines.append(
            'the arm stood at the joint values of --commanded themselves: either the correction '
            'is not active, or this is the corrected program: give the program as it was before '
            'calib_ros compensate'
        )
    if found.verdict == 'does not hold':
        lines.append('the error has grown since the calibration was made')
    if found.common < NEARER:
        lines.append(
            'without one common shift and turn of all positions, only '
            f'{100.0 * found.common:.2g} % of the error would remain: was the measuring device '
            'moved? If on purpose, --new-base fits its frame, and --new-tool that of a new target'
        )
    elif 1e-3 * found.comparison.figures[1].rms_mm > Settings.largest_error:
        lines.append(
            'no arm is so far off: check units and columns of the measurements (--length, '
            '--joint-angle, --columns), their rows, the robot, and the target (--new-tool)'
        )
    return lines


def checked(previous: Calibration, found: Recalibration) -> tuple[bool, str]:
    """Return whether a calibration holds at the last stops, and why."""
    text = f'RMS {found.before.rms_mm:.3f} mm at the last {found.before.count} poses'
    if found.changed:
        reasons = changes_in_words(found.changed)
        return False, (
            f'the calibration in use no longer fits, {reasons}: was it bumped? {text}; measure '
            'at least 8 poses and call ~/identify, or run calib_ros identify --previous'
        )
    if found.unexplained <= FALSE:
        return False, (
            f'{text}, more than the calibration in use and noise explain; no change of a few '
            'parameters explains it: measure new poses and call ~/identify'
        )
    if previous.holds(_least_and_most(found.comparison, 0)[0]) is False:
        return False, _lost(previous, text)
    return True, f'the calibration in use agrees with the measurements: {text}'


def verdict(
    calibration: Calibration, found: Comparison, reused: float = 0.0
) -> tuple[bool | None, str]:
    """Return whether a calibration holds on samples, of which a share is `reused`, and why.

    None if the interval of the error contains the limit, as for `verify`.
    """
    nominal, now = found.figures
    text = f'RMS {now.rms_mm:.3f} mm (mean {now.mean_mm:.3f}, max {now.max_mm:.3f}) on '
    text += f'{now.count} poses measured since; the nominal chain has {nominal.rms_mm:.3f} mm'
    if warning := reused_in_words(reused):
        text += f'; {warning}'
    if calibration.residual is None:
        return True, text
    least, most = _least_and_most(found, 1)
    if not calibration.holds(least):
        return False, _lost(calibration, text)
    text += f'; it had {1e3 * calibration.residual:.3f} mm'
    if not calibration.holds(most):
        return None, f'too few poses to tell whether the calibration holds: {text}; measure more'
    return True, f'the calibration holds: {text}'


def _least_and_most(found: Comparison, when: int) -> tuple[float, float]:
    """Return the 95 % interval [m] of the RMS error; the figure alone without positions."""
    rms = 1e-3 * found.figures[when].rms_mm
    limits = interval_of(found, when)
    return limits if np.isfinite(limits[1]) else (rms, rms)


def _lost(calibration: Calibration, text: str) -> str:
    return (
        f'the calibration no longer holds: {text}; it had '
        f'{1e3 * (calibration.residual or 0.0):.3f} mm. Was the tracker, target or robot moved?'
    )
