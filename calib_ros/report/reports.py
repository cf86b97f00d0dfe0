# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The page of an identification."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from calib_ros.apply.confidence import interval_of
from calib_ros.apply.judgement import compared
from calib_ros.apply.workspace import survey
from calib_ros.decision.comparison import Comparison
from calib_ros.decision.result import Identification
from calib_ros.estimation.levels import ALIKE
from calib_ros.estimation.observations import SOME_POSES
from calib_ros.estimation.problem import Problem
from calib_ros.files.loading import Loaded
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.linear_model import COMPARED
from calib_ros.kinematics.chain_file import table_hash
from calib_ros.kinematics.effects import group_of
from calib_ros.report import figures, sections, words
from calib_ros.report.advice import SPREAD_OUT
from calib_ros.report.advised import advice_of
from calib_ros.report.content import Headline, Origin, Report, Section, section
from calib_ros.report.explorer import explorer
from calib_ros.report.gathered import poses_of
from calib_ros.report.poses import Poses
from calib_ros.report.refusals import Advice
from calib_ros.settings import Settings
from calib_ros.shown import counted, rounded, sentence, some

NOT_YET = 'The robot itself is unchanged so far'
BRING = (
    'give the correction to the controller (calib_ros export, or ~/export of the node), or '
    'correct the programs (calib_ros compensate)'
)
BRING_NEAR = (
    'correct the programs with calib_ros compensate, which refuses other poses; in the controller '
    '(calib_ros export) the correction would act everywhere'
)
CLOSER = (
    'to get closer, identify with --model auto: it also corrects gears, gravity and backlash '
    'where that helps'
)
UNPROVEN = 'All these poses were fitted: a small error "after" proves nothing.'
SURVEYED = 20 * SOME_POSES  # random poses of the error map: several per cell


def identification_report(
    loaded: Loaded,
    result: Identification,
    origin: Origin,
    wanted_mm: float | None = None,
    poses: Poses | None = None,
) -> Report:
    """Return the report of an identification; `wanted_mm` is the wanted RMS error."""
    problem, judged = loaded.problem, result.comparison
    poses = poses or poses_of(result, loaded.by_line, loaded.images)
    reasons = advice_of(problem, result)
    text = filter(None, _text(result, reasons, wanted_mm))
    shown = 2 if result.accepted else int(bool(_sound(reasons)))
    gain = sections.gain(judged, count=shown) if shown else ''
    fitted = [counted(result.rank, 'parameter')]
    fitted += words.notes(result)[:1] if result.chain.effects else []
    scale = f'scale checked to {1e6 * problem.sigma_scale:g} ppm'
    scale = scale if problem.sigma_scale else 'scale not checked'
    corrected, notes = 'none: not accepted', result.remarks
    if result.accepted:
        corrected = table_hash(result.chain)
        notes = tuple(filter(None, [words.disturbed_in_words(result.noise)]))
    return Report(
        kind='Kinematic calibration',
        robot=result.chain.name,
        verdict=replace(result_standing(result, reasons, wanted_mm), text=tuple(text), gain=gain),
        advice=reasons,
        accuracy=sections.accuracy_section(
            'Accuracy before and after' if result.accepted else 'Accuracy of the correction tried',
            judged,
            poses.things,
            '' if result.validation else UNPROVEN,
            f'"Before" is {words.BEFORE_IS}, so the gain comes from the arm alone.',
            'RMS (root mean square) is the typical error over poses like these.',
            *(f'Note: {note}.' for note in filter(None, (words.error_meaning(result),))),
            intervals=result.validation is not None,
        ),
        picture=sections.distribution(poses),
        steps=_steps(result, reasons, wanted_mm),
        remarks=tuple(map(sentence, (*loaded.warnings, *notes))),
        identity=sections.identity_of(
            result.chain,
            origin,
            poses,
            (
                ('Fitted', f'{", ".join(fitted)} to {words.fitted_to(result)}'),
                ('Assumed device noise', f'{_stated(problem, poses)}; one sigma; {scale}'),
                ('Remaining error', words.times_in_words(result.noise)),
                ('Judged by', result.validated_by),
            ),
            corrected,
        ),
        explorer=explorer(result.chain, poses),
        sections=tuple(_sections(problem, result, poses)),
        origin=origin,
    )


