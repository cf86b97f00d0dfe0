# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A result in words: a line for the operator, and phrases for screens and pages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calib_ros.apply.confidence import interval_of
from calib_ros.apply.judgement import Judgement
from calib_ros.decision.changes import changes_in_words
from calib_ros.decision.comparison import Comparison
from calib_ros.decision.misfits import Outlier
from calib_ros.decision.residuals import ErrorFigures
from calib_ros.decision.result import Identification
from calib_ros.estimation.levels import CONFIDENT
from calib_ros.estimation.noise import Noise
from calib_ros.identification.fingerprint import reused_in_words
from calib_ros.identification.recalibrated import Recalibration
from calib_ros.kinematics import effects
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.joint import small_units
from calib_ros.kinematics.parameter import Parameter
from calib_ros.kinematics.se3 import to_quat
from calib_ros.report.advice import COARSE, FAR
from calib_ros.sampling.slices import NO_ACCIDENT
from calib_ros.settings import Settings
from calib_ros.shown import counted, interval_mm, moment, of_them, rounded, some
from calib_ros.values import SAME

WEAK = Settings.largest_error
"""Standard deviation [m or rad] beyond which a parameter is named as weakly determined: an arm
with such an error is not accepted."""
REFUSED = 'NOT accepted'


def summary(
    result: Identification,
    numbers: Mapping[Outlier, int] | None = None,
    warnings: Sequence[str] = (),
    first: str = '',
) -> str:
    """Return the one line for the operator, which begins with the `verdict`.

    `numbers` of outlier samples name these; `warnings` are of the measurements; `first` is what to
    do first about a refusal.
    """
    text = f'judged by {result.validated_by}'
    if count := len(result.outliers):
        where = ', see the report' if numbers is None else f': {_named(result.outliers, numbers)}'
        text += '; 1 outlier carries' if count == 1 else f'; {count} outliers carry'
        text += f' little or no weight{where}'
    if result.unidentifiable:
        text += f'; not identifiable, kept nominal: {", ".join(result.unidentifiable)}'
    text = '; '.join((text, *notes(result)))
    if more := (*warnings, *result.remarks):
        text += f'; note: {"; ".join(more)}'
    if result.accepted:
        return f'{verdict(result)}; {text}'
    todo = f'To do first: {first} ' if first else ''
    return f'{verdict(result)}. {todo}{_figures(result)}; {text}'


def verdict(result: Identification) -> str:
    """Return why a result is refused, or its errors and where it is valid."""
    if not result.accepted:
        return f'{REFUSED}: {"; ".join(result.refusals)}'
    valid = '' if result.region is None else f'; {result.region.in_words()}'
    return f'accepted: {_figures(result)}{valid}'


def _figures(result: Identification) -> str:
    figures = result.comparison.figures
    text = f'{fitted_data(result)}, {rms_change(figures)}'
    if likely := rms_range_mm(result.validation, 1):
        text += f' (95 %: {likely} mm)'
    pixels = rms_change(figures, 'px')
    return f'{text}, {pixels}' if pixels else text


def rms_change(figures: Sequence[ErrorFigures], unit: str = 'mm') -> str:
    """Return the RMS errors before and after in mm, mrad or px; empty if not measured."""
    found = [getattr(each, f'rms_{unit}') for each in figures]
    return '' if None in found else f'RMS {" -> ".join(map(rounded, found))} {unit}'


def rms_range_mm(judged: Comparison | None, when: int) -> str:
    """Return the 95 % interval [mm] of the RMS before (0) or after (1), empty if unknown."""
    limits = limits_mm(judged, when)
    return '' if limits is None else interval_mm(*limits)


def limits_mm(judged: Comparison | None, when: int) -> list[float] | None:
    """Return that interval, or None if unknown; that of a fit would prove nothing."""
    limits = [1e3 * x for x in interval_of(judged, when)] if judged else [np.inf]
    return limits if np.isfinite(limits).all() else None


def fitted_data(result: Identification) -> str:
    """Return what was fitted: poses, images with corners, or both."""
    seen = ~np.isnan(result.fitted.after.pixels[:, 0])
    corners, poses = int(seen.sum()), int((~seen).sum())
    parts = [f'{poses:,} poses'] if poses or not corners else []
    parts += [f'{result.images:,} images with {corners:,} corners'] if corners else []
    return ' and '.join(parts)


