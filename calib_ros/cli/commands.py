# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The options of all commands; nothing here needs what the commands work with."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path

from calib_ros.cli import options as common
from calib_ros.settings import AIMS, CRITERIA, EXCEPTION, GROWTH, MODELS, Limits


def _add_chain(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('which arm')
    add = group.add_argument
    add('robot', metavar='ROBOT', help='URDF, chain file, or a robot by its name (ur10e, ...)')
    add('--base-link', metavar='LINK', help='of a URDF: where the arm starts, else its root')
    add('--tip-link', metavar='LINK', help='of a URDF: where the arm ends, such as tool0')
    add('--convention', metavar='NAME', help='of the table from a URDF: standard or modified')
    add('--out', type=Path, metavar='FILE', help='file to write instead')


def _add_simulate(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('what to simulate')
    group.add_argument('bag', type=Path, metavar='BAG', help='folder of the bag to write')
    common.add_chain(group)
    _add_simulation(group)


def _add_demo(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('what to simulate')
    common.add_chain(group, 'ur10e')
    common.add_out(group, 'what it writes', default=Path('demo'))
    _add_simulation(group)


def _add_simulation(parser: argparse._ArgumentGroup) -> None:
    add = parser.add_argument
    add('--poses', type=int, default=60, metavar='N', help='poses to measure')
    add('--seed', type=int, default=0, metavar='N', help='of the random numbers')
    common.add_storage(parser)


def _add_board(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('the board')
    add = group.add_argument
    add('type', choices=('charuco', 'markers'), help='markers: a grid of them')
    for name, text in (('columns', 'across'), ('rows', 'down')):
        add(f'--{name}', type=int, required=True, metavar='N', help=f'squares or markers {text}')
    add('--square', type=float, required=True, metavar='M', help='from one to the next')
    add('--marker', type=float, required=True, metavar='M', help='side of a marker')
    add('--dictionary', default='DICT_5X5_250', metavar='NAME', help='DICT_APRILTAG_36h11, ...')
    common.add_out(group, 'PDF; its YAML is put beside it', 'FILE', needed=True)


def _add_images(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('what to look at')
    add = group.add_argument
    add('images', type=Path, metavar='IMAGES', help='folder of images, or a bag')
    add('--board', type=Path, required=True, metavar='FILE', help='YAML of the board')
    add('--topic', default='', metavar='NAME', help='of the images in a bag, if there are several')
    add('--fewest', type=int, default=6, metavar='N', help='corners that an image must show')
    common.add_out(group, 'table: image, corner, u, v', 'FILE', needed=True)


def _add_plan(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('what is wanted')
    common.add_chain(group)
    add = group.add_argument
    add('--poses', type=int, metavar='N', help='how many; 25, or what --accuracy needs')
    add('--accuracy', type=float, metavar='MM', help='wanted RMS position error at the task poses')
    add('--iso9283', action='store_true', help='the five test poses of ISO 9283 instead')
    add('--task', type=Path, metavar='FILE', help='CSV q1..qn; random poses if not given')
    add('--taken', type=Path, metavar='FILE', help='CSV q1..qn of poses measured already')
    common.add_out(group, 'CSV q1..qn to write, and its report beside it', 'FILE')
    add = parser.add_argument_group('poses to choose from').add_argument
    add('--candidates', type=Path, metavar='FILE', help='CSV q1..qn of poses to choose from')
    add('--draw', type=int, default=2000, metavar='N', help='random candidates without a file')
    add('--criterion', choices=CRITERIA, default='d', help='determinant, index, or task error')
    text = 'least move of a joint between poses [rad, m]'
    add('--apart', type=float, default=1e-3, metavar='X', help=text)
    text = 'of the joints [rad/s, m/s]'
    add('--velocity', type=float, nargs='+', default=[1.0], metavar='V', help=text)
    add('--seed', type=int, default=0, metavar='N', help='of the random numbers')
    add = parser.add_argument_group('what the device sees').add_argument
    add('--measured', choices=('pose', 'position'), default='pose', help='at each pose')
    add('--box', type=float, nargs=6, metavar='M', help='measurable region: lower, upper corner')
    add('--tracker', type=float, nargs=3, metavar='M', help='where the device stands')
    forward, text = [0.0, 0.0, 1.0], 'of the target, to face it'
    add('--axis', type=float, nargs=3, default=forward, metavar='X', help=text)
    add('--cone', type=float, default=45.0, metavar='DEG', help='between axis and line of sight')
    add('--world', action='store_true', help='box and tracker are in the world, not in the base')
    common.add_settings(
        parser, ('sigma_position', 'sigma_orientation', 'priors', 'model', 'fixed')
    )
    common.add_identity(parser)


def _add_fleet(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('plant', type=Path, metavar='PLANT', help='plant.yaml: the robots (docs/fleet.md)')
    add('--history', required=True, metavar='DIR', help='where results are filed; also a URL')
    add('--out', type=Path, metavar='FOLDER', help='the report: index.html, a page of each robot')
    add('--metrics', type=Path, metavar='FILE', help="for Prometheus' text collector")
    group = parser.add_argument_group('who does the work')
    add = group.add_argument
    add('--scheduler', default='', metavar='ADDRESS', help='of a dask cluster: tcp://host:8786')
    add('--workers', type=int, default=0, metavar='N', help='processes here; default: one a core')
    add('--memory', default='2GiB', metavar='SIZE', help='of each of these, at most')
    group = parser.add_argument_group('alarms')
    text = 'between two false alarms of a robot that is measured every night'
    group.add_argument('--years', type=float, default=100.0, metavar='N', help=text)


def _add_history(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('history', metavar='DIR', help='folder or URL of a history')
    add('--robot', metavar='SERIAL', help='this robot only')


def _add_identify(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('what to read')
    add = group.add_argument
    text = 'a table of measured poses, or a bag: folder, .mcap or .db3'
    add('measured', nargs='?', type=Path, metavar='MEASURED', help=text)
    add('--csv', type=Path, metavar='FILE', help='the same for a table of any name')
    common.add_chain(group)
    add('--session', metavar='NAME', help='session of the table; several joined by commas')
    text = 'the poses are those of a fixed target in a camera on the flange'
    add('--eye-in-hand', action='store_true', help=text)
    loss = 'of the messages of a bag, beyond which the result is not accepted; 1: any'
    common.add_each(
        group,
        float,
        ('--largest-loss', 'SHARE', EXCEPTION, loss),
        ('--sigma-touch', 'M', None, 'of heights over touched planes, 1e-4 if not given'),
    )
    group = parser.add_argument_group('what to write')
    common.add_out(group, 'calibration, result and report')
    common.add_history(group)
    group.add_argument('--json', action='store_true', help='print the result as JSON')
    group.add_argument('--tolerance', type=float, metavar='MM', help='wanted RMS position error')
    group = parser.add_argument_group('what a camera saw (docs/images.md)')
    places = 'table of the arm at each image: image and q1 ... qn; with --chain flange_pose x y z '
    common.add_each(
        group,
        Path,
        ('--detections', 'FILE', None, 'corners of a board, by calib_ros images'),
        ('--board', 'FILE', None, 'YAML of that board'),
        ('--places', 'FILE', None, f'{places}qx qy qz qw of the flange'),
        ('--intrinsics', 'FILE', None, 'camera_info, by camera_calibration'),
    )
    text = 'fit the intrinsics as well; else given'
    group.add_argument('--lens', choices=('given', 'fitted'), help=text)
    common.add_settings(parser)
    common.add_layout(parser)
    common.add_identity(parser, pdf=True)
    group = parser.add_argument_group('an earlier calibration (docs/history.md)')
    text = 'bring this one up to date by a few poses, and say what has changed since'
    group.add_argument('--previous', type=Path, metavar='CALIBRATION', help=text)
    text, growth = 'by which lengths wander in a year; angles by twice as many mrad', 1e3 * GROWTH
    group.add_argument('--growth', type=float, default=growth, metavar='MM', help=text)
    common.add_moved(group)


def _add_verify(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('what to judge')
    add = group.add_argument
    text = 'new measurements: a bag, or a table with q1..qn as reported, x y z ...'
    add('measured', type=Path, metavar='MEASURED', help=text)
    common.add_chain(group)
    common.add_calibration(group)
    text = 'the program before its correction, q1..qn: judge against the poses that it means'
    add('--commanded', type=Path, metavar='FILE', help=text)
    add('--session', metavar='NAME', help='session of the table')
    common.add_moved(group)
    group = parser.add_argument_group('how to judge')
    wanted = 'wanted RMS position error; if not given: does the calibration still hold?'
    common.add_each(
        group,
        float,
        ('--tolerance', 'MM', None, wanted),
        ('--confidence', 'SHARE', 0.95, 'of the verdict'),
    )
    common.add_out(group, 'the report and the residuals')
    common.add_history(group)
    common.add_settings(parser, common.OF_BAGS)
    common.add_layout(parser)
    common.add_identity(parser, pdf=True)


def _add_compare(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('what to compare')
    for name, text in (('first', 'the earlier one'), ('second', 'the later one')):
        text += ': calibration.yaml, or the folder of identify --out'
        group.add_argument(name, type=Path, metavar=name.upper(), help=text)
    group.add_argument('--json', action='store_true', help='print the difference as JSON')


def _add_compensate(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('what to correct')
    text = '.csv with q1 ... qn, or .yaml with a JointTrajectory'
    group.add_argument('program', type=Path, metavar='PROGRAM', help=text)
    common.add_chain(group)
    common.add_calibration(group)
    common.add_out(group, 'the corrected program', 'FILE', needed=True)
    limits = parser.add_argument_group('limits')
    text, axes = 'point in the flange frame whose position counts [m]', ('X', 'Y', 'Z')
    none = [0.0, 0.0, 0.0]
    limits.add_argument('--tool', nargs=3, type=float, default=none, metavar=axes, help=text)
    common.add_fields(limits, fields(Limits))


def _add_export(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('what to export')
    add = group.add_argument
    add('calibration', type=Path, metavar='CALIBRATION', help='calibration.yaml of identify --out')
    common.add_chain(group)
    common.add_out(group, 'all forms', needed=True)
    text = 'table with q1 ... qn where tables that cannot be exact are to be best; if not given, '
    add('--measured', type=Path, metavar='FILE', help=f'{text}the whole joint range')
    add = parser.add_argument_group('for URDF and drivers').add_argument
    add('--urdf', type=Path, metavar='FILE', help='nominal URDF of the robot, to correct as well')
    add('--base-link', metavar='LINK', help='of the URDF: where the arm starts')
    add('--tip-link', metavar='LINK', help='of the URDF: where the arm ends')
    text = 'checksum that the driver of Universal Robots prints at its start, for '
    add('--ur-hash', default='', metavar='calib_...', help=f'{text}ur_kinematics.yaml')


def _add_workspace(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('what to map')
    add = group.add_argument
    text = 'folder of identify --out, or a calibrated chain file alone'
    add('result', type=Path, metavar='RESULT', help=text)
    common.add_chain(group)
    common.add_out(group, 'tables, words and figures', needed=True)
    add('--poses', type=int, default=20_000, metavar='N', help='random poses of the survey')
    add('--model', choices=MODELS, default='corrected', help='by which the arm is commanded')
    add('--seed', type=int, default=0, metavar='N', help='of the random numbers')
    add = parser.add_argument_group('a task to place').add_argument
    add('--task', type=Path, metavar='FILE', help='CSV x y z qx qy qz qw in the frame of a task')
    add('--joint-box', type=float, nargs='+', metavar='Q', help='task: lower, then upper values')
    add('--aim', choices=AIMS, default='mean', help='error over the poses of the task')
    add('--region', type=float, nargs=6, metavar='M', help='for the task, lower, upper corner')
    add('--cells', type=int, default=9, metavar='N', help='placements along each axis')
    add('--turns', type=int, default=1, metavar='N', help='turns about the vertical to try')
    common.add_identity(parser)


def _add_import(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('what to convert')
    group.add_argument('table', type=Path, metavar='TABLE', help='CSV, text in columns, or .xlsx')
    common.add_chain(group, needed=False)
    common.add_out(group, 'CSV to write', 'FILE', needed=True)
    common.add_layout(parser)


def _add_csv2bag(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('what to convert')
    group.add_argument('csv', type=Path, metavar='TABLE', help='the table')
    group.add_argument('bag', type=Path, metavar='BAG', help='folder of the bag to write')
    common.add_chain(group)
    group.add_argument('--session', metavar='NAME', help='session of the table to use')
    common.add_storage(group)


def _add_bag2csv(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group('what to convert')
    group.add_argument('bag', type=Path, metavar='BAG', help='rosbag2 folder, .mcap or .db3 file')
    group.add_argument('csv', type=Path, metavar='TABLE', help='CSV to write')
    group.add_argument('--force', action='store_true', help='replace what is there already')
    common.add_chain(group)
    common.add_settings(parser, common.OF_BAGS)


EXAMPLES = """
robots
chain ur10e
chain robot.urdf --tip-link tool0 --out robot.yaml
demo
demo --chain franka_panda --out demo_panda/
simulate cell_bag --chain kuka_iiwa14 --poses 60
board charuco --columns 9 --rows 7 --square 0.03 --marker 0.022 --out board.pdf
images photographs/ --board board.yaml --out corners.csv
plan --chain ur10e --accuracy 0.1 --out plan.csv
plan --chain ur10e --poses 40 --tracker 3 0 1 --cone 45 --out plan.csv
plan --chain ur10e --iso9283 --out tests.csv
fleet plant.yaml --history history/ --out report/
fleet plant.yaml --history history/ --out report/ --scheduler tcp://head:8786
history history/ --robot 0042
identify measured.csv --chain ur10e --out result/
identify recording/ --chain robot.urdf --out result/ --model auto
identify export.csv --chain ur10e --length mm --angle deg --euler ZYX
identify measured.csv --chain ur10e --session monday --json
verify new.csv --chain ur10e --calibration result/
verify recording/ --chain ur10e --calibration result/ --tolerance 0.3
verify new.csv --chain ur10e --calibration result/ --commanded tests.csv
compare monday/ tuesday/
compare before.yaml after.yaml --json
compensate program.csv --chain ur10e --calibration result/ --out corrected.csv
compensate path.yaml --chain ur10e --calibration result/ --out corrected.yaml
export result/calibration.yaml --chain ur10e --out export/
export result/calibration.yaml --chain ur10e --urdf robot.urdf --out export/
workspace result/ --chain ur10e --out map/
workspace result/ --chain ur10e --task task.csv --out map/ --aim worst
bag2csv recording/ measured.csv --chain ur10e
csv2bag measured.csv measured_bag --chain ur10e --session monday
import export.csv --length mm --angle deg --euler ZYX --out measured.csv
import export.csv --preset optitrack --joints log.csv --joints-preset kuka --out measured.csv
"""
"""For the foot of each help, without "calib_ros"."""

COMMANDS: Mapping[str, tuple[str, Callable[[argparse.ArgumentParser], None]]] = {
    'robots': ('robots._robots', lambda parser: None),
    'chain': ('robots._chain', _add_chain),
    'demo': ('simulate._demo', _add_demo),
    'simulate': ('simulate._run', _add_simulate),
    'board': ('camera._board', _add_board),
    'images': ('camera._images', _add_images),
    'plan': ('plan._run', _add_plan),
    'fleet': ('fleet._run_fleet', _add_fleet),
    'history': ('fleet._run_history', _add_history),
    'identify': ('identify._run', _add_identify),
    'verify': ('verify._run', _add_verify),
    'compare': ('calibrated._compare', _add_compare),
    'compensate': ('calibrated._compensate', _add_compensate),
    'export': ('calibrated._export', _add_export),
    'workspace': ('workspace._run', _add_workspace),
    'bag2csv': ('convert._bag2csv', _add_bag2csv),
    'csv2bag': ('convert._csv2bag', _add_csv2bag),
    'import': ('convert._convert', _add_import),
}
"""By name: MODULE.FUNCTION, which is imported when it runs, and what adds its options."""


def examples_of(name: str) -> list[str]:
    """Return whole commands of a name."""
    return [line for line in EXAMPLES.splitlines() if line.split()[:1] == [name]]