def result_standing(
    result: Identification, reasons: Sequence[Advice], wanted_mm: float | None
) -> Headline:
    """Return the verdict as a reader sees it first: an arm without visible errors is not bad."""
    if result.accepted:
        within, sure = _within(result.comparison, wanted_mm)
        open_yet = not sure or bool(result.remarks)
        whole = result.region is None or result.region.whole
        heading = f'Accepted{"" if whole else " near the measured poses"}{within}'
        heading += ': check first' * bool(result.remarks)
        return Headline('open' if open_yet else 'good', heading)
    if good := _sound(reasons):
        within, _ = _within(result.comparison, wanted_mm, 0)
        return Headline('info', f'{good}{within}: the robot stays as it was')
    return Headline('bad', 'Not accepted: the robot stays as it was')


def _text(
    result: Identification, reasons: Sequence[Advice], wanted_mm: float | None
) -> Iterator[str]:
    """Yield what is said below the verdict."""
    if result.accepted or _sound(reasons):
        how = 'Each pose is judged by a fit without it' if result.accepted else 'The arm as it is'
        whole = ' The whole interval must be within the tolerance.' * (wanted_mm is not None)
        yield f'{how}; 95 % interval in brackets.{whole}'
        if count := result.comparison.outliers:
            yield f'{counted(count, "outlier")}, listed below: not in these figures.'
    if result.accepted:
        yield from doubts(result)
        yield f'The calibration is {result.region.in_words()}.' if result.region else ''
        yield f'{NOT_YET}.'
        return
    if not _sound(reasons):
        yield f'Why: {". ".join(each.in_short for each in reasons if each.steps)}.'
    yield 'No correction was saved or sent to the robot. The figures show the correction tried.'


def bring(found: Identification | Calibration) -> str:
    """Return how the correction comes to the robot."""
    return BRING if found.region is None or found.region.whole else BRING_NEAR


def doubts(result: Identification) -> tuple[str, ...]:
    """Return the checks to make before using an accepted result."""
    return tuple(sentence(f'Check before you use it: {each}') for each in result.remarks)


def _sound(reasons: Sequence[Advice]) -> str:
    """Return the verdict on a result refused because the arm shows no errors; else empty."""
    return next((each.sound for each in reasons if each.sound), '')


def _within(judged: Comparison, wanted_mm: float | None, when: int = 1) -> tuple[str, bool]:
    """Return in words and tell if the error before (0) or after is within what is wanted."""
    if wanted_mm is None:
        return '', True
    wanted = f'within the tolerance of {wanted_mm:g} mm RMS'
    verdict = compared(1e-3 * wanted_mm, *interval_of(judged, when))
    if verdict == 'PASS':
        return f' and {wanted}', True
    return f', but {"" if verdict == "FAIL" else "perhaps "}not {wanted}', False


def may_be_closer(result: Identification, beyond: bool = False) -> bool:
    """Tell whether effects not tried may explain an error `beyond` what is wanted or the noise."""
    more = not result.noise.consistent and (beyond or result.noise.position > ALIKE)
    return more and not (result.chain.effects or result.verdicts)


def _steps(
    result: Identification, reasons: Sequence[Advice], wanted_mm: float | None
) -> tuple[str, ...]:
    if not (result.accepted or _sound(reasons)):
        return (reasons[0].again,)
    used = result.accepted
    interval = interval_of(result.comparison, int(used))
    verdict = '' if wanted_mm is None else compared(1e-3 * wanted_mm, *interval)
    whole = result.region is None or result.region.whole
    found = {
        'First check what is named above. If it is true, remove the cause and identify '
        'again.': used and bool(result.remarks),
        sentence(CLOSER): used and may_be_closer(result, verdict == 'FAIL'),
        'Compare the remaining error with the accuracy of the measuring device: no calibration '
        'gets below that.': verdict == 'FAIL' and not result.noise.consistent,
        'What is left looks like the noise of the device: measure more poses, or with a more '
        'accurate device.': verdict == 'FAIL' and result.noise.consistent,
        f'Measure more poses to decide on the tolerance, {SPREAD_OUT}.': verdict == 'UNDECIDED',
        sentence(bring(result)): used,
        'Then measure at least five new poses (calib_ros plan --iso9283) and judge the corrected '
        'arm: calib_ros verify; again after a collision or repair.': used and whole,
        'Then measure at least five new poses near these and judge the corrected arm: calib_ros '
        'verify; again after a collision or repair. To use it elsewhere, measure there too and '
        'identify again.': used and not whole,
    }
    return tuple(step for step, needed in found.items() if needed)


