# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""An identification: made, shown in six rows with its reasons, and written into its files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from calib_ros.cli.given import page_of
from calib_ros.cli.screen import Screen
from calib_ros.files.loading import Loaded
from calib_ros.identification.calibration import Calibration
from calib_ros.identification.identification import Identification
from calib_ros.progress import share_of
from calib_ros.report import words
from calib_ros.report.advice import BRINGS
from calib_ros.report.page import Origin, markdown
from calib_ros.report.poses import poses_of
from calib_ros.report.reports import NOT_YET, identification_report, reasons_of, within_tolerance
from calib_ros.settings import Settings
from calib_ros.texts import dump_json

RESULT_FILES = (
    'calibration.yaml',
    'result.json',
    'report.html',
    'report.md',
    'residuals.csv',
    'before_after.png',
    'settings.yaml',
)


@dataclass(frozen=True, eq=False)
class Identified:
    """A result with its input and where that comes from."""

    loaded: Loaded
    result: Identification
    origin: Origin


def identified(loaded: Loaded, settings: Settings, screen: Screen, origin: Origin) -> Identified:
    """Identify with a sign of life."""
    with screen.work('identifying') as work:
        return Identified(loaded, loaded.identified(settings.model, work), origin)


def show(found: Identified, screen: Screen, tolerance: float | None = None) -> None:
    """Print a result: the verdict, six rows, and each reason or note once.

    `tolerance` is the wanted error [mm].
    """
    result = found.result
    if found.loaded.read:
        screen.say(found.loaded.read)
    if result.accepted:
        within = within_tolerance(result.validation or result.fitted, _in_metres(tolerance))
        title = 'accepted: the calibration makes the arm better'
        if within:
            title = f'accepted: the arm gets better, {within}'
        screen.title(title, None if 'not' in within else True)
    else:
        screen.title('NOT accepted, nothing is published: the robot stays as it was', False)
    screen.table(_rows(result))
    for each in reasons_of(result):
        screen.bullet(f'{each.heading}: {each.refusal}', each.steps or (each.meaning,))
    if result.accepted:
        for note in (*words.notes(result), NOT_YET):
            screen.bullet(note)
    elif (
        result.noise.position > 1.0
        and not result.noise.consistent
        and {each.rule for each in result.refusals}.isdisjoint(BRINGS)
    ):
        screen.bullet(words.scatter_in_words(result.noise))
    for line in words.cameras_in_words(result):
        screen.bullet(line)


def _in_metres(tolerance: float | None) -> float | None:
    return None if tolerance is None else 1e-3 * tolerance


def _rows(result: Identification) -> tuple[tuple[str, str], ...]:
    before, after = (result.validation or result.fitted).figures
    proof = '' if result.validation else '; on the poses fitted, which proves nothing'
    measured = words.measured(result)
    if result.outliers:
        measured += f', {len(result.outliers)} of them outliers without weight'
    fitted = f'{result.rank} parameters fitted'
    if result.chain.effects:
        fitted += f', {len(result.chain.effects)} of them effects'
    second = ('largest error', f'{before.max_mm:.3f} -> {after.max_mm:.3f} mm')
    if before.rms_mrad is not None and after.rms_mrad is not None:
        turn = f'RMS {before.rms_mrad:.3f} -> {after.rms_mrad:.3f} mrad'
        second = ('orientation error', turn)
    if before.rms_px is not None and after.rms_px is not None:
        second = ('corners', f'RMS {before.rms_px:.3f} -> {after.rms_px:.3f} px')
    valid = 'nowhere, because it is not accepted'
    if result.accepted and result.region is not None:
        valid = result.region.in_words().removeprefix('valid ')
    return (
        ('robot', f'{result.chain.name}, {fitted}'),
        ('fitted to', measured),
        ('position error', f'RMS {before.rms_mm:.3f} -> {after.rms_mm:.3f} mm{proof}'),
        second,
        ('judged by', result.validated_by),
        ('valid', valid),
    )


def document(found: Identified, tolerance: float | None) -> dict[str, Any]:
    """Return the content of result.json; `tolerance` is the wanted error [mm]."""
    content = words.as_document(found.result, found.loaded.samples)
    content |= {'warnings': list(found.loaded.warnings), 'tolerance_mm': tolerance}
    return content | {'origin': found.origin.document()}


def result_files(
    found: Identified, screen: Screen, out: Path, tolerance: float | None = None, pdf: bool = False
) -> dict[str, str | bytes]:
    """Return the files of a result by name; a chain only if it is accepted.

    A chain that was accepted earlier, in `out`, is kept under another name when this result is
    not: it does not belong to the files beside it any more. `tolerance` is the wanted error [mm].
    """
    from calib_ros.report.plots import before_after_png

    loaded, result = found.loaded, found.result
    with screen.work('writing the report') as work:
        work('residuals.csv, 1 of 3')
        poses = poses_of(loaded.problem, result, loaded.lines, loaded.images)
        contents: dict[str, str | bytes] = {
            'result.json': dump_json(document(found, tolerance)) + '\n',
            'residuals.csv': poses.table(share_of(work, 0.0, 1 / 3)),
            'settings.yaml': found.origin.settings,
        }
        work('before_after.png, 2 of 3')
        contents['before_after.png'] = before_after_png(result)
        work('report.html, 3 of 3')
        work(2 / 3)
        wanted = _in_metres(tolerance)
        report = identification_report(
            loaded.problem, result, poses, found.origin, found.loaded.warnings, wanted
        )
        contents['report.md'] = markdown(report, loaded.samples)
        contents |= page_of(report, screen, pdf=pdf)
    if result.accepted:
        kept = Calibration.of(result, owners=loaded.owners, fitted=loaded.problem.sets)
        contents['calibration.yaml'] = kept.dump()
        return contents
    return contents | set_aside(out)


def set_aside(out: Path) -> dict[str, bytes]:
    """Return the calibration that was accepted earlier, if any, under another name."""
    earlier = out / 'calibration.yaml'
    return {'calibration.previous.yaml': earlier.read_bytes()} if earlier.exists() else {}
