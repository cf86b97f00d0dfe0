# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The commands before and after an identification: `plan | workspace | compensate |
verify`.

They are added to those of `cli.py`, which says what the exit status means.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

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
from calib_ros.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from calib_ros.apply.candidates import Visibility
    from calib_ros.apply.design import Design
    from calib_ros.apply.planning import Plan
    from calib_ros.apply.workspace import CalibratedArm
    from calib_ros.kinematics.se3 import FloatArray

WORKSPACE_FILES = ('workspace.csv', 'workspace.md', 'workspace.png', 'report.html')
VERIFICATION_FILES = ('report.html', 'report.pdf', 'residuals.csv', 'verification.txt')
PLACEMENT_FILES = ('placements.csv', 'placements.png', 'placed_task.csv')
TASK_POSES = 300
"""Random poses at which a plan is to be accurate when no task is given."""
BOX_POSES = 30
"""Random poses that stand for a task given as a box of joint values."""
Command: TypeAlias = Callable[[str, Callable[[Any], int], str], argparse.ArgumentParser]


def add_commands(command: Command, given: Sequence[str]) -> None:
    """Add all commands of this module by a function of name, what to run, and help.

    Options only to the one that is `given`: they know modules that take longer than all the rest.
    """
    for name, run, add, text in (
        ('plan', _plan, _add_plan, 'choose the poses to measure, and say how accurate they make'),
        (
            'workspace',
            _workspace,
            _add_workspace,
            'map errors over the workspace, and place a task where they are least',
        ),
        (
            'verify',
            _verify,
            _add_verify,
            'judge a calibrated arm on new measurements: its errors, PASS or FAIL',
        ),
        (
            'compensate',
            _compensate,
            _add_compensate,
            'correct the joint values of a program by a calibration',
        ),
    ):
        added = command(name, run, text)
        if name in given:
            add(added)


def _add_plan(parser: argparse.ArgumentParser) -> None:
    from calib_ros.apply.choice import CRITERIA

    add_chain(parser)
    add = parser.add_argument
    add('--poses', type=int, metavar='N', help='how many; 25, or what --accuracy needs')
    add('--iso9283', action='store_true', help='the five test poses of ISO 9283 instead')
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
    add('--out', type=Path, metavar='FILE', help='CSV q1..qn to write, and its report beside it')
    add('--force', action='store_true', help='overwrite --out')
    add_identity(parser)
    add_settings(parser, ('sigma_position', 'sigma_orientation', 'priors', 'model', 'fixed'))


def _add_workspace(parser: argparse.ArgumentParser) -> None:
    from calib_ros.apply.placement import AIMS
    from calib_ros.apply.workspace import MODELS

    add = parser.add_argument
    add('result', type=Path, help='folder of identify --out, or a calibrated chain file alone')
    add_chain(parser)
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
    add('--force', action='store_true', help='replace the result in --out')
    add_identity(parser)


def _add_calibration(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        '--calibration',
        type=Path,
        required=True,
        help='folder of identify --out, or calibration.yaml alone',
    )


def _add_verify(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('measured', type=Path, help='table of new measurements: q1..qn as reported, x y z ...')
    add_chain(parser)
    _add_calibration(parser)
    add(
        '--tolerance',
        type=float,
        metavar='MM',
        help='wanted RMS position error; if not given, errors only, without a verdict',
    )
    add(
        '--commanded',
        type=Path,
        metavar='FILE',
        help='the program before its correction, q1..qn: judge against the poses that it means',
    )
    add('--confidence', type=float, default=0.95, help='of the verdict')
    add('--session', help='session of the table')
    add('--new-base', action='store_true', help='the measuring device stands elsewhere now')
    add('--new-tool', action='store_true', help='the target is another one, or mounted anew')
    add('--out', type=Path, help='folder for the report and the residuals')
    add('--force', action='store_true', help='replace the result in --out')
    add_identity(parser)
    add_pdf(parser)
    add_layout(parser)


def _add_compensate(parser: argparse.ArgumentParser) -> None:
    from calib_ros.apply.compensation import Compensator

    parser.add_argument(
        'program', type=Path, help='.csv with q1 ... qn, or .yaml with a JointTrajectory'
    )
    add_chain(parser)
    _add_calibration(parser)
    parser.add_argument('--out', type=Path, required=True, help='the corrected program')
    parser.add_argument('--force', action='store_true', help='overwrite --out')
    parser.add_argument(
        '--tool',
        nargs=3,
        type=float,
        default=Compensator.tool,
        metavar=('X', 'Y', 'Z'),
        help='point in the flange frame whose position counts [m]',
    )
    for name, text in (
        ('largest_turn', 'largest correction of a revolute joint [rad]'),
        ('largest_shift', 'largest correction of a prismatic joint [m]'),
        ('largest_position_error', 'position error that may remain [m]'),
        (
            'largest_orientation_error',
            'orientation error that may remain [rad]; if not given 1e-6, or 0.02 for arms that '
            'cannot reach every orientation',
        ),
        (
            'orientation_weight',
            'position error that counts as much as one radian, where both cannot vanish '
            '[m/rad]; if not given 0.3, or 0.001 for arms that cannot reach every orientation',
        ),
        ('largest_change', 'largest change of the correction relative to the move'),
    ):
        default = getattr(Compensator, name)
        parser.add_argument(f'--{name.replace("_", "-")}', type=float, default=default, help=text)


def _plan(options: argparse.Namespace) -> int:
    import numpy as np

    from calib_ros.apply.candidates import Visibility
    from calib_ros.apply.design import ASSUMED_TOOL, Design
    from calib_ros.apply.simulation import measure
    from calib_ros.atomic import write_file
    from calib_ros.files.waypoints import joints_csv
    from calib_ros.identification.problem import Problem
    from calib_ros.kinematics.chain_file import load_chain
    from calib_ros.report.maps import plan_report

    _check_plan(options)
    chain = load_chain(options.chain)
    rng = np.random.default_rng(options.seed)
    nowhere = np.zeros((1, len(chain.joints)))
    imagined = measure(chain, nowhere, rng, oriented=options.measured == 'pose')
    design = Design.of(Problem(chain, imagined, **settings_of(options).for_problem()))
    visibility = Visibility(
        None if options.box is None else np.reshape(options.box, (2, 3)),
        None if options.tracker is None else np.array(options.tracker),
        tuple(options.axis),
        np.radians(options.cone),
        options.world,
    )
    planned = _plan_tests if options.iso9283 else _plan_measurement
    joints, words, plan = planned(options, design, visibility, rng)
    print(words)
    if chain.tool is None:
        x, y, z = ASSUMED_TOOL
        print(f'the tool is unknown: its target is taken to be at {x} {y} {z} m from the flange')
    if options.out is not None:
        page = _page_beside(options.out)
        report = plan_report(
            design.chain,
            joints,
            words,
            origin_of(options, (options.candidates, options.task, options.taken)),
            plan,
            options.accuracy,
        )
        pages = page_of(report, page.name)
        write_file(options.out, joints_csv(joints), overwrite=options.force)
        for text in pages.values():
            write_file(page, text, overwrite=options.force)
        print(f'wrote {options.out}' + (f' and {page}' if pages else ''))
    return 0


def _plan_measurement(
    options: argparse.Namespace, design: Design, visibility: Visibility, rng: np.random.Generator
) -> tuple[FloatArray, str, Plan | None]:
    """Return the poses to measure in the order of visit, what they promise, and the plan."""
    import numpy as np

    from calib_ros.apply import planning
    from calib_ros.apply.candidates import draw_candidates
    from calib_ros.files.waypoints import read_joints

    size = len(design.chain.joints)
    if len(options.velocity) not in (1, size):
        raise InputError(f'--velocity: give one value, or {size}, not {len(options.velocity)}')
    if options.taken is not None:
        design = design.after(read_joints(options.taken, design.chain))
    task = design.chain.random_joints(TASK_POSES, rng)
    if options.task is not None:
        task = read_joints(options.task, design.chain)
    if options.candidates is None:
        candidates = draw_candidates(design, options.draw, rng, visibility)
    else:
        candidates = read_joints(options.candidates, design.chain)
        candidates = candidates[visibility.sees(design, candidates)]
        if not len(candidates):
            raise InputError(f'the target can be measured at no pose of {options.candidates}')
    choice = {'criterion': options.criterion, 'apart': options.apart}
    needed = None
    if options.accuracy is not None:
        wanted = 1e-3 * options.accuracy
        needed = planning.poses_needed(design, candidates, task, wanted, **choice)
    count = options.poses or needed or 25
    speeds = np.broadcast_to(options.velocity, size)
    plan = planning.plan(design, candidates, task, count, **choice, velocities=speeds)
    words = planning.in_words(plan, len(candidates), options.accuracy, needed)
    return plan.joints[plan.visit], words, plan


def _plan_tests(
    options: argparse.Namespace, design: Design, visibility: Visibility, rng: np.random.Generator
) -> tuple[FloatArray, str, Plan | None]:
    """Return the test poses of ISO 9283, and what to do with them; there is no plan."""
    from calib_ros.apply.iso9283 import iso_9283_poses

    found = iso_9283_poses(design, rng, visibility)
    words = (
        f'P1 to P5 of ISO 9283 in a cube of {found.edge:.3f} m, one orientation: go to them in '
        'turn, 30 times, and measure. Collisions are not looked at'
    )
    return found.joints, words, None


def _check_plan(options: argparse.Namespace) -> None:
    """Refuse options of `plan` that make no sense."""
    for name in ('poses', 'accuracy', 'candidates', 'task', 'taken'):
        if options.iso9283 and getattr(options, name) is not None:
            raise InputError(f'--{name} is of no use with --iso9283')
    for name, lowest in (('poses', 1), ('draw', 1), ('seed', 0)):
        value = getattr(options, name)
        if value is not None and value < lowest:
            raise InputError(f'--{name} must be at least {lowest}, not {value}')
    if options.accuracy is not None and not options.accuracy > 0.0:
        raise InputError(f'--accuracy must be positive, not {options.accuracy}')
    if options.apart < 0.0 or not all(value > 0.0 for value in options.velocity):
        raise InputError('--apart must not be negative, and each --velocity must be positive')
    if options.out is not None and not options.force:
        for path in (options.out, _page_beside(options.out)):
            if path.exists():
                raise InputError(f'{path} exists already: choose another name or --force')


def _page_beside(path: Path) -> Path:
    """Return where the report of a plan is."""
    return path.with_name(f'{path.stem}.report.html')


def _workspace(options: argparse.Namespace) -> int:
    from calib_ros.atomic import write_files

    for name, lowest in (('poses', 100), ('cells', 1), ('turns', 1), ('seed', 0)):
        if getattr(options, name) < lowest:
            raise InputError(f'--{name} must be at least {lowest}, not {getattr(options, name)}')
    with results(options, WORKSPACE_FILES + PLACEMENT_FILES) as folder:
        contents = _workspace_files(options)
        write_files(folder, contents)
    print(contents['workspace.md'], end='')
    return 0


def _workspace_files(options: argparse.Namespace) -> dict[str, str | bytes]:
    """Return the files of a map, and of placements where there is a task."""
    import numpy as np

    from calib_ros.apply import placement, workspace
    from calib_ros.files.waypoints import csv_of, joints_csv
    from calib_ros.kinematics.chain_file import load_chain
    from calib_ros.report import plots
    from calib_ros.report.maps import workspace_report

    arm = workspace.CalibratedArm.read(options.result, load_chain(options.chain))
    rng = np.random.default_rng(options.seed)
    task = _task(options, arm, rng)
    survey = workspace.survey(arm, options.poses, rng)
    words = workspace.in_words(survey)
    if arm.region is not None:
        words += f'\nThe calibration is {arm.region.in_words()}.\n'
    found = None
    contents: dict[str, str | bytes] = {
        'workspace.csv': csv_of(('x', 'y', 'z', 'error', 'sigma'), survey.cloud),
        'workspace.png': plots.workspace_png(survey),
    }
    if task is not None:
        region = None if options.region is None else np.reshape(options.region, (2, 3))
        found = placement.place(
            arm, task, options.aim, options.model, region, options.cells, options.turns
        )
        words += '\n' + placement.in_words(found, options.aim, options.model)
        table = np.column_stack([found.positions, found.turns, found.errors])
        contents['placements.csv'] = csv_of(('x', 'y', 'z', 'turn', 'error'), table)
        contents['placements.png'] = plots.placements_png(found)
        contents['placed_task.csv'] = joints_csv(found.joints[found.best])
    origin = origin_of(options, _calibration_files(options.result))
    contents |= page_of(workspace_report(arm, survey, origin, found))
    return contents | {'workspace.md': words}


def _calibration_files(path: Path) -> tuple[Path, ...]:
    """Return the files of a calibration, or of the folder of a result, that are read."""
    if not path.is_dir():
        return (path,)
    return tuple(path / name for name in ('calibration.yaml', 'result.json'))


def _task(
    options: argparse.Namespace, arm: CalibratedArm, rng: np.random.Generator
) -> FloatArray | None:
    """Return the poses (K, 4, 4) of the task to place, if there is one."""
    import numpy as np

    from calib_ros.apply.placement import task_of
    from calib_ros.apply.workspace import in_base
    from calib_ros.files.waypoints import read_poses

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
    if not (lower <= upper).all():
        raise InputError('--joint-box: give all lower values first, then all upper ones')
    joints = rng.uniform(lower, upper, (BOX_POSES, size))
    return task_of(in_base(arm.commanded_by(options.model), joints))


def _verify(options: argparse.Namespace) -> int:
    from calib_ros.atomic import write_files

    if options.out is None:
        return _verified(options)[0]
    with results(options, VERIFICATION_FILES) as folder:
        status, contents = _verified(options)
        write_files(folder, contents)
    return status


def _verified(options: argparse.Namespace) -> tuple[int, dict[str, str | bytes]]:
    """Judge, and print what comes out; return the exit status and the files of --out."""
    from calib_ros.apply.verification import in_words, verify
    from calib_ros.apply.workspace import CalibratedArm
    from calib_ros.files.tables import read_table
    from calib_ros.files.waypoints import read_joints
    from calib_ros.kinematics.chain_file import load_chain
    from calib_ros.report.poses import poses_to_verify
    from calib_ros.report.verified import verification_report

    nominal = load_chain(options.chain)
    arm = CalibratedArm.read(options.calibration, nominal)
    sessions = tuple(options.session.split(',')) if options.session else ()
    foreign = foreign_of(options, nominal)
    table = read_table(options.measured, len(nominal.joints), sessions, foreign=foreign)
    commanded = None
    if options.commanded is not None:
        commanded = read_joints(options.commanded, nominal)
    sets = (*table.fitted, *table.held_out)
    found = verify(
        arm,
        sets,
        None if options.tolerance is None else 1e-3 * options.tolerance,
        options.confidence,
        options.new_base,
        commanded,
        options.new_tool,
    )
    for warning in table.warnings:
        print(f'warning: {warning}', file=sys.stderr)
    words = in_words(found)
    print(words)
    status = 0 if found.verdict in ('PASS', 'JUDGED') else NOT_ACCEPTED
    if options.out is None:
        return status, {}
    poses = poses_to_verify(arm.after, sets, found.comparison, table.by_line)
    origin = origin_of(
        options, (options.measured, options.commanded, *_calibration_files(options.calibration))
    )
    report = verification_report(arm.after, found, poses, origin, table.warnings)
    contents: dict[str, str | bytes] = {
        'residuals.csv': poses.table(),
        'verification.txt': f'{words}\n',
    }
    return status, {**contents, **page_of(report), **paper_of(report, options.pdf)}


def _compensate(options: argparse.Namespace) -> int:

    from calib_ros.apply.compensation import POSITIVE, Compensator, in_words
    from calib_ros.apply.program import compensate_program
    from calib_ros.apply.workspace import CalibratedArm
    from calib_ros.atomic import write_file
    from calib_ros.files.trajectories import read_program
    from calib_ros.kinematics.chain_file import load_chain

    if options.out.exists() and not options.force:
        raise InputError(f'{options.out} exists already: choose another name or --force')
    if options.out.exists() and options.out.samefile(options.program):
        raise InputError(
            '--out is the program itself: keep it, a program compensated twice is wrong'
        )
    nominal = load_chain(options.chain)
    arm = CalibratedArm.read(options.calibration, nominal)
    limits = {name: getattr(options, name) for name in POSITIVE}
    compensator = Compensator(nominal, arm.after, tuple(options.tool), **limits, region=arm.region)
    source = read_program(options.program, nominal.joint_names)
    corrected, result = compensate_program(compensator, source.program)
    if result.refusals:
        print(f'calib_ros: nothing is written, {in_words(compensator, result)}', file=sys.stderr)
        for refusal in result.refusals:
            print(f'{source.places[refusal.sample]}: {refusal.reason}', file=sys.stderr)
        return NOT_ACCEPTED
    write_file(options.out, source.text_with(corrected), overwrite=options.force)
    print(f'wrote {options.out}: {in_words(compensator, result)}')
    words, warning = arm.knowledge(result.joints, result.orientation_before)
    if words:
        print(words)
    if warning:
        print(f'warning: {warning}', file=sys.stderr)
    return 0