def _sections(problem: Problem, result: Identification, poses: Poses) -> Iterator[Section]:
    drift = result.accepted and words.drifts(result.noise)
    yield section(
        'noise',
        'Remaining errors against device noise',
        'If only the assumed noise of the measuring device remained, all dots would lie on the '
        'dotted line. A steeper line means more error, understated noise, or few poses.',
        f'Assumed: {_stated(problem, poses)} in each direction; a measurement with '
        'a covariance has its own.',
        figure=figures.against_noise(poses),
        said=(
            words.scatter_in_words(result.noise),
            *filter(None, (words.unmodelled_in_words(result),)),
            *(() if drift else (words.neighbours_in_words(result.noise),)),
            *map(words.chance_in_words, () if result.chance is None else (result.chance,)),
        ),
    )
    if poses.outlier.any():
        yield sections.outliers(poses)
    yield from _offsets(problem, result)
    yield _parameters(result)
    yield _correlations(result)
    yield _determined(result)
    yield sections.coverage(result.chain, poses.joints, 'How far each joint was moved')
    if result.verdicts:
        yield _effects(result)
    drives = figures.drives(result.chain, poses.joints)
    if drives is not None:
        yield section(
            'drives',
            'Drive errors',
            'What eccentricities and gears add to each joint value, over the measured values. '
            'Narrow stripes come from gears, wide ones from eccentricities.',
            figure=drives,
            height=100 + 45 * len(drives['data'][0]['y']),
        )
    if result.accepted:
        found = survey(Calibration.of(result), SURVEYED, np.random.default_rng(0))
        yield section(
            'map',
            'The error over the workspace',
            f'At {SURVEYED:,} random poses, by distance from the base axis and height above the '
            'base. More is expected to remain far from the measured poses.',
            figure=figures.error_map(found),
        )


def _stated(problem: Problem, poses: Poses) -> str:
    """Return the sigmas of what was measured, and which of them nobody stated."""
    found = {
        'sigma_position': (not poses.corner.all(), f'{1e3 * problem.sigma_position:g} mm'),
        'sigma_orientation': (poses.oriented, f'{1e3 * problem.sigma_orientation:.3g} mrad'),
        'sigma_pixel': (poses.corner.any(), f'{problem.sigma_pixel:g} px'),
    }
    return ', '.join(
        text + ' (default)' * (getattr(problem, name) == getattr(Settings, name))
        for name, (measured, text) in found.items()
        if measured
    )


def _effects(result: Identification) -> Section:
    rows = []
    for each in sorted(result.verdicts, key=lambda v: (not v.pays, -v.rms_mm_before)):
        percent = round(100.0 * (each.rms_mm_after / each.rms_mm_before - 1.0), 1)
        change = f'{percent:+.1f} %' if percent else '0.0 %'
        rows.append((each.what, change, 'yes' if each.pays else 'no'))
    return section(
        'effects',
        'Non-geometric errors',
        'How much each effect, added to those used above it, changes the RMS position error on '
        'held-out poses. Effects that help by more than chance are used.',
        f'The comparison uses up to {COMPARED:,} poses. The chosen model is fitted to all poses '
        'and does better; its error is at the top.',
        head=('effect', 'changes the error by', 'used'),
        rows=tuple(rows),
    )