def fitted_to(result: Identification) -> str:
    """Return what was fitted, and how much of it is outliers."""
    outliers = f', {of_them(len(result.outliers), "outlier")} with little or no weight'
    return fitted_data(result) + outliers * bool(result.outliers)


def notes(result: Identification) -> list[str]:
    """Return the remarks on the fitted parameters."""
    found = []
    if result.chain.effects:
        groups = dict.fromkeys(effects.group_of(name) for name, _ in result.chain.effects)
        count = len(result.chain.effects)
        found.append(f'with {counted(count, "effect")} ({", ".join(groups)})')
    given = set(result.priors) - set(result.weak) - {name for name, _ in result.chain.effects}
    if given:
        found.append(f'priors on {counted(len(given), "parameter")}')
    if partly := error_meaning(result):
        found.append(partly)
    if result.weak:
        found.append(f'held near nominal by priors: {", ".join(some(result.weak))}')
    weak = [name for name in weakly_determined(result) if name not in result.weak]
    if weak:
        found.append(f'weakly determined: {", ".join(some(weak))}')
    return found


def error_meaning(result: Identification) -> str:
    """Return what errors of sockets, distances, planes, corners mean; empty for positions."""
    if all(each.socket for each in result.problem.sets):
        size = rounded(sigma_over_range(result)['median'])
        of_all = f'expect {size} mm over the joint range'
        return f'errors in sockets leave out the scale of the bar: {of_all}'
    position = result.comparison.after.position
    if (np.abs(position[:, 0]) > SAME)[~position[:, 1:].any(axis=1)].any():
        return (
            'errors of distances and touched planes are along one direction: in space they are '
            'about 1.7 times as large if equal in all directions'
        )
    words = 'the error of a corner is the shortest shift in space that explains its pixels'
    return words if result.images else ''


def _named(outliers: Sequence[Outlier], numbers: Mapping[Outlier, int]) -> str:
    largest = sorted(outliers, key=lambda each: -each.size)
    words = (f'pose {numbers[each]} ({moment(each.stamp_ns)})' for each in largest)
    return ', '.join(some([*dict.fromkeys(words)]))


def weakly_determined(result: Identification) -> tuple[str, ...]:
    """Return the weakly determined parameters: judge them by predictions only."""
    return tuple(
        p.name
        for p in result.parameters
        if p.std is not None and p.std > WEAK and not p.name.of_lens
    )


def still_holds(updated: Recalibration, found: Judgement) -> tuple[bool, str]:
    """Return whether a calibration holds at the last stops, and why."""
    text = f'RMS {rounded(1e3 * found.rms)} mm at the last {counted(found.configurations, "pose")}'
    doubted = not (updated.step or updated.explained)  # noise that nobody stated, perhaps
    if found.mistake or (doubted and found.unstated and found.noise):
        return False, verdict_in_words(found)
    if doubted and found.verdict == 'holds':
        return True, verdict_in_words(found)
    if updated.step or updated.changed:  # poses before and after a step look like many changes
        reasons = updated.step or changes_in_words(updated.changed)
        if not (updated.step or updated.explained):
            reasons = f'perhaps {reasons}, or the device has more noise (sigma_position)'
        creeps = updated.step is not None and updated.step.slow
        asked = 'does {} give way?' if creeps else 'was {} bumped?'
        return False, (
            f'the calibration in use no longer fits, {reasons}: '
            f'{asked.format("the robot, the target or the device")} {text}; call ~/clear and '
            'measure again: 30 poses for ~/identify, 8 for calib_ros identify --previous'
        )
    if not updated.explained:
        return False, (
            f'{text}, more than the calibration in use and noise explain; no change of a few '
            'parameters explains it: if the device has more noise, set sigma_position; else call '
            '~/clear, measure new poses and call ~/identify'
        )
    if found.failed or found.overstated:
        return False, verdict_in_words(found)
    return True, f'the calibration in use agrees with the measurements: {text}'


