# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The command line: `calib_ros plan | identify | workspace | compensate | verify | ...`.

Exit status: 0 done, 1 the input cannot be used, 2 wrong usage, 3 the identification ran but its
result is not accepted, a program has samples that cannot be compensated, or a corrected arm does
not pass.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

# Small matrices only: a second BLAS thread costs more than it gives, on a busy cell above all.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from calib_ros import __version__
from calib_ros.cli.camera import DETECTIONS, add_camera_commands, add_detections, detected
from calib_ros.cli.commands import add_commands
from calib_ros.cli.options import (
    NOT_ACCEPTED,
    add_chain,
    add_identity,
    add_layout,
    add_pdf,
    add_settings,
    foreign_of,
    origin_of,
    page_of,
    paper_of,
    results,
    settings_of,
)
from calib_ros.errors import CalibrationError, InputError, shortened

LAYOUT = (
    *('preset', 'columns', 'length', 'angle', 'joint_angle', 'euler', 'quaternion'),
    *('rotation_vector', 'inverse', 'shift', 'separator', 'decimal', 'sheet', 'joints'),
)
"""Options of tables of others."""
LARGEST_LOSS = 0.1
"""Share of the messages of a bag that may be lost. As many fewer samples at random make standard
deviations 5 % larger, less than their own uncertainty; more may be a part of the workspace."""

if TYPE_CHECKING:
    from calib_ros.identification.identification import Identification
    from calib_ros.identification.problem import Problem
    from calib_ros.kinematics.chain import Chain
    from calib_ros.report.page import Origin


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    given = sys.argv[1:] if arguments is None else arguments
    options = _parser(given).parse_args(given)
    try:
        status: int = options.run(options)
    except (CalibrationError, OSError) as err:
        print(f'calib_ros: {shortened(str(err))}', file=sys.stderr)
        return 1
    return status


class _Help(argparse.ArgumentDefaultsHelpFormatter):
    """Help that tells a default where there is one."""

    def _get_help_string(self, action: argparse.Action) -> str | None:
        given = action.default not in (None, '', False, (), [])
        return super()._get_help_string(action) if given else action.help