def _offsets(problem: Problem, result: Identification) -> Iterator[Section]:
    others = dict(result.chain.effects)
    own = [p for p in result.parameters if p.name.unit in ('m', 'rad') and p.name not in others]
    own = [p for p in own if not result.chain.owns_frame(p.name)]
    for name, unit, limit in (
        ('lengths', 'mm', problem.largest_length),
        ('angles', 'mrad', problem.largest_angle),
    ):
        figure = figures.forest(own, unit == 'mm', limit)
        if figure is not None:
            yield section(
                name,
                f'{name.capitalize()} found',
                'Offsets from the nominal table with their 95 % intervals. If an interval '
                'contains zero, the nominal value may be right. Plausibility limit: '
                f'±{1e3 * limit:g} {unit}.',
                figure=figure,
                height=110 + 24 * len(figure['data'][0]['y']),
            )


def _parameters(result: Identification) -> Section:
    """Return the table of all parameters except the many gear harmonics."""
    rows = []
    listed = [p for p in result.parameters if group_of(p.name) != 'gear']
    unlisted = len(result.parameters) - len(listed)
    for p in listed:
        scale, small = p.name.small_unit
        unit = p.name.unit.removeprefix('1')  # a pure number has none
        placed = p.std is None or result.chain.owns_frame(p.name)
        found = (None if placed else p.offset, p.std, p.half_width())
        digits = max(4, len(rounded(scale * (p.std or 0.0)).partition('.')[2]))
        forms = zip(found, ('+', '', ''), strict=True)
        numbers = ['' if x is None else f'{scale * x:{sign}.{digits}f}' for x, sign in forms]
        rows.append((p.name, f'{p.value:.9f} {unit}'.rstrip(), *numbers, small, p.status))
    more = f'; the {unlisted} harmonics of gears are in result.json' if unlisted else ''
    return section(
        'parameters',
        'All parameters',
        'Kept nominal: status "gauge" (visible only together with other parameters), "not '
        'excited" (not determined by the poses) and "fixed" (held on request). Base and tool are '
        'fitted and have no offset.',
        f'{result.rank} are fitted{more}.',
        *words.priors_in_words(result),
        head=('parameter', 'value', 'offset', 'std', '± (95 %)', 'unit', 'status'),
        rows=tuple(rows),
    )


def _determined(result: Identification) -> Section:
    sigma, weak = words.sigma_over_range(result), ', '.join(words.weakly_determined(result))
    return section(
        'determined',
        'What the poses determine',
        'Expected error of positions predicted over the whole joint range: '
        f'{rounded(sigma["median"])} mm (median), {rounded(sigma["max"])} mm (largest), without '
        "what residuals hide: errors below half the device's noise, and its scale.",
        f'Observability indices: {words.observability_in_words(result)}; the larger, the better. '
        'From the singular values of the Jacobian, in stated sigmas per metre or radian: O1 is '
        'their geometric mean divided by the square root of the number of poses, O2 the smallest '
        'divided by the largest, O3 the smallest, O4 its square divided by the largest, O5 one '
        'divided by the sum of the inverses.',
        weak and f'Weakly determined (std above {1e3 * words.WEAK:g} mm or mrad): {weak}.',
        head=('kept nominal', 'cannot be told apart from') if result.gauges else (),
        rows=tuple(
            (name, ', '.join(some(partners)) or 'no measured pose depends on it')
            for name, partners in result.gauges.items()
        ),
    )


def _correlations(result: Identification) -> Section:
    strong = [f'{a} and {b} ({value:+.2f})' for a, b, value in result.correlated()]
    beyond = dict(result.chain.effects)
    shown = [k for k, name in enumerate(result.names) if name not in beyond]
    names, covariance = [result.names[k] for k in shown], result.covariance[np.ix_(shown, shown)]
    return section(
        'correlations',
        'Correlated parameters',
        'Strong colours mark parameters that change together: the poses determine their '
        'combination better than each alone. Predictions of the arm are not affected.',
        f'Strongest: {", ".join(some(strong))}.' if strong else 'None is above 0.9.',
        'Non-geometric effects are not drawn.' if beyond else '',
        figure=figures.correlations(names, covariance),
        height=max(360, 140 + 15 * len(shown)),
    )
