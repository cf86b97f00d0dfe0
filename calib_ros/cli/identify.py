# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros identify`: a calibration from a bag, a table, or images."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from calib_ros.cli import checks, common, inputs
from calib_ros.cli.file_types import refuse_others
from calib_ros.cli.screen import GOOD_OR_BAD, Screen
from calib_ros.decision.comparison import Comparison
from calib_ros.decision.reasons import Reason, Rule
from calib_ros.decision.result import Identification
from calib_ros.errors import InputError
from calib_ros.estimation.visits import frames_of_sets
from calib_ros.files import boards, detections, image_places
from calib_ros.files.lenses import read_lens
from calib_ros.files.loading import Loaded, load_bag, load_table
from calib_ros.files.result_rows import result_row
from calib_ros.identification.age import refuse_older, years_since
from calib_ros.identification.calibration import Calibration, calibration_file
from calib_ros.identification.orientations import turns_left_out
from calib_ros.identification.recalibrated import Recalibration
from calib_ros.identification.recalibration import recalibrate
from calib_ros.kinematics.chain import Chain
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.progress import share_of
from calib_ros.report import documents, reports, update, words
from calib_ros.report.advice import BRINGS, FAR, UNSURE
from calib_ros.report.advised import advice_of
from calib_ros.report.content import Origin
from calib_ros.report.gathered import poses_of, poses_to_verify
from calib_ros.report.markdown import markdown
from calib_ros.report.refusals import Advice
from calib_ros.sampling.dataset import Dataset
from calib_ros.settings import refuse_larger
from calib_ros.shown import of_them, rounded
from calib_ros.texts import dump_json

PAGES = ('report.html', 'report.md', 'residuals.csv', 'before_after.png')
RESULT_FILES = ('calibration.yaml', 'result.json', 'settings.yaml', *PAGES)
REPORTS = (*PAGES, 'report.pdf')
TOUCH_SIGMA = {'upper': 1.0, 'text': 'standard deviation of heights over touched planes [m]'}
NOT_OF_UPDATES = ('history', 'tolerance', 'model', 'fixed', 'priors', 'folds')


def _run(options: argparse.Namespace, screen: Screen) -> int:
    checks.check_acceptance(options)
    if options.previous is not None:
        checks.refuse(options, NOT_OF_UPDATES, 'does not apply to --previous')
        return _recalibrated(options, screen)
    file = inputs.filer_of(options)
    with common.output_files(options, (*RESULT_FILES, 'report.pdf')) as contents:
        loaded = _loaded(options, screen)
        read = (options.csv, options.detections, options.measured)
        found = identified(options, screen, loaded, *read)
        if options.out is not None:
            contents |= result_files(found, options, screen)
    shown = () if found.result.accepted and not options.json else found.result.remarks
    for warning in (*found.loaded.warnings, *shown):
        screen.warn(warning)
    if options.json:
        screen.data(_document(found))
    else:
        show(found, screen)
        if options.out is None:
            made = 'the calibration and its report' if found.result.accepted else 'the report'
            screen.bullet(f'nothing was saved: --out FOLDER writes {made}')
        else:
            screen.say(common.written(options.out, contents))
    # last: a full disk there must not hide the result
    row, problem = partial(result_row, found.result, warnings=loaded.warnings), loaded.problem
    file(row, problem.chain, problem.all_sets, options.largest_loss)
    return 0 if found.result.accepted else common.Status.NOT_ACCEPTED