def _parser(given: Sequence[str]) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='calib_ros', description='Kinematic calibration of industrial arms.'
    )
    parser.add_argument('--version', action='version', version=f'calib_ros {__version__}')
    commands = parser.add_subparsers(required=True, metavar='COMMAND')

    def command(name: str, run: Callable[[Any], int], text: str) -> argparse.ArgumentParser:
        added = commands.add_parser(
            name,
            help=text,
            description=text,
            formatter_class=_Help,
        )
        added.set_defaults(run=run)
        return added

    identify = command(
        'identify', _identify, 'identify DH parameters from a bag or a table of measured poses'
    )
    identify.add_argument('bag', nargs='?', type=Path, help='rosbag2 folder, .mcap or .db3 file')
    identify.add_argument('--csv', type=Path, help='table of measured poses instead of a bag')
    identify.add_argument('--session', help='session of the table; several joined by commas')
    identify.add_argument(
        '--eye-in-hand',
        action='store_true',
        help='the poses are those of a fixed target in a camera on the flange',
    )
    add_detections(identify)
    identify.add_argument(
        '--largest-loss',
        type=float,
        default=LARGEST_LOSS,
        metavar='SHARE',
        help='of the messages of a bag, beyond which the result is not accepted; 1: any',
    )
    identify.add_argument(
        '--socket-distance',
        type=float,
        metavar='M',
        help='between two sockets of a place, 0.05 if not given',
    )
    add_chain(identify)
    identify.add_argument('--out', type=Path, help='folder for calibration, result and report')
    identify.add_argument('--force', action='store_true', help='replace the result in --out')
    identify.add_argument('--json', action='store_true', help='print the result as JSON')
    identify.add_argument(
        '--tolerance', type=float, metavar='MM', help='wanted RMS position error, for the report'
    )
    add_identity(identify)
    add_pdf(identify)
    add_layout(identify)
    if 'identify' in given:  # they know numpy, which takes longer than all the rest
        add_settings(identify)

    simulate = command(
        'simulate', _simulate, 'write the bag of a simulated robot cell, with the true chain'
    )
    simulate.add_argument('bag', type=Path, help='folder of the bag to write')
    add_chain(simulate)
    _add_simulation(simulate)

    convert = command('import', _import, 'write a table of others as one of ours')
    convert.add_argument('table', type=Path, help='CSV, text in columns, or .xlsx')
    convert.add_argument('--chain', help='chain file, URDF or robot: names and kinds of joints')
    convert.add_argument('--out', type=Path, required=True, help='CSV to write')
    convert.add_argument('--force', action='store_true', help='overwrite --out')
    add_layout(convert)

    csv2bag = command('csv2bag', _csv2bag, 'write a table of measured poses as a bag')
    csv2bag.add_argument('csv', type=Path, help='the table')
    csv2bag.add_argument('bag', type=Path, help='folder of the bag to write')
    csv2bag.add_argument('--session', help='session of the table to use')
    add_chain(csv2bag)
    _add_storage(csv2bag)

    export = command(
        'export', _export, 'write a calibration in the forms that controllers and others read'
    )
    export.add_argument('calibration', type=Path, help='calibration.yaml of an identification')
    add_chain(export)
    export.add_argument(
        '--measured',
        type=Path,
        help='table with q1 ... qn where tables that cannot be exact are to be best; if not '
        'given, the whole joint range',
    )
    export.add_argument('--urdf', type=Path, help='nominal URDF of the robot, to correct as well')
    export.add_argument('--base-link', help='of the URDF: where the arm starts')
    export.add_argument('--tip-link', help='of the URDF: where the arm ends')
    export.add_argument(
        '--ur-hash',
        default='',
        metavar='calib_...',
        help='checksum that the driver of Universal Robots prints at its start, for '
        'ur_kinematics.yaml',
    )
    export.add_argument('--out', type=Path, required=True, help='folder to write')
    export.add_argument('--force', action='store_true', help='replace the result in --out')

    add_commands(command, given)
    add_camera_commands(command)

    chain = command('chain', _chain, 'print the chain file of a robot, to read and to edit')
    chain.add_argument('robot', help='URDF, chain file, or a robot by its name (ur10e, ...)')
    chain.add_argument('--base-link', help='of a URDF: where the arm starts, else its root')
    chain.add_argument('--tip-link', help='of a URDF: where the arm ends, such as tool0')
    chain.add_argument('--convention', help='of the table from a URDF: standard or modified')
    chain.add_argument('--out', type=Path, help='file to write instead')

    demo = command(
        'demo', _demo, 'simulate an arm, identify it, and compare the result with the truth'
    )
    demo.add_argument('--out', type=Path, default=Path('demo'), help='folder for what it writes')
    demo.add_argument('--chain', default='ur10e', help='chain file, URDF, or a robot by its name')
    demo.add_argument('--force', action='store_true', help='replace an earlier demo')
    _add_simulation(demo)
    return parser


def _add_storage(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '--storage', choices=('mcap', 'sqlite3'), default='mcap', help='of the bag'
    )


