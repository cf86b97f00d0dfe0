# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The command line: `calib_ros identify | plan | workspace | simulate | csv2bag | demo`.

Exit status: 0 done, 1 the input cannot be used, 2 wrong usage, 3 the identification ran but its
result is not accepted.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

# Small matrices only: a second BLAS thread costs more than it gives, on a busy cell above all.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from calib_ros import __version__
from calib_ros.errors import CalibrationError, InputError

if TYPE_CHECKING:
    import numpy as np

    from calib_ros.chain import Chain
    from calib_ros.config import Settings
    from calib_ros.identification import Identification
    from calib_ros.se3 import FloatArray
    from calib_ros.workspace import CalibratedArm

NOT_ACCEPTED = 3
TASK_POSES = 300
"""Random poses at which a plan is to be accurate when no task is given."""
BOX_POSES = 30
"""Random poses that stand for a task given as a box of joint values."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    options = _parser().parse_args(arguments)
    try:
        status: int = options.run(options)
    except (CalibrationError, OSError) as err:
        print(f'calib_ros: {err}', file=sys.stderr)
        return 1
    return status


def _parser() -> argparse.ArgumentParser:
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
            formatter_class=argparse.ArgumentDefaultsHelpFormatter,
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
    identify.add_argument(
        '--socket-distance',
        type=float,
        metavar='M',
        help='between two sockets of a place, 0.05 if not given',
    )
    _add_chain(identify)
    identify.add_argument('--joint-topic', help='needed only with several JointState topics')
    identify.add_argument('--pose-topic', help='needed only with several pose topics')
    identify.add_argument('--out', type=Path, help='folder for calibration, result and report')
    identify.add_argument('--force', action='store_true', help='overwrite files in --out')
    identify.add_argument('--json', action='store_true', help='print the result as JSON')
    _add_settings(identify)

    plan = command('plan', _plan, 'choose the poses to measure, and say how accurate they make')
    _add_chain(plan)
    _add_plan(plan)

    workspace = command(
        'workspace',
        _workspace,
        'map errors over the workspace, and place a task where they are least',
    )
    workspace.add_argument(
        'result', type=Path, help='folder of identify --out, or a calibrated chain file alone'
    )
    _add_chain(workspace)
    _add_workspace(workspace)

    simulate = command(
        'simulate', _simulate, 'write the bag of a simulated robot cell, with the true chain'
    )
    simulate.add_argument('bag', type=Path, help='folder of the bag to write')
    _add_chain(simulate)
    _add_simulation(simulate)

    csv2bag = command('csv2bag', _csv2bag, 'write a table of measured poses as a bag')
    csv2bag.add_argument('csv', type=Path, help='the table')
    csv2bag.add_argument('bag', type=Path, help='folder of the bag to write')
    csv2bag.add_argument('--session', help='session of the table to use')
    _add_chain(csv2bag)
    _add_storage(csv2bag)

    demo = command(
        'demo', _demo, 'simulate an arm, identify it, and compare the result with the truth'
    )
    demo.add_argument('--out', type=Path, default=Path('demo'), help='folder for what it writes')
    demo.add_argument('--chain', default='ur10e', help='chain file, or a robot by its name')
    demo.add_argument('--force', action='store_true', help='overwrite an earlier demo')
    _add_simulation(demo)
    return parser


def _add_chain(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '--chain', required=True, help='chain file, or a robot by its name (ur10e, ...)'
    )


def _add_storage(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '--storage', choices=('mcap', 'sqlite3'), default='mcap', help='of the bag'
    )


def _add_simulation(parser: argparse.ArgumentParser) -> None:
    parser.add_argument('--poses', type=int, default=60, help='configurations to measure')
    parser.add_argument('--seed', type=int, default=0, help='of the random numbers')
    _add_storage(parser)


def _add_plan(parser: argparse.ArgumentParser) -> None:
    from calib_ros.planning import CRITERIA

    add = parser.add_argument
    add('--poses', type=int, metavar='N', help='how many; 25, or what --accuracy needs')
    add('--accuracy', type=float, metavar='MM', help='wanted RMS position error at the task poses')
    add('--criterion', choices=CRITERIA, default='d', help='determinant, index, or task error')
    add('--candidates', type=Path, metavar='FILE', help='CSV q1..qn of poses to choose from')
    add('--draw', type=int, default=2000, metavar='N', help='random candidates without a file')
    add('--task', type=Path, metavar='FILE', help='CSV q1..qn; random poses if not given')
    add('--taken', type=Path, metavar='FILE', help='CSV q1..qn of poses measured already')
    add('--measured', choices=('pose', 'position'), default='pose', help='at each pose')
    add('--apart', type=float, default=1e-3, help='least move of a joint between poses [rad, m]')
    add('--velocity', type=float, nargs='+', default=[1.0], help='of the joints [rad/s, m/s]')
    add('--box', type=float, nargs=6, metavar='M', help='measurable region: lower, upper corner')
    add('--tracker', type=float, nargs=3, metavar='M', help='where the device stands')
    add('--axis', type=float, nargs=3, default=[0.0, 0.0, 1.0], help='of the target, to face it')
    add('--cone', type=float, default=45.0, metavar='DEG', help='between axis and line of sight')
    add('--world', action='store_true', help='box and tracker are in the world, not in the base')
    add('--seed', type=int, default=0, help='of the random numbers')
    add('--out', type=Path, metavar='FILE', help='CSV q1..qn to write, in order of visit')
    add('--force', action='store_true', help='overwrite --out')
    _add_settings(parser, ('sigma_position', 'sigma_orientation', 'priors', 'model', 'fixed'))


def _add_workspace(parser: argparse.ArgumentParser) -> None:
    from calib_ros.workspace import AIMS, MODELS

    add = parser.add_argument
    add('--out', type=Path, required=True, help='folder for tables, words and figures')
    add('--poses', type=int, default=20_000, help='random poses of the survey')
    add('--task', type=Path, metavar='FILE', help='CSV x y z qx qy qz qw in the frame of a task')
    add('--joint-box', type=float, nargs='+', metavar='Q', help='task: lower, then upper values')
    add('--aim', choices=AIMS, default='mean', help='error over the poses of the task')
    add('--model', choices=MODELS, default='corrected', help='by which the arm is commanded')
    add('--region', type=float, nargs=6, metavar='M', help='for the task, lower, upper corner')
    add('--cells', type=int, default=9, help='placements along each axis')
    add('--turns', type=int, default=1, help='turns of the task about the vertical to try')
    add('--seed', type=int, default=0, help='of the random numbers')
    add('--force', action='store_true', help='overwrite files in --out')


def _add_settings(parser: argparse.ArgumentParser, names: Sequence[str] = ()) -> None:
    """Add options for the settings of some names, or for all."""
    from calib_ros.config import Settings

    for item in fields(Settings):
        if names and item.name not in names:
            continue
        many = isinstance(item.default, tuple)
        parser.add_argument(
            f'--{item.name.replace("_", "-")}',
            type=str if many else type(item.default),
            action='append' if many else 'store',
            default=[] if many else item.default,
            help=item.metadata['text'],
        )


def _identify(options: argparse.Namespace) -> int:
    from calib_ros import report
    from calib_ros.config import load_chain
    from calib_ros.problem import Problem
    from calib_ros.selection import identify_model

    if (options.bag is None) == (options.csv is None):
        raise InputError('give either a bag or --csv FILE')
    source = 'table' if options.csv else 'bag'
    useless = (
        ('joint_topic', 'pose_topic', 'joint_names')
        if options.csv
        else ('session', 'eye_in_hand', 'socket_distance')
    )
    for name in useless:
        if getattr(options, name):
            raise InputError(f'--{name.replace("_", "-")} is of no use with a {source}')
    chain = load_chain(options.chain)
    settings = _settings(options)
    _refuse_overwriting(options, RESULT_FILES)
    warnings: tuple[str, ...] = ()
    if options.csv is not None:
        from calib_ros.tables import read_table

        table = read_table(
            options.csv,
            len(chain.joints),
            _sessions(options),
            (settings.sigma_position, settings.sigma_orientation) if options.eye_in_hand else None,
        )
        sockets = 0.05 if options.socket_distance is None else options.socket_distance
        problem = Problem(
            chain,
            table.fitted[0],
            table.held_out,
            more=table.fitted[1:],
            separations=tuple((*pair, sockets) for pair in table.pairs),
            **settings.for_problem(),
        )
        result = identify_model(problem, settings.model)
        samples: dict[str, Any] = {
            'pairs': sum(map(len, table.fitted)),
            'held_out': sum(map(len, table.held_out)),
            'sets': len(table.fitted),
        }
    else:
        from calib_ros.replay import replay
        from calib_ros.session import CalibrationSession

        session = CalibrationSession(chain, settings)
        warnings = replay(options.bag, session, options.joint_topic, options.pose_topic)
        result = session.identify()
        samples = session.account().as_document()
    for warning in warnings:
        print(f'warning: {warning}', file=sys.stderr)
    _write_result(options.out, result, samples, warnings)
    if options.json:
        document = report.as_document(result, samples) | {'warnings': list(warnings)}
        print(json.dumps(document, indent=2))
    else:
        print(report.summary(result))
    return 0 if result.accepted else NOT_ACCEPTED


def _sessions(options: argparse.Namespace) -> tuple[str, ...]:
    return tuple(options.session.split(',')) if options.session else ()


def _settings(options: argparse.Namespace) -> Settings:
    """Return the settings that are among the options, the others by default."""
    from calib_ros.config import Settings

    given = {
        f.name: getattr(options, f.name) for f in fields(Settings) if hasattr(options, f.name)
    }
    for name in ('joint_names', 'fixed', 'priors'):
        if name in given:
            given[name] = tuple(part for text in given[name] for part in text.split(','))
    return Settings(**given)


def _plan(options: argparse.Namespace) -> int:
    import numpy as np

    from calib_ros import planning, report
    from calib_ros.config import load_chain
    from calib_ros.files import write_file
    from calib_ros.problem import Problem
    from calib_ros.simulation import measure
    from calib_ros.tables import joints_csv, read_joints

    _check_plan(options)
    chain = load_chain(options.chain)
    size = len(chain.joints)
    rng = np.random.default_rng(options.seed)
    imagined = measure(chain, np.zeros((1, size)), rng, oriented=options.measured == 'pose')
    design = planning.Design.of(Problem(chain, imagined, **_settings(options).for_problem()))
    visibility = planning.Visibility(
        None if options.box is None else np.reshape(options.box, (2, 3)),
        None if options.tracker is None else np.array(options.tracker),
        tuple(options.axis),
        np.radians(options.cone),
        options.world,
    )
    if options.taken is not None:
        design = design.after(read_joints(options.taken, size))
    task = chain.random_joints(TASK_POSES, rng)
    if options.task is not None:
        task = read_joints(options.task, size)
    if options.candidates is None:
        candidates = planning.draw_candidates(design, options.draw, rng, visibility)
    else:
        candidates = read_joints(options.candidates, size)
        candidates = candidates[visibility.sees(design, candidates)]
        if not len(candidates):
            raise InputError(f'the target can be measured at no pose of {options.candidates}')
    choice = {'criterion': options.criterion, 'apart': options.apart}
    needed = None
    if options.accuracy is not None:
        wanted = 1e-3 * options.accuracy
        needed = planning.poses_needed(design, candidates, task, wanted, **choice)
    if len(options.velocity) not in (1, size):
        raise InputError(f'--velocity: give one value, or {size}, not {len(options.velocity)}')
    velocities = np.broadcast_to(options.velocity, size)
    count = options.poses or needed or 25
    plan = planning.plan(design, candidates, task, count, **choice, velocities=velocities)
    print(report.plan_in_words(plan, len(candidates), options.accuracy, needed))
    if chain.tool is None:
        x, y, z = planning.ASSUMED_TOOL
        print(f'the tool is unknown: its target is taken to be at {x} {y} {z} m from the flange')
    if options.out is not None:
        write_file(options.out, joints_csv(plan.joints[plan.visit]), overwrite=options.force)
        print(f'wrote {options.out}')
    return 0


def _check_plan(options: argparse.Namespace) -> None:
    """Refuse options of `plan` that make no sense."""
    for name, lowest in (('poses', 1), ('draw', 1), ('seed', 0)):
        value = getattr(options, name)
        if value is not None and value < lowest:
            raise InputError(f'--{name} must be at least {lowest}, not {value}')
    if options.accuracy is not None and not options.accuracy > 0.0:
        raise InputError(f'--accuracy must be positive, not {options.accuracy}')
    if options.apart < 0.0 or not all(value > 0.0 for value in options.velocity):
        raise InputError('--apart must not be negative, and each --velocity must be positive')
    if options.out is not None and options.out.exists() and not options.force:
        raise InputError(f'{options.out} exists already: choose another name or --force')


def _workspace(options: argparse.Namespace) -> int:
    import numpy as np

    from calib_ros import plots, report, workspace
    from calib_ros.config import load_chain
    from calib_ros.files import write_file
    from calib_ros.tables import csv_of, joints_csv

    for name, lowest in (('poses', 100), ('cells', 1), ('turns', 1), ('seed', 0)):
        if getattr(options, name) < lowest:
            raise InputError(f'--{name} must be at least {lowest}, not {getattr(options, name)}')
    _refuse_overwriting(options, WORKSPACE_FILES + PLACEMENT_FILES)
    arm = workspace.CalibratedArm.read(options.result, load_chain(options.chain))
    rng = np.random.default_rng(options.seed)
    task = _task(options, arm, rng)
    survey = workspace.survey(arm, options.poses, rng)
    words = report.workspace_in_words(survey)
    contents: dict[str, str | bytes] = {
        'workspace.csv': csv_of(('x', 'y', 'z', 'error', 'sigma'), survey.cloud),
        'workspace.png': plots.workspace_png(survey),
    }
    if task is not None:
        region = None if options.region is None else np.reshape(options.region, (2, 3))
        found = workspace.place(
            arm, task, options.aim, options.model, region, options.cells, options.turns
        )
        words += '\n' + report.placements_in_words(found, options.aim, options.model)
        table = np.column_stack([found.positions, found.turns, found.errors])
        contents['placements.csv'] = csv_of(('x', 'y', 'z', 'turn', 'error'), table)
        contents['placements.png'] = plots.placements_png(found)
        contents['placed_task.csv'] = joints_csv(found.joints[found.best])
    options.out.mkdir(parents=True, exist_ok=True)
    for name, content in (contents | {'workspace.md': words}).items():
        write_file(options.out / name, content, overwrite=options.force)
    print(words, end='')
    return 0


def _task(
    options: argparse.Namespace, arm: CalibratedArm, rng: np.random.Generator
) -> FloatArray | None:
    """Return the poses (K, 4, 4) of the task to place, if there is one."""
    import numpy as np

    from calib_ros.tables import read_poses
    from calib_ros.workspace import in_base, task_of

    if options.task is not None and options.joint_box is not None:
        raise InputError('give either --task or --joint-box')
    if options.task is not None:
        return read_poses(options.task)
    if options.joint_box is None:
        return None
    size = len(arm.after.joints)
    if len(options.joint_box) != 2 * size:
        raise InputError(
            f'--joint-box: give {size} lower and {size} upper values, not '
            f'{len(options.joint_box)} in all'
        )
    lower, upper = np.reshape(options.joint_box, (2, size))
    joints = rng.uniform(lower, upper, (BOX_POSES, size))
    return task_of(in_base(arm.commanded_by(options.model), joints))


def _simulate(options: argparse.Namespace) -> int:
    from calib_ros.config import load_chain

    truth = _write_simulation(load_chain(options.chain), options)
    print(f'wrote {options.bag} and the true chain {truth}')
    return 0


def _csv2bag(options: argparse.Namespace) -> int:
    import numpy as np

    from calib_ros.config import load_chain
    from calib_ros.observations import Observations
    from calib_ros.replay import Recording, write_bag
    from calib_ros.tables import read_table

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


def _demo(options: argparse.Namespace) -> int:
    from calib_ros import report
    from calib_ros.config import Settings, load_chain
    from calib_ros.replay import replay
    from calib_ros.session import CalibrationSession

    _refuse_overwriting(options, RESULT_FILES)
    options.bag = options.out / 'bag'
    if options.force and options.bag.exists():
        import shutil

        shutil.rmtree(options.bag)
    chain = load_chain(options.chain)
    truth = _write_simulation(chain, options)
    print(f'1. simulated: {options.bag}, an arm with known errors ({truth.name})')
    session = CalibrationSession(chain, Settings())
    replay(options.bag, session)
    result = session.identify()
    print(f'2. replayed: {session.account()}')
    print(f'3. identified: {report.summary(result)}')
    print('4. identified offsets against the true ones [mm, mrad]:')
    print(report.against_truth(result, load_chain(truth)))
    _write_result(options.out, result, session.account().as_document(), ())
    print(f'5. wrote {options.out}/: {", ".join(RESULT_FILES)}')
    return 0 if result.accepted else NOT_ACCEPTED


def _write_simulation(chain: Chain, options: argparse.Namespace) -> Path:
    """Write the bag of a simulated cell, and the true chain beside it; return the latter."""
    import numpy as np

    from calib_ros.config import dump_chain
    from calib_ros.files import write_file
    from calib_ros.replay import Recording, write_bag
    from calib_ros.simulation import Cell, drive, faulty, measure

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
    options.bag.parent.mkdir(parents=True, exist_ok=True)
    write_bag(options.bag, recording, options.storage)
    path: Path = options.bag.parent / f'{options.bag.name}_truth.yaml'
    write_file(path, dump_chain(true), overwrite=True)
    return path


WORKSPACE_FILES = ('workspace.csv', 'workspace.md', 'workspace.png')
PLACEMENT_FILES = ('placements.csv', 'placements.png', 'placed_task.csv')
RESULT_FILES = ('calibration.yaml', 'result.json', 'report.md', 'before_after.png')


def _refuse_overwriting(options: argparse.Namespace, names: Sequence[str]) -> None:
    """Refuse before any work is done."""
    if options.out is None or options.force:
        return
    there = [name for name in names if (options.out / name).exists()]
    if there:
        raise InputError(
            f'{options.out} holds {", ".join(there)} already: choose another folder or --force'
        )


def _write_result(
    out: Path | None, result: Identification, samples: dict[str, Any], warnings: tuple[str, ...]
) -> None:
    """Write the files of a result; a chain only if it is accepted.

    Files of an earlier result are in the way only with --force; `_refuse_overwriting` has seen
    to it. A chain that was accepted earlier is kept under another name when this result is not.
    """
    if out is None:
        return
    from calib_ros import report
    from calib_ros.files import write_file
    from calib_ros.plots import before_after_png

    out.mkdir(parents=True, exist_ok=True)
    document = report.as_document(result, samples) | {'warnings': list(warnings)}
    contents: dict[str, str | bytes] = {
        'result.json': json.dumps(document, indent=2) + '\n',
        'report.md': report.markdown(result, samples, warnings),
        'before_after.png': before_after_png(result),
    }
    earlier = out / 'calibration.yaml'
    if result.accepted:
        contents['calibration.yaml'] = report.calibration_yaml(result)
    elif earlier.exists():  # it does not belong to the files beside it any more
        earlier.replace(out / 'calibration.previous.yaml')
    for name, content in contents.items():
        write_file(out / name, content, overwrite=True)


if __name__ == '__main__':
    sys.exit(main())