def verdict_in_words(found: Judgement) -> str:
    """Return whether a calibration holds on new measurements, and why."""
    nominal, now = found.comparison.figures
    since = f'{counted(found.configurations, "pose")} measured since'
    text = f'RMS {rounded(1e3 * found.rms)} mm (max {rounded(now.max_mm)}) on {since}'
    if found.mistake:
        return f'no verdict: {found.mistake}; {text}'
    told = f'{text}; the nominal chain has {rounded(nominal.rms_mm)} mm'
    if found.limit is None:
        told = f'no verdict, the calibration has no former error: {told}'
        return f'{told}; judge with calib_ros verify --tolerance'
    told += f'; the limit is {rounded(1e3 * found.limit)} mm'
    if found.failed:
        return f'the calibration no longer holds: {told}. Was tracker, target or robot moved?'
    if warning := reused_in_words(found.reused):
        return f'no verdict: {warning}: measure new ones; {text}'
    if found.verdict == 'UNDECIDED':
        if found.noise and found.needed is None:
            if found.overstated:
                return f'no verdict: {found.overstated}; {told}'
            if found.unstated and found.configurations < NO_ACCIDENT:
                told = f'noise of the device from a change: {told}; measure more'
                return f'too few poses to tell {told}, or set sigma_position of another device'
            return (
                f'the device has too much noise to tell: {told}; use a device as accurate as that '
                'of the calibration'
            )
        return f'too few poses to tell whether the calibration holds: {told}; measure more'
    turned = turned_in_words(now)
    near = '; this holds only near these poses' * bool(found.near)
    return f'the calibration holds: {told}{near}' + f'; but {turned}' * bool(turned)


def turned_in_words(figures: ErrorFigures) -> str:
    """Return that measured orientations fit no arm; empty if they do, or without any."""
    turned = figures.rms_mrad or 0.0
    if turned <= 1e3 * Settings.largest_angle:
        return ''
    return (
        f'the orientations are {turned:.0f} mrad off, but only positions are judged: check '
        'their format (order of the quaternion or angles, degrees) and the target'
    )


BEFORE_IS = 'the nominal chain with its base and tool frames fitted to the same measurements'


def sigma_over_range(result: Identification) -> dict[str, float]:
    """Return the accuracy of predicted positions over the joint range [mm]."""
    sigma = 1e3 * result.predicted_sigma()
    return {'median': float(np.median(sigma)), 'max': float(sigma.max())}


def times_in_words(noise: Noise) -> str:
    """Return the ratio of the residuals to the device's noise."""
    shown = [f'{x:,.{2 if x < 100.0 else 0}f}' for x in (noise.position, noise.orientation or 0.0)]
    text = '' if noise.orientation is None else f', {shown[1]} times in orientation'
    return f'{shown[0]} times the assumed device noise{text}'


def scatter_in_words(noise: Noise) -> str:
    """Return the excess of the residuals over the device's noise."""
    text = f'The remaining error is {times_in_words(noise)}'
    if noise.consistent:
        return f'{text}: consistent with pure noise (chi-squared test).'
    if noise.position < 1.0:
        return f'{text}: the device is better than that.'
    text += ': the device is worse than that, or the arm has errors that this model lacks.'
    return f'{text} The intervals are widened accordingly.'


def unmodelled_in_words(result: Identification) -> str:
    """Return how far joints turn and tilt as no parameter explains; empty if they do not.

    Not if held-out poses contradict the fit, which widens all that is expected.
    """
    lacking = result.posterior.unmodelled
    seen = lacking.waves * lacking.shown  # else assumed
    across = np.hypot(lacking.tilts, np.sqrt(2.0) * seen)
    unit = small_units(result.chain.joints)
    sizes = (lacking.turns, unit, 'in their values'), (across, 'mrad', 'across their axes')
    off = ' and '.join(f'{1e3 * x:.3f} {of} {way}' for x, of, way in sizes if round(1e3 * x, 3))
    come = 'may come' if result.noise.consistent else 'seems to come'
    text = (
        f'Part of the remaining error {come} from the arm and is not in the model, as if joints '
        f'were off by {off} (standard deviation). Expected errors include it.'
    )
    return text if off and not result.surprise else ''


def disturbed_in_words(noise: Noise) -> str:
    """Return that the device drifts, or far more is left than its noise; empty if neither."""
    if drifts(noise):
        return f'{neighbours_in_words(noise)} {STEADY}'
    return COARSE.format(noise.position) if noise.position >= FAR else ''


def drifts(noise: Noise) -> bool:
    """Tell whether poses share errors in succession only, or far more than neighbours do."""
    more = 'successive' in noise.shared and noise.successive > 2.0 * noise.near
    return more or noise.shared == ('successive',)