def _recalibrated(options: argparse.Namespace, screen: Screen) -> int:
    with common.output_files(options, ('calibration.yaml', 'result.json', *REPORTS)) as contents:
        loaded = _loaded(options, screen)
        if loaded.refusals:
            raise InputError('; '.join(loaded.refusals))
        checks.at_least(options, growth=0)
        previous = inputs.calibration_of(
            options.previous, 'identify --previous', loaded.problem.chain
        )
        serial = previous.serial_of(str(options.previous), options.serial)
        known = {'robot_serial': serial} if serial else {}
        previous = replace(previous, record={**previous.record, **known})
        problem = loaded.between(previous.frames_of(loaded.owners))
        left_out = turns_left_out(previous, problem.all_sets)
        loaded = replace(loaded, warnings=(*loaded.warnings, *left_out))
        for warning in loaded.warnings:
            screen.warn(warning)
        refuse_older(previous.record, problem.all_sets)
        years = years_since(previous.record, problem.all_sets)
        new = frames_of_sets(problem.all_sets, options.new_base, options.new_tool)
        with screen.work('looking for what has changed'):
            stated = [name for name in problem.sigmas if vars(options).get(name)]
            found = recalibrate(previous, problem, years, 1e-3 * options.growth, new, stated)
        figures = documents.figures_document(found.comparison)
        text = dump_json(found.document() | figures) + '\n'
        if options.out is not None:
            contents |= _update_files(found, loaded, options, screen) | {'result.json': text}
    if options.json:
        screen.data(text)
    else:
        _show_update(found, screen)
        if options.out is not None:
            stays = not found.accepted and 'calibration.yaml' in contents
            told = f'wrote {options.out / "result.json"}'
            screen.say(told if stays else common.written(options.out, contents))
    return 0 if found.accepted else common.Status.NOT_ACCEPTED


def _update_files(
    found: Recalibration, loaded: Loaded, options: argparse.Namespace, screen: Screen
) -> common.Contents:
    """Return the report of an update, and its calibration or that which stays, with its own."""
    contents: common.Contents = {'calibration.yaml': found.calibration.dump()}
    if not found.accepted:
        contents = {**_set_aside(options.out, options.previous)}
        if 'calibration.yaml' in contents:
            return contents
    read = (options.csv, options.detections, options.measured, calibration_file(options.previous))
    sets, arm = loaded.problem.all_sets, found.calibration.chain
    poses = poses_to_verify(arm, sets, found.comparison, loaded.by_line)
    serial = found.calibration.serial_of(str(options.previous))
    origin = inputs.origin_of(options, read, serial=serial)
    report = update.update_report(found, poses, origin, loaded.warnings)
    contents |= {'residuals.csv': poses.table(), 'report.md': markdown(report, {})}
    return contents | inputs.page_of(options, report, screen)


def _show_update(found: Recalibration, screen: Screen) -> None:
    state, changed, step = update.update_standing(found)
    screen.title(state.heading, found.accepted)
    screen.table(
        {
            'robot': found.calibration.chain.name,
            'new poses': f'{found.after.count}, each judged by the others',
            'position error': words.rms_change((found.before, found.after)),
            '95 % interval': _intervals(found.comparison),
            'arm known to': update.known_to(found, '->'),
        }
    )
    for why in state.text:
        screen.bullet(why, (step,))
    for each in (*changed, *[step] * found.accepted):
        screen.bullet(each)


def _intervals(judged: Comparison | None) -> str:
    """Return the intervals of the RMS errors; empty where they are not known."""
    likely = [words.rms_range_mm(judged, when) for when in (0, 1)]
    return f'RMS {" -> ".join(likely)} mm' if all(likely) else ''


def identified(
    options: argparse.Namespace, screen: Screen, loaded: Loaded, *read: Path | None
) -> Identified:
    """Identify what was loaded from the files that were read."""
    settings = common.settings_of(options)
    configuration = documents.configuration_yaml(options.chain, settings)
    origin = inputs.origin_of(options, read, settings=configuration)
    with screen.work('identifying') as work:
        result = loaded.identified(settings.model, work)
    return Identified(loaded, result, origin, vars(options).get('tolerance'))


def _loaded(options: argparse.Namespace, screen: Screen) -> Loaded:
    source = _source(options)
    posed = options.chain == image_places.POSED
    chain = image_places.posed_arm() if posed else load_chain(options.chain)
    refuse_larger('sigma_touch', options.sigma_touch or 0.0, TOUCH_SIGMA)
    if options.detections is not None:
        return _detected(options, chain, screen)
    if posed:
        raise InputError(f'--chain {image_places.POSED} needs --detections, with --places')
    if source == 'table':
        found = inputs.table_of(options, options.csv, chain, screen)
        return load_table(found, chain, common.settings_of(options), options.sigma_touch)
    bag = inputs.replayed_bag(options, options.measured, chain, screen)
    return load_bag(*bag, options.largest_loss)