def _add_simulation(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--poses', type=int, default=60, help='configurations to measure')
    parser.add_argument('--seed', type=int, default=0, help='of the random numbers')
    _add_storage(parser)


def _identify(options: argparse.Namespace) -> int:
    from calib_ros.report import words

    if options.tolerance is not None and not 0.0 < options.tolerance < math.inf:
        raise InputError(f'--tolerance must be positive, not {options.tolerance}')
    if options.out is None:
        found = _identified(options)
    else:
        with results(options, (*RESULT_FILES, 'report.pdf')) as folder:
            found = _identified(options)
            _write_result(folder, options.out, found, options.tolerance, options.pdf)
    result = found.result
    for warning in (*found.warnings, *result.remarks):
        print(f'warning: {warning}', file=sys.stderr)
    if options.json:
        print(json.dumps(_document(found, options.tolerance), indent=2))
    else:
        if found.read:
            print(found.read)
        print(words.summary(result))
        for line in words.cameras_in_words(result):
            print(line)
    return 0 if result.accepted else NOT_ACCEPTED


class _Identified(NamedTuple):
    """A result with its problem, and what became of the input.

    `read` says in words what was read; `lines` tells that stamps are the lines of a table.
    """

    problem: Problem
    result: Identification
    samples: dict[str, Any]
    warnings: tuple[str, ...]
    origin: Origin
    read: str = ''
    lines: bool = False


def _identified(options: argparse.Namespace) -> _Identified:
    """Return what there is to identify in a table or a bag."""
    from calib_ros.files.boards import POSED, posed_arm
    from calib_ros.identification.model_choice import identify_model
    from calib_ros.identification.problem import Problem
    from calib_ros.kinematics.chain_file import load_chain
    from calib_ros.report import words

    tables = options.csv or options.detections
    if (options.bag is None) == (tables is None):
        raise InputError('give either a bag or --csv FILE, --detections FILE or both of these')
    source = 'table' if tables else 'bag'
    useless = (
        ('joint_topics', 'sources', 'joint_names', 'frame_id')
        if tables
        else ('session', 'eye_in_hand', 'socket_distance', *LAYOUT, *DETECTIONS)
    )
    for name in useless:
        if getattr(options, name):
            raise InputError(f'--{name.replace("_", "-")} is of no use with a {source}')
    chain = posed_arm() if options.chain == POSED else load_chain(options.chain)
    settings = settings_of(options)
    if not 0.0 <= options.largest_loss <= 1.0:
        raise InputError(f'--largest-loss must be from 0 to 1, not {options.largest_loss}')
    warnings: tuple[str, ...] = ()
    samples: dict[str, Any] = {}
    read, lines = '', False
    if options.detections is not None:
        problem, result, samples, warnings = detected(options, chain, settings)
    elif options.csv is not None:
        from calib_ros.files.tables import read_table

        table = read_table(
            options.csv,
            len(chain.joints),
            _sessions(options),
            (settings.sigma_position, settings.sigma_orientation),
            options.eye_in_hand,
            foreign_of(options, chain),
        )
        warnings, lines = table.warnings, table.by_line
        sockets = 0.05 if options.socket_distance is None else options.socket_distance
        problem = Problem(
            chain,
            table.fitted[0],
            table.held_out,
            more=table.fitted[1:],
            separations=tuple((*pair, sockets) for pair in table.pairs),
            world_frame=table.world_frame,
            **settings.for_problem(),
        )
        result = identify_model(problem, settings.model)
        samples = {
            'samples': sum(map(len, table.fitted)),
            'held_out': sum(map(len, table.held_out)),
            'sets': len(table.fitted),
        }
    else:
        from calib_ros.files.bags import replay
        from calib_ros.sampling.session import CalibrationSession

        session = CalibrationSession(chain, settings)
        replayed = replay(options.bag, session)
        warnings = replayed.warnings
        result = session.identify()
        problem = session.problem_of(session.usable)
        account = session.account()
        read = f'{replayed}; {account}'
        counts = {'recorded': replayed.recorded, 'read': replayed.read}
        samples = counts | account.as_document()
        lost = replayed.refusals(account, options.largest_loss)
        result = replace(result, refusals=(*result.refusals, *lost))
    configuration = words.configuration_yaml(options.chain, settings)
    origin = origin_of(options, (options.csv, options.detections, options.bag), configuration)
    return _Identified(problem, result, samples, warnings, origin, read, lines)


def _sessions(options: argparse.Namespace) -> tuple[str, ...]:
    return tuple(options.session.split(',')) if options.session else ()


def _simulate(options: argparse.Namespace) -> int:
    from calib_ros.kinematics.chain_file import load_chain

    truth = _write_simulation(load_chain(options.chain), options, options.bag)
    print(f'wrote {options.bag} and the true chain {truth}')
    return 0


def _import(options: argparse.Namespace) -> int:
    from calib_ros.atomic import write_file
    from calib_ros.files.foreign import Foreign, as_csv
    from calib_ros.files.layouts import Layout
    from calib_ros.files.tables import table_of
    from calib_ros.kinematics.chain_file import load_chain

    if options.out.exists() and not options.force:
        raise InputError(f'{options.out} exists already: choose another name or --force')
    chain = None if options.chain is None else load_chain(options.chain)
    foreign = foreign_of(options, chain) or Foreign(Layout(), chain)
    columns, notes = foreign.convert(options.table)
    for note in notes:
        print(f'note: {note}', file=sys.stderr)
    table_of(columns, options.table)  # refuses what no table of ours may hold
    text = as_csv(columns)
    write_file(options.out, text, overwrite=options.force)
    print(f'wrote {options.out}: {len(columns.lines)} rows of {text.partition(chr(10))[0]}')
    return 0


def _csv2bag(options: argparse.Namespace) -> int:
    import numpy as np

    from calib_ros.files.bags import Recording, write_bag
    from calib_ros.files.tables import read_table
    from calib_ros.identification.observations import Observations
    from calib_ros.kinematics.chain_file import load_chain

    chain = load_chain(options.chain)
    table = read_table(options.csv, len(chain.joints), _sessions(options))
    if len(table.fitted) != 1 or table.fitted[0].distances is not None or table.pairs:
        raise InputError('a bag holds poses or positions of one session and one target')
    (fitted,) = table.fitted
    held_out = table.held_out[0] if table.held_out else fitted.select(np.zeros(0, int))
    oriented = bool(fitted.oriented.any() or held_out.oriented.any())
    rows = Observations.from_arrays(
        np.concatenate([fitted.joints, held_out.joints]),
        np.concatenate([fitted.positions, held_out.positions]),
        np.concatenate([fitted.rotations, held_out.rotations]) if oriented else None,
    )
    judging = np.arange(len(rows)) >= len(fitted)
    write_bag(options.bag, Recording.of_dwells(chain.joint_names, rows, judging), options.storage)
    print(f'wrote {options.bag}: {len(fitted)} poses to fit, {len(held_out)} held out')
    return 0


def _export(options: argparse.Namespace) -> int:
    from calib_ros.atomic import write_files
    from calib_ros.files.export import CORRECTED_URDF, FILES, Export, exports, urdf_foot
    from calib_ros.files.vendors import VENDOR_FILES, vendor_files
    from calib_ros.files.waypoints import read_joints
    from calib_ros.kinematics.chain_file import (
        URDF_SUFFIXES,
        load_chain,
        parse_calibration,
        read_text,
    )
    from calib_ros.kinematics.urdf import corrected_urdf

    nominal, path = load_chain(options.chain), options.calibration
    chain, origin = parse_calibration(read_text(path), str(path), nominal)
    measured = None
    if options.measured is not None:
        measured = read_joints(options.measured, chain)
    found = exports(chain, nominal, measured, origin)
    links = {'base_link': options.base_link, 'tip_link': options.tip_link}
    urdf = ''
    if options.urdf is not None:
        urdf = read_text(options.urdf)
        text = corrected_urdf(urdf, chain, **links) + urdf_foot(chain)
        found = (*found, Export(f'{options.urdf.stem}{CORRECTED_URDF}', text, 0.0))
    elif Path(options.chain).suffix in URDF_SUFFIXES:
        urdf = read_text(Path(options.chain))
    found += vendor_files(chain, nominal, origin, urdf, links, options.ur_hash)
    with results(options, (*FILES, *VENDOR_FILES, f'*{CORRECTED_URDF}')) as folder:
        write_files(folder, {each.name: each.content for each in found})
    for each in found:
        exact = 'exact' if each.error == 0.0 else f'up to {1e3 * each.error:.3f} mm off'
        print(f'{options.out / each.name}: {exact}')
    return 0


def _chain(options: argparse.Namespace) -> int:
    from dataclasses import replace

    from calib_ros.atomic import write_file
    from calib_ros.kinematics.chain_file import (
        URDF_SUFFIXES,
        chain_document,
        dump_chain,
        load_chain,
        read_urdf,
    )

    names = ('base_link', 'tip_link', 'convention')
    given = {name: getattr(options, name) for name in names if getattr(options, name)}
    path = Path(options.robot)
    if path.suffix in URDF_SUFFIXES:
        chain = read_urdf(path, **given)
        frames = chain_document(chain)
        text = dump_chain(replace(chain, base=None, tool=None))
        text += '# Known in the URDF: take a line in where the device measures in the base link,\n'
        text += '# or the tip link itself. Without it that frame is found from the poses.\n'
        for key in ('base', 'tool'):
            text += f'# {key}: {json.dumps(frames[key] | {"fixed": True})}\n'
    elif given:
        raise InputError(f'--{next(iter(given)).replace("_", "-")} is of use with a URDF only')
    else:
        text = dump_chain(load_chain(options.robot))
    if options.out is None:
        print(text, end='')
    else:
        write_file(options.out, text)
    return 0


def _demo(options: argparse.Namespace) -> int:
    from calib_ros.files.bags import replay
    from calib_ros.kinematics.chain_file import load_chain
    from calib_ros.report import words
    from calib_ros.report.page import Origin, inputs_of
    from calib_ros.sampling.session import CalibrationSession
    from calib_ros.settings import Settings

    chain = load_chain(options.chain)
    own = (*RESULT_FILES, 'bag_truth.yaml', 'bag/bag.*', 'bag/metadata.yaml')
    with results(options, own) as folder:
        folder.mkdir()
        bag = folder / 'bag'
        truth = _write_simulation(chain, options, bag)
        session = CalibrationSession(chain, Settings())
        replay(bag, session)
        result = session.identify()
        configuration = words.configuration_yaml(options.chain, session.settings)
        found = _Identified(
            session.problem_of(session.usable),
            result,
            session.account().as_document(),
            (),
            Origin(inputs_of([bag]), settings=configuration),
        )
        _write_result(folder, options.out, found)
        against = words.against_truth(result, load_chain(truth))
    print(f'1. simulated: {options.out / "bag"}, an arm with known errors ({truth.name})')
    print(f'2. replayed: {session.account()}')
    print(f'3. identified: {words.summary(result)}')
    print('4. identified offsets against the true ones [mm, mrad]:')
    print(against)
    print(f'5. wrote {options.out}/: {", ".join(RESULT_FILES)}')
    return 0 if result.accepted else NOT_ACCEPTED


def _write_simulation(chain: Chain, options: argparse.Namespace, bag: Path) -> Path:
    """Write the bag of a simulated cell, and the true chain beside it; return the latter."""
    import numpy as np

    from calib_ros.apply.simulation import Cell, drive, faulty, measure
    from calib_ros.files.bags import Recording, write_bag
    from calib_ros.kinematics.chain_file import dump_chain

    if options.poses < 1 or options.seed < 0:
        raise InputError(
            f'--poses must be at least 1 and --seed at least 0, not {options.poses} and '
            f'{options.seed}'
        )
    rng, cell = np.random.default_rng(options.seed), Cell()
    true = faulty(chain, cell, rng)
    configurations = chain.random_joints(options.poses, rng)
    joint_stamps, joints, pose_stamps = drive(configurations, cell, 1_700_000_000_000_000_000)
    standing = np.repeat(configurations, cell.poses_per_dwell, axis=0)
    poses = measure(true, standing, rng, cell.noise_position, cell.noise_orientation)
    recording = Recording(
        chain.joint_names, joint_stamps, joints, poses.at(pose_stamps), np.zeros(len(poses), bool)
    )
    truth = bag.with_name(f'{bag.name}_truth.yaml')
    write_bag(bag, recording, options.storage, {truth: dump_chain(true, {'source': 'simulation'})})
    return truth


RESULT_FILES = (
    'calibration.yaml',
    'result.json',
    'report.html',
    'report.md',
    'residuals.csv',
    'before_after.png',
    'settings.yaml',
)


def _document(found: _Identified, tolerance: float | None) -> dict[str, Any]:
    """Return the content of result.json; `tolerance` is the wanted error [mm]."""
    from calib_ros.report import words

    document = words.as_document(found.result, found.samples)
    document |= {'warnings': list(found.warnings), 'tolerance_mm': tolerance}
    return document | {'origin': found.origin.document()}


def _write_result(
    folder: Path,
    out: Path,
    found: _Identified,
    tolerance: float | None = None,
    pdf: bool = False,
) -> None:
    """Write the files of a result; a chain only if it is accepted.

    A chain that was accepted earlier, in `out`, is kept under another name when this result is
    not: it does not belong to the files beside it any more. `tolerance` is the wanted error [mm].
    """
    from calib_ros.atomic import write_files
    from calib_ros.report import words
    from calib_ros.report.markdown import markdown
    from calib_ros.report.plots import before_after_png
    from calib_ros.report.poses import poses_of
    from calib_ros.report.reports import identification_report

    problem, result, samples, warnings, origin, _, lines = found
    document = _document(found, tolerance)
    poses = poses_of(problem, result, lines)
    contents: dict[str, str | bytes] = {
        'result.json': json.dumps(document, indent=2) + '\n',
        'report.md': markdown(result, samples, warnings),
        'residuals.csv': poses.table(),
        'before_after.png': before_after_png(result),
        'settings.yaml': origin.settings,
    }
    wanted = None if tolerance is None else 1e-3 * tolerance
    report = identification_report(problem, result, poses, origin, warnings, wanted)
    contents |= {**page_of(report), **paper_of(report, pdf)}
    earlier = out / 'calibration.yaml'
    if result.accepted:
        contents['calibration.yaml'] = words.calibration_yaml(result)
    elif earlier.exists():
        contents['calibration.previous.yaml'] = earlier.read_bytes()
    write_files(folder, contents)


if __name__ == '__main__':
    sys.exit(main())
