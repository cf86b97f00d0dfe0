# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`calib_ros compare | compensate | export`; each imports only what it needs."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path

from calib_ros.atomic import write_file
from calib_ros.cli import checks, common
from calib_ros.cli.file_types import refuse_others
from calib_ros.cli.inputs import calibration_of
from calib_ros.cli.screen import Screen
from calib_ros.errors import InputError
from calib_ros.kinematics.chain_file import URDF_SUFFIXES, chain_text, load_chain
from calib_ros.settings import Limits
from calib_ros.shown import NAMED, rounded, some
from calib_ros.texts import dump_json


def _compare(options: argparse.Namespace, screen: Screen) -> int:
    from calib_ros.identification.difference import difference

    pair = [calibration_of(path, 'compare') for path in (options.first, options.second)]
    with screen.work('comparing'):
        found = difference(*pair)
    if options.json:
        screen.data(dump_json(found.document()))
    else:
        screen.title(found.in_words(), found.same)
        if not found.same:
            screen.say('with all parameters free, the most significant changes:')
            screen.table(dict(found.rows()))
    return 0 if found.same else common.Status.NOT_ACCEPTED


def _compensate(options: argparse.Namespace, screen: Screen) -> int:
    from calib_ros.apply.compensation import in_words, knowledge
    from calib_ros.apply.compensator import Compensator
    from calib_ros.apply.program import compensate_program
    from calib_ros.files.programs import program_of

    refuse_others(options.program, 'compensate', 'program', 'chain', 'table')
    checks.refuse_existing(options, options.out)
    if options.out.exists() and options.out.samefile(options.program):
        raise InputError(
            '--out would overwrite the program: keep it, since compensating it twice is wrong'
        )
    nominal = load_chain(options.chain)
    arm = calibration_of(options.calibration, 'compensate --calibration', nominal)
    limits = {item.name: vars(options).get(item.name, item.default) for item in fields(Limits)}
    compensator = Compensator(nominal, arm.chain, tuple(options.tool), **limits, region=arm.region)
    with screen.work(f'correcting {options.program.name}') as work:
        source = program_of(options.program, nominal)
        corrected, result = compensate_program(compensator, source.program, work)
    if result.refusals:
        refused = 'nothing is written, because not every point can be corrected'
        screen.warn(f'{refused}: {in_words(compensator, result)}', 'calib_ros')
        for refusal in result.refusals[:NAMED]:
            screen.warn(refusal.reason, source.places[refusal.sample])
        if more := result.refusals[NAMED:]:
            screen.warn(f'and {len(more)} more, up to {source.places[more[-1].sample]}', 'refused')
        return common.Status.NOT_ACCEPTED
    text = source.text_with(corrected).encode(source.coding)
    write_file(options.out, text, overwrite=options.force)
    screen.say(f'wrote {options.out}: {in_words(compensator, result)}')
    screen.say(f'by {arm.whose}')
    words, warning = knowledge(arm, result)
    if words:
        screen.say(words)
    if warning:
        screen.warn(warning)
    return 0


def _export(options: argparse.Namespace, screen: Screen) -> int:
    from calib_ros.files.export import CORRECTED_URDF, FILES, exports, urdf_export
    from calib_ros.files.programs import read_joints
    from calib_ros.files.vendor_files import vendor_files
    from calib_ros.files.vendors import UR, VENDOR_FILES

    nominal = load_chain(options.chain)
    calibration = calibration_of(options.calibration, 'export', nominal)
    chain, origin = calibration.chain, calibration.record
    measured = None if options.measured is None else read_joints(options.measured, chain)
    found = exports(chain, nominal, measured, origin)
    links = {'base_link': options.base_link, 'tip_link': options.tip_link}
    urdf = ''
    if options.urdf is not None:
        urdf = chain_text(options.urdf)
        name = f'{options.urdf.stem}{CORRECTED_URDF}'
        found = (*found, urdf_export(name, urdf, chain, links))
    elif Path(options.chain).suffix.lower() in URDF_SUFFIXES:
        urdf = chain_text(Path(options.chain))
    found += vendor_files(chain, nominal, origin, urdf, links, options.ur_hash)
    if options.ur_hash and all(each.name != UR.file for each in found):
        raise InputError(f'--ur-hash does not apply to {chain.name}: it gets no {UR.file}')
    with common.output_files(options, (*FILES, *VENDOR_FILES, f'*{CORRECTED_URDF}')) as contents:
        contents |= {each.name: each.content for each in found}
    for each in found:
        off = f'up to {rounded(1e3 * each.error)} mm off{each.elsewhere}'
        beyond = f' with what its first line says, {each.beyond}' if each.beyond else ''
        screen.say(f'{options.out / each.name}: {off if each.error else "exact"}{beyond}')
    known = dict(nominal.effects)
    if lost := [name for name, value in chain.effects if value != known.get(name, 0.0)]:
        held = ' --fixed "*.coupling_*"' if any('.coupling_' in name for name in known) else ''
        screen.warn(
            f'tables cannot hold the fitted effects {", ".join(some(lost))}; for the best table '
            f'without them, identify with --model geometric{held}'
        )
    if calibration.region is not None and not calibration.region.whole:
        screen.warn(f'the calibration is {calibration.region.in_words()}')
    return 0