def _source(options: argparse.Namespace) -> str:
    """Return 'bag' or 'table', with the table in `options.csv`, or the bag in `measured`."""
    if options.measured is not None and options.csv is None:
        bag = refuse_others(options.measured, 'identify', 'table', 'bag') == 'bag'
        if not bag:
            options.csv, options.measured = options.measured, None
    source = 'table' if options.csv or options.detections else 'bag'
    if (options.measured is None) == (source == 'bag'):
        raise InputError('give one input: a bag, or a table and/or --detections FILE')
    checks.refuse_ignored(options, source)
    return source


def _detected(options: argparse.Namespace, chain: Chain, screen: Screen) -> Loaded:
    for name in ('board', 'places'):
        if getattr(options, name) is None:
            raise InputError(f'--detections needs --{name}')
    board = boards.read_board(options.board)
    found = detections.read_detections(options.detections, board)
    places, posed, left_out = image_places.read_places(options.places, len(chain.joints))
    if posed != (chain.name == image_places.POSED):
        raise InputError(
            f'{options.places} holds {"poses of the flange" if posed else "joint values"}: '
            + (f'give --chain {image_places.POSED}' if posed else 'give the chain of the arm')
        )
    seen, notes = detections.observed(found, board, places, options.eye_in_hand)
    rows = Dataset((), by_line=True)
    if options.csv is not None:
        rows = inputs.table_of(options, options.csv, chain, screen)
        names = ('base_board', 'tool_camera') if seen.on_flange else ('base_camera', 'tool_board')
        seen = replace(seen, base=names[0], tool=names[1])
    known = chain.frame(seen.camera).lens if seen.camera in chain.frame_names else None
    fitted, lens = options.lens == 'fitted', known
    if options.intrinsics is not None:
        lens = read_lens(options.intrinsics, found, fitted)
    lenses = {} if lens is None else {seen.camera: replace(lens, fixed=not fitted)}
    warnings = (*left_out, *notes, *rows.warnings)
    rows = replace(rows, fitted=(seen, *rows.fitted), lenses=lenses, warnings=warnings)
    settings = common.settings_of(options)
    if posed:
        joints = (f'{name}.*' for name in chain.joint_names)
        settings = replace(settings, fixed=(*settings.fixed, *joints))
    loaded = load_table(rows, chain, settings, options.sigma_touch)
    reason = 'joint values are not known, so the arm was not fitted: only what follows'
    refusals = (Reason(Rule.POSED, reason),) if posed else ()
    samples = loaded.samples | {'images': len(found.names)}
    images = dict(zip(found.lines, found.names, strict=True)) if rows.by_line else {}
    return replace(loaded, samples=samples, images=images, refusals=refusals, instead=posed)


@dataclass(frozen=True, eq=False)
class Identified:
    """A result with its input and origin, and the wanted error [mm] if given."""

    loaded: Loaded
    result: Identification
    origin: Origin
    tolerance: float | None = None


def show(found: Identified, screen: Screen) -> None:
    """Print a result: the verdict, its figures, and each reason or note once."""
    result = found.result
    if found.loaded.read:
        screen.say(found.loaded.read)
    reasons = advice_of(found.loaded.problem, result)
    verdict = reports.result_standing(result, reasons, found.tolerance)
    screen.title(verdict.heading, GOOD_OR_BAD.get(verdict.state))
    screen.table(_rows(result))
    _explain(result, reasons, screen)
    for line in words.cameras_in_words(result):
        screen.bullet(line)