STEADY = 'Let the device warm up as long as its manual says, and measure in random order.'
NEIGHBOURS = {'successive': 'measured in succession', 'near': 'near each other in joint space'}


def neighbours_in_words(noise: Noise) -> str:
    """Return which neighbours share errors, their size and consequence."""
    if not noise.shared:
        return 'No errors shared by neighbouring poses were found.'
    parts = [f'{NEIGHBOURS[kind]} ({getattr(noise, kind):.2f})' for kind in noise.shared]
    text = (
        f'Poses {" and ".join(parts)} have similar errors (correlation in brackets): '
        'the device drifts, or the arm has errors that this model lacks.'
    )
    if noise.widened >= 1.005:
        text += f' This makes the standard deviations {noise.widened:.2f} times as large.'
    return text


def chance_in_words(chance: float) -> str:
    """Return how well drift explains the gain."""
    share = f'{100.0 * chance:.1f}' if chance >= 0.001 else 'less than 0.1'
    return (
        f'Errors shifted to the wrong poses can be corrected just as well in {share} % of cases: '
        f'above {100.0 * (1.0 - CONFIDENT):.0f} % the improvement may only be drift of the device.'
    )


def priors_in_words(result: Identification) -> list[str]:
    """Return the priors, those of effects by group."""
    known = dict(result.chain.effects)
    why = dict.fromkeys(result.weak, ', because the poses hardly determine it')
    lines = [
        f'prior on {name}: {_in_thousandths(name, sigma)}{why.get(name, "")}'
        for name, sigma in result.priors.items()
        if name not in known
    ]
    groups: dict[tuple[str, str], list[str]] = {}
    for name in known:
        key = effects.group_of(name), Parameter(name).unit
        groups.setdefault(key, []).append(name)
    for (group, _), names in groups.items():
        size = _in_thousandths(names[0], result.priors[names[0]])
        lines.append(f'prior on {len(names)} parameters of {group}: {size}')
    return lines


def _in_thousandths(name: str, sigma: float) -> str:
    scale, unit = Parameter(name).small_unit
    return f'{scale * sigma:.3g} {unit}'


def cameras_in_words(result: Identification) -> list[str]:
    """Return the places of cameras and boards, and fitted lenses."""
    chain = result.chain
    cameras = [name for name in chain.frame_names if chain.frame(name).lens is not None]
    lines = []
    fitted = result.fitted.figures[1].rms_px if cameras else None
    if fitted is not None:
        lines.append(f'RMS {fitted:.3f} px on the corners fitted')
    on_flange, other = ('camera', 'board') if 'tool' in cameras else ('board', 'camera')
    about = {'base': f' (arm seen from the {other})', 'tool': f' ({on_flange} on the flange)'}
    if len(chain.frame_names) > 2:  # several devices
        about = {}
    for name in chain.frame_names if cameras else ():
        frame = chain.frame(name)
        place = ' '.join(f'{x:.6f}' for x in frame.matrix[:3, 3].tolist())
        turn = ' '.join(f'{x:.6f}' for x in to_quat(frame.matrix[:3, :3]).tolist())
        lines.append(f'{name}{about.get(name, "")}: xyz {place} m, quaternion xyzw {turn}')
        if frame.lens is not None and not frame.lens.fixed:
            values = ', '.join(f'{kind} {x:.6g}' for kind, x in frame.lens.values.items())
            lines.append(f'{name}: {values}')
    return lines


def observability_in_words(result: Identification) -> str:
    """Return the observability indices."""
    found = {name: float(f'{x:.3g}') for name, x in result.observability.items()}
    return ', '.join(f'{name.upper()} {x:,g}' for name, x in found.items())


def against_truth(result: Identification, truth: Chain) -> str:
    """Return a table of fitted and true joint parameters."""
    width = max(len(name) for name in result.names)
    rows = [f'  {"parameter":{width}}     true   identified        std   deviation']
    for p in result.parameters:
        if p.std is None or p.name.owner in ('base', 'tool'):
            continue
        true = truth.value(p.name) - (p.value - p.offset)
        rows.append(
            f'  {p.name:{width}} {1e3 * true:+8.3f}   {1e3 * p.offset:+10.3f}   {1e3 * p.std:8.4f}'
            f'   {(p.offset - true) / p.std:+6.1f} std'
        )
    return '\n'.join(rows)
