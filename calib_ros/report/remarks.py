# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What the figures of a verification tell beside its verdict."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from calib_ros.apply.judgement import DECIDING
from calib_ros.apply.verified import Verification
from calib_ros.decision.comparison import log_gain
from calib_ros.estimation.levels import CERTAIN, NEARER
from calib_ros.identification.fingerprint import reused_in_words
from calib_ros.kinematics.se3 import norms
from calib_ros.report.words import turned_in_words
from calib_ros.settings import Settings
from calib_ros.shown import interval_mm, rounded, sentence, some


def likely_rms(found: Verification) -> str:
    """Return the RMS error over poses like these, with its interval."""
    between = interval_mm(1e3 * found.lower, 1e3 * found.upper)
    return f'{rounded(1e3 * found.rms)} mm ({100.0 * found.confidence:g} %: {between} mm)'


def each_in_words(found: Verification) -> list[str]:
    """Return the table lines of the poses [mm]; of ISO 9283 only if the program is known."""
    repeated = any(pose.repeatability is not None for pose in found.each)
    what = 'repeatability' if found.by_program else 'scatter'
    lines = ['  pose   measured   before    after' + repeated * f'   {what} (mean + 3 std)']
    for k, pose in enumerate(found.each, 1):
        line = f'{f"P{k}":>6} {pose.cycles:10} {rounded(pose.before):>8} {rounded(pose.after):>8}'
        again = '' if pose.repeatability is None else f' {rounded(pose.repeatability):>8}'
        lines.append(line + again)
    return lines if found.each else []


def caveats(found: Verification) -> list[str]:
    """Return what the verdict leaves open, or why there is none."""
    lines = [warning] if (warning := reused_in_words(found.reused)) else []
    if found.mistake:
        return [*lines, str(found.mistake)]
    if not found.by_program:
        lines.append(
            'this judges the calibration, not the corrected robot: give the uncorrected program '
            '(--commanded) to test whether the correction reaches the arm'
        )
    if found.near:
        lines.append(
            f'it holds near these poses only: {", ".join(some(found.near))} moved less than '
            f'{100.0 * NEARER:g} % as far as for the calibration; for more, verify all over its '
            'range'
        )
    if found.unseen is not None and found.unseen > (found.limit or 0.0):
        lines.append(
            'a change of one joint or link could go unseen here and move the target by up to '
            f'{rounded(1e3 * found.unseen)} mm where it is worst'
        )
    turned = turned_in_words(found.comparison.figures[1])
    return [*lines, turned] if turned and found.common >= NEARER else lines


def remarks(found: Verification) -> list[str]:
    """Return remarks on the figures, and what to do."""
    return [*caveats(found), *hints(found), *causes(found)]


def not_steps(lines: Sequence[str], steps: Sequence[str]) -> list[str]:
    """Return the remarks that are not among the steps."""
    return [each for each in lines if sentence(each) not in steps]


def hints(found: Verification) -> list[str]:
    """Return what was refitted, and what else the figures tell."""
    lines = []
    if found.fitted:
        lines.append(f'{" and ".join(found.fitted)} refitted, before and after alike')
    if found.verdict == 'UNDECIDED' and not found.outside:
        enough, side = f'not even {DECIDING:,}', 'decide'
        if found.needed and found.limit:
            side = f'be {"within" if found.rms <= found.limit else "beyond"} {_wanted(found)}'
            enough = f'about {found.needed:,}'
        lines.append(f'{enough} poses with the same RMS error would {side}, these included')
    before, rms = (each.rms_mm for each in found.comparison.figures)
    if found.outside and not found.mistake:
        share = round(100.0 * found.outside) or 'less than 1'
        lines.append(
            f'{share} % of the measurements are outside the region of the calibration, where it '
            'may make the arm worse and compensate refuses: verify within it, or identify with '
            'poses like these'
        )
    if rms > before and not (found.mistake or found.uncorrected or causes(found)):
        whose = '' if found.outside > 0.5 else ': is the calibration that of this robot?'
        lines.append(f'the nominal arm has the smaller error{whose}')
    return lines


def causes(found: Verification) -> list[str]:
    """Return what explains the error, each with what to do about it; empty if nothing does."""
    lines: list[str] = []
    if found.mistake:
        return lines
    if found.uncorrected and found.failed:
        lines.append(
            'the arm stood at the joint values of --commanded themselves: either the correction '
            'is not active, or this is the corrected program: give the program as it was before '
            'calib_ros compensate'
        )
    rms, common = 1e-3 * found.comparison.figures[1].rms_mm, 100.0 * found.common
    largest = max(Settings.largest_error, found.limit or 0.0)
    if found.step or found.odd:
        lines += [f'something moved while you measured: {found.step}'] if found.step else []
        lines.append(
            _odd_in_words(found) if found.odd else 'put right what moved, and measure again'
        )
    elif (found.common if found.common < NEARER else 1.0) * rms > largest and not _fits(found):
        lines.append(
            'no arm is that far off: check the units and columns of the measurements (--length, '
            '--joint-angle, --columns), their rows, the robot, and whether the device '
            '(--new-base) or the target (--new-tool) was moved'
        )
    elif found.common < NEARER:
        lines.append(
            f'one common shift and turn of all positions explains all but {common:.2g} % of the '
            'error: was the measuring device moved (with a camera on the flange: its target)? If '
            'so, verify again with --new-base (and --new-tool for a new target); if not, find out '
            'what moved'
        )
    return lines


def _fits(found: Verification) -> bool:
    """Tell whether the correction lowers the error: then the rows are of this arm.

    By less than chance, or by a correction that hardly counts beside the error, proves nothing.
    """
    before, after = found.comparison.before.position, found.comparison.after.position
    gain, chance = log_gain(before, after, found.group, CERTAIN)
    return gain > chance and bool(NEARER * np.linalg.norm(after) < np.linalg.norm(before - after))


def _wanted(found: Verification) -> str:
    return 'the limit' if found.tolerance is None else 'the tolerance'


def _odd_in_words(found: Verification) -> str:
    """Return which poses are beyond the limit while the others are within it."""
    first, last = found.odd[0] + 1, found.odd[-1] + 1
    names = f'poses {", ".join(some([str(k + 1) for k in found.odd]))} alone are up to'
    if first == last:
        names = f'pose {first} alone is'
    elif last - first < len(found.odd):
        names = f'poses {first} to {last} alone are up to'
    far = 1e3 * norms(found.comparison.after.position[np.isin(found.group, found.odd)]).max()
    return (
        f'{names} {rounded(far)} mm off; the others are within {_wanted(found)}: measure again; '
        'if the error stays, find out what moved, changed or was hit; an arm may also be worse in '
        'part of its range'
    )