def _explain(result: Identification, reasons: Sequence[Advice], screen: Screen) -> None:
    if result.accepted:
        disturbed = words.disturbed_in_words(result.noise)
        closer = reports.CLOSER if reports.may_be_closer(result) else ''
        unchanged = f'{reports.NOT_YET}: {reports.bring(result)}'
        notes = *reports.doubts(result), disturbed, *words.notes(result), closer, unchanged
        for note in notes:
            if note:
                screen.bullet(note)
        return
    for each in reasons:
        if each.steps:
            screen.bullet(f'{each.heading}: {each.refusal}', each.steps)
    if not all(each.steps for each in reasons):
        screen.bullet('Other findings probably follow from it: the report of --out lists them')
        return
    explained = (BRINGS.keys() - UNSURE) & {each.rule for each in result.refusals}
    if not explained and 1.0 < result.noise.position < FAR and not result.noise.consistent:
        screen.bullet(words.scatter_in_words(result.noise))


def _rows(result: Identification) -> dict[str, str]:
    judged, effects = result.comparison, len(result.chain.effects)
    before, after = figures = judged.figures
    fitted, measured = f'{result.rank} parameters fitted', words.fitted_to(result)
    if effects:
        fitted += f', {of_them(effects, "effect")}'
    corners, turn = words.rms_change(figures, 'px'), words.rms_change(figures, 'mrad')
    largest = f'{rounded(before.max_mm)} -> {rounded(after.max_mm)} mm'
    valid = result.region.in_words() if result.accepted and result.region is not None else ''
    proof = '' if result.validation else '; on the poses fitted: no proof'
    return {
        'robot': f'{result.chain.name}, {fitted}',
        'fitted to': measured,
        'position error': f'{words.rms_change(figures)}{proof}',
        '95 % interval': _intervals(result.validation),
        'with outliers': words.rms_change(judged.figures_of_all) if judged.outliers else '',
        'corners': corners,
        'orientation error': '' if corners else turn,
        'largest error': '' if corners or turn else largest,
        'judged by': result.validated_by,
        'valid': valid.removeprefix('valid '),
    }


def _document(found: Identified) -> str:
    content = documents.as_document(found.result, found.loaded.samples)
    content |= {'warnings': list(found.loaded.warnings), 'tolerance_mm': found.tolerance}
    return dump_json(content | {'origin': found.origin.document()})


def result_files(
    found: Identified, options: argparse.Namespace, screen: Screen
) -> common.Contents:
    """Return the files of a result by name; a chain only if accepted.

    If this result is not, a chain accepted earlier in --out is renamed: it no longer belongs to
    the files beside it.
    """
    from calib_ros.report.plots import before_after_png

    loaded, result, origin = found.loaded, found.result, found.origin
    with screen.work('writing the report') as work:
        work('residuals.csv, 1 of 3')
        poses = poses_of(result, loaded.by_line, loaded.images)
        contents: common.Contents = {
            'result.json': _document(found) + '\n',
            'residuals.csv': poses.table(share_of(work, 0.0, 1 / 3)),
            'settings.yaml': origin.settings,
        }
        work('before_after.png, 2 of 3')
        contents['before_after.png'] = before_after_png(result)
        work('report.html, 3 of 3')
        work(2 / 3)
        report = reports.identification_report(loaded, result, origin, found.tolerance, poses)
        contents['report.md'] = markdown(report, loaded.samples)
        contents |= inputs.page_of(options, report, screen)
    if result.accepted:
        # the only device and target of a table may be any of a bag or node
        owners = loaded.owners if loaded.read or len(loaded.owners) > 2 else {}
        serial = {'robot_serial': origin.serial} if origin.serial else {}
        kept = Calibration.of(result, serial, owners, loaded.problem.sets)
        contents['calibration.yaml'] = kept.dump()
        return contents
    return contents | _set_aside(options.out)


def _set_aside(out: Path, previous: Path | None = None) -> dict[str, bytes]:
    """Return the calibration accepted earlier, if any, under another name.

    The `previous` one, which could not be brought up to date, stays with its reports.
    """
    earlier = out / 'calibration.yaml'
    if not earlier.exists():
        return {}
    if previous is None or not earlier.samefile(calibration_file(previous)):
        return {'calibration.previous.yaml': earlier.read_bytes()}
    kept = [out / name for name in REPORTS if (out / name).exists()]
    return {each.name: each.read_bytes() for each in (earlier, *kept)}
