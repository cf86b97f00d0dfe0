# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""All commands with their options; importing them loads nothing else.

A command is written in lines: `# NAME MODULE.FUNCTION  DESCRIPTION`, `$ EXAMPLE`, then its
options as the help shows them: groups, with a line for each option. The name is followed by `!` if
required and, unless it is a flag, by a placeholder, which gives the type, or by choices `a|b`;
then `*3`, `+` or `?` for several values, and `=` with the default. A line starting with `@` adds
shared options. `## GROUP` is a heading of the overview.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

from calib_ros.cli.common import OF_BAGS, Group, add_fields, add_settings, complete_robots
from calib_ros.settings import AIMS, CRITERIA, EXCEPTION, GROWTH, MODELS, STORAGES, Limits


def _measured(text: str) -> Path:
    return Path('/dev/stdin' if text == '-' else text)


ARGUMENT_TYPES: dict[str, Callable[[str], Any]] = {
    **dict.fromkeys(('N', 'ROWS'), int),
    **dict.fromkeys(('DEG', 'M', 'MM', 'Q', 'SHARE', 'V', 'X', 'X,Y,Z'), float),
    **dict.fromkeys(('BAG', 'FILE', 'FIRST', 'FOLDER', 'IMAGES', 'PLANT'), Path),
    **dict.fromkeys(('CALIBRATION', 'PROGRAM', 'RESULT', 'SECOND'), Path),
    **dict.fromkeys(('MEASURED', 'TABLE'), _measured),
}
"""By placeholder; others are text."""
FORM = re.compile(r'([^=]*?)([*]\d+|[+?]|)(?:=(.*)|)$')
"""Placeholder or choices, number of values, default."""
CHAIN = 'robot name (calib_ros robots), chain file or URDF'
EARLIER = 'calibration.yaml, or folder from identify --out'
FORCE = 'overwrite existing output'
SEED = 'random seed'
HISTORY = 'also file the result here, under --serial'
CALIBRATION = 'folder from identify --out, or a calibration.yaml'
SIMULATION = f"""\
  --poses N=60  poses to measure
  --seed N=0  {SEED}
  --storage {'|'.join(STORAGES)}=mcap  storage format of the bag"""
EYE = '  --eye-in-hand  poses or positions are of a fixed target, seen from the flange'
LOSS = f"""  --largest-loss SHARE={EXCEPTION}  share of a bag's messages that may be lost or \
unused for the result to be accepted; 1: any"""
MOVED = """\
  --new-base  the measuring device, or what a camera on the flange sees, was moved
  --new-tool  the target was replaced or remounted"""
LAYOUT = """\
tables of other systems (docs/tables.md); anything not given is guessed
  --preset NAME=  layout: a name, or your own .yaml
  --length UNIT=  unit of lengths: m, cm, mm, um, in, ft
  --angle UNIT=  unit of angles, including joint values: rad, deg
  --joint-angle UNIT=  unit of joint values, if different
  --euler ZYX=  rx ry rz are Euler angles; zyx: fixed axes
  --quaternion wxyz=  order of the quaternion; default: xyzw
  --separator NAME=  comma, semicolon, tab, bar or space
  --decimal NAME=  point or comma
  --sheet NAME=  sheet of a workbook (.xlsx); default: the first with the columns
  --joints-preset NAME=  layout of the --joints log
  @columns
  --rotation-vector  rx ry rz are a rotation vector
  --inverse  poses are of the device in the target frame
  --shift ROWS=0  joint values are this many rows below their measurement
  --joints FILE  separate log of joint values, matched by a common column or row by row"""
COLUMNS = 'q1=A1,x={Pos X},y=-#3 ...: columns or expressions; q*=A* for all joints'
REPORT = """\
for the report
  --operator NAME=  who measured
  --serial NAME=  serial number of the robot
  --device NAME=  measuring device and its serial number
  --conditions TEXT=  temperature, load, speed and the like while measuring"""
PDF = '  --pdf  also write report.pdf, starting with a certificate'
WRITTEN = f"""
## First steps
# demo simulate._demo  simulate an arm, identify it, and compare the result with the truth
$ demo
$ demo --chain franka_panda --out demo_panda/
what to simulate
  --chain ROBOT=ur10e  {CHAIN}
  --out FOLDER=demo  output folder
  --force  {FORCE}
{SIMULATION}
# robots robots._robots  list the arms supplied
$ robots
# chain robots._chain  print the chain file of a robot, to read or edit
$ chain ur10e
$ chain robot.urdf --tip-link tool0 --out robot.yaml
which arm
  robot ROBOT  URDF, chain file, or a robot by its name (ur10e, ...)
  --base-link LINK  first link of the arm in a URDF; default: its root
  --tip-link LINK  last link of the arm in a URDF, such as tool0
  --convention NAME  DH convention for a URDF: standard or modified
  --out FILE  write this file instead of printing
# simulate simulate._run  write the bag of a simulated robot cell, with the true chain
$ simulate cell_bag --chain kuka_iiwa14 --poses 60
what to simulate
  bag BAG  bag folder to write
  --chain! ROBOT  {CHAIN}
{SIMULATION}
## Calibrate
# plan plan._run  choose the poses to measure, and predict the accuracy
$ plan --chain ur10e --accuracy 0.1 --out plan.csv
$ plan --chain ur10e --poses 40 --tracker 3 0 1 --cone 45 --out plan.csv
$ plan --chain ur10e --iso9283 --out tests.csv
what is wanted
  --chain! ROBOT  {CHAIN}
  --poses N  number of poses; default: 25, or as --accuracy needs
  --accuracy MM  wanted RMS position error at the task poses [mm]
  --iso9283  the five test poses of ISO 9283 instead
  --task FILE  CSV q1..qn of work poses; default: random poses
  --taken FILE  CSV q1..qn of poses already measured
  --out FILE  CSV q1..qn to write, and its report beside it
  --force  {FORCE}
poses to choose from
  --candidates FILE  CSV q1..qn of poses to choose from
  --draw N=2000  random candidates, if no file is given
  --criterion {'|'.join(CRITERIA)}=d  d: determinant; o2 to o5: index; task: error there
  --apart X=0.001  smallest joint move between poses [rad, m]
  --velocity V+=1  joint velocity [rad/s, m/s]
  --seed N=0  {SEED}
what the device sees
  --measured pose|position=pose  what is measured at each pose
  --box M*6  measurable region: lower, upper corner [m]
  --tracker M*3  position of the device [m]
  --axis X*3=0,0,1  axis of the target that must face the device
  --cone DEG=45  largest angle between axis and line of sight [deg]
  --world  box and tracker are in the world frame, not the base frame
@settings sigma_position sigma_orientation priors model fixed
{REPORT}
# identify identify._run  identify the errors of an arm from a bag or a table of measured poses
$ identify measured.csv --chain ur10e --out result/
$ identify recording/ --chain robot.urdf --out result/ --model auto
$ identify export.csv --chain ur10e --length mm --angle deg --euler ZYX
$ identify measured.csv --chain ur10e --session monday --json
what to read
  measured MEASURED?  a table of measured poses (-: standard input), or a bag: folder, .mcap \
or .db3
  --csv FILE  a table, whatever its file name
  --chain! ROBOT  {CHAIN}
  --session NAME  only rows with this name in the column session; several joined by commas
{EYE}
{LOSS}
  --sigma-touch M  standard deviation of heights over touched planes [m]; default: 1e-4
what to write
  --out FOLDER  calibration, result and report
  --force  {FORCE}
  --history DIR  {HISTORY}
  --json  print the result as JSON
  --tolerance MM  wanted RMS position error [mm]
what a camera saw (docs/images.md)
  --detections FILE  board corners from calib_ros images
  --board FILE  YAML of that board
  --places FILE  table of the arm at each image: image and q1 ... qn; with --chain flange_pose, \
image and x y z qx qy qz qw of the flange
  --intrinsics FILE  camera_info file from camera_calibration
  --lens given|fitted  fitted: fit the intrinsics too; default: given
@settings
{LAYOUT}
{REPORT}
{PDF}
an earlier calibration (docs/history.md)
  --previous CALIBRATION  update this calibration with a few poses, and report what changed
  --growth MM={1e3 * GROWTH}  expected drift of lengths in a year [mm]; angles: twice as many mrad
{MOVED}
## Use the calibration
# export calibration._export  write a calibration for controllers, drivers and URDF users
$ export result/calibration.yaml --chain ur10e --out export/
$ export result/calibration.yaml --chain ur10e --urdf robot.urdf --out export/
what to export
  calibration CALIBRATION  calibration.yaml from identify --out
  --chain! ROBOT  {CHAIN}
  --out! FOLDER  folder to write
  --force  {FORCE}
  --measured FILE  table with q1 ... qn where inexact forms must fit best; default: the whole \
joint range
for URDF and drivers
  --urdf FILE  nominal URDF of the robot, to be corrected too
  --base-link LINK  first link of the arm in the URDF
  --tip-link LINK  last link of the arm in the URDF
  --ur-hash calib_...=  checksum that the Universal Robots driver prints at its start, for \
ur_kinematics.yaml
# compensate calibration._compensate  correct the joint values of a program
$ compensate program.csv --chain ur10e --calibration result/ --out corrected.csv
$ compensate path.yaml --chain ur10e --calibration result/ --out corrected.yaml
what to correct
  program PROGRAM  .csv with q1 ... qn, or .yaml with a JointTrajectory
  --chain! ROBOT  {CHAIN}
  --calibration! RESULT  {CALIBRATION}
  --out! FILE  corrected program to write
  --force  {FORCE}
limits
  --tool X,Y,Z=0,0,0  tool point in the flange frame [m]
  @limits
# verify verify._run  judge a calibrated arm on new measurements: its errors, PASS or FAIL
$ verify new.csv --chain ur10e --calibration result/
$ verify recording/ --chain ur10e --calibration result/ --tolerance 0.3
$ verify new.csv --chain ur10e --calibration result/ --commanded tests.csv
what to judge
  measured MEASURED  new measurements: a bag, or a table with reported q1..qn, x y z ...
  --chain! ROBOT  {CHAIN}
  --calibration! RESULT  {CALIBRATION}
  --commanded FILE  the program before its correction, q1..qn: judge against the poses it \
intends
  --session NAME  only rows with this name in the column session
{EYE}
{LOSS}
{MOVED}
how to judge
  --tolerance MM  wanted RMS position error [mm]; without it: does the calibration still hold?
  --confidence SHARE=0.95  confidence of the interval of the RMS error
  --json  print the verdict and its figures as JSON
  --out FOLDER  folder for the report and the residuals
  --force  {FORCE}
  --history DIR  {HISTORY}
@settings {' '.join(OF_BAGS)}
{LAYOUT}
{REPORT}
{PDF}
# workspace workspace._run  map errors over the workspace, and place a task where they are smallest
$ workspace result/ --chain ur10e --out map/
$ workspace result/ --chain ur10e --task task.csv --out map/ --aim worst
what to map
  result RESULT  folder from identify --out, or a calibrated chain file
  --chain! ROBOT  {CHAIN}
  --out! FOLDER  folder for tables, text and figures
  --force  {FORCE}
  --poses N=20000  random poses to survey
  --model {'|'.join(MODELS)}=corrected  chain that commands the arm; not the --model of identify
  --seed N=0  {SEED}
a task to place
  --task FILE  CSV x y z qx qy qz qw in the task frame
  --joint-box Q+  joint range of a task [rad, m]: lower, then upper values
  --aim {'|'.join(AIMS)}=mean  error over the task poses to minimise
  --region M*6  where the task may be placed: lower, upper corner [m]
  --cells N=9  placements along each axis
  --turns N=1  turns about the vertical to try
{REPORT}
## Over time
# compare calibration._compare  test what changed between two calibrations of one robot
$ compare monday/ tuesday/
$ compare before.yaml after.yaml --json
what to compare
  first FIRST  earlier {EARLIER}
  second SECOND  later {EARLIER}
  --json  print the difference as JSON
# fleet fleet._run_fleet  identify all new recordings of a plant, and report which robots changed
$ fleet plant.yaml --history history/ --out report/
$ fleet plant.yaml --history history/ --out report/ --scheduler tcp://head:8786
which robots
  plant PLANT  plant.yaml: list of robots (docs/fleet.md)
  --history! DIR  folder or URL for the results
  --out FOLDER  report: index.html, and a page per robot
  --metrics FILE  file for the Prometheus textfile collector
who does the work
  --scheduler ADDRESS=  scheduler of a dask cluster: tcp://host:8786
  --workers N=0  local processes; 0: one per core
  --memory SIZE=2GiB  memory limit of each process
alarms
  --years X=100  years between false alarms of a robot measured every night
# history fleet._run_history  list results over time
$ history history/ --robot 0042
what to list
  history DIR  folder or URL of a history
  --robot SERIAL  only this robot
## Cameras and files
# board camera._board  make a board for cameras, as a PDF in true size
$ board charuco --columns 9 --rows 7 --square 0.03 --marker 0.022 --out board.pdf
the board
  type charuco|markers  chessboard with markers, or markers alone
  --columns! N  squares or markers across
  --rows! N  squares or markers down
  --square! M  side of a square, or marker spacing [m]
  --marker! M  side of a marker [m]
  --dictionary NAME=DICT_5X5_250  marker dictionary of OpenCV
  --out! FILE  PDF to write, with its YAML beside it
  --force  {FORCE}
# images camera._images  find the corners of a board in photographs
$ images photographs/ --board board.yaml --out corners.csv
what to look at
  images IMAGES  folder of images, or a bag
  --board! FILE  YAML of the board
  --topic NAME=  image topic, if a bag has several
  --fewest N=6  fewest corners an image must show
  --out! FILE  table to write: image, corner, u, v
  --force  {FORCE}
# import convert._convert  convert a table from another system
$ import export.csv --length mm --angle deg --euler ZYX --out measured.csv
$ import export.csv --preset optitrack --joints log.csv --joints-preset kuka --out measured.csv
what to convert
  table TABLE  CSV, text in columns, or .xlsx
  --chain ROBOT  {CHAIN}
  --out! FILE  CSV to write
  --force  {FORCE}
{LAYOUT}
# bag2csv convert._bag2csv  write the poses of a bag as a table
$ bag2csv recording/ measured.csv --chain ur10e
what to convert
  bag BAG  rosbag2 folder, .mcap or .db3 file
  csv FILE  CSV to write
  --force  {FORCE}
  --chain! ROBOT  {CHAIN}
@settings {' '.join(OF_BAGS)}
# csv2bag convert._csv2bag  write a table of measured poses as a bag
$ csv2bag measured.csv measured_bag --chain ur10e --session monday
what to convert
  csv TABLE  table of measured poses
  bag BAG  bag folder to write
  --chain! ROBOT  {CHAIN}
  --session NAME  only rows with this name in the column session
  --storage {'|'.join(STORAGES)}=mcap  storage format of the bag
{LAYOUT}
"""


class Command(NamedTuple):
    """A command as written above."""

    group: str  # in the overview
    home: str  # MODULE.FUNCTION, imported when it runs
    text: str
    examples: list[str]  # without "calib_ros"
    options: list[str]


def _commands() -> dict[str, Command]:
    group, found = '', {}
    for line in WRITTEN.strip().splitlines():
        mark, _, rest = line.partition(' ')
        if mark == '##':
            group = rest
        elif mark == '#':
            head, text = rest.split('  ', 1)
            name, home = head.split(' ')
            found[name] = Command(group, home, text, [], [])
        elif mark == '$':
            found[name].examples.append(rest)
        else:
            found[name].options.append(line)
    return found


COMMANDS = _commands()
"""By name, in the order of the overview."""


def add_options(parser: argparse.ArgumentParser, written: Sequence[str]) -> None:
    """Add the options of a command to its parser."""
    group: Group = parser
    for line in written:
        first, *names = line.split()
        if first == '@settings':
            add_settings(parser, names)
        elif first == '@limits':
            add_fields(group, fields(Limits))
        elif first == '@columns':
            theirs: dict[str, Any] = {'metavar': 'OURS=THEIRS,...', 'help': COLUMNS}
            group.add_argument('--columns', action='append', default=[], **theirs)
        elif line.startswith('  '):
            _add_option(group, *line[2:].split('  ', 1))
        else:
            group = parser.add_argument_group(line)


def _add_option(group: Group, option: str, text: str) -> None:
    name, _, form = option.partition(' ')
    placeholder, count, default = FORM.findall(form)[0]
    kind = ARGUMENT_TYPES.get(placeholder, str)
    given: dict[str, Any] = {'required': True} if name.endswith('!') else {}
    if not form:
        given['action'] = 'store_true'
    elif '|' in placeholder:
        given['choices'] = tuple(placeholder.split('|'))
    elif ',' in placeholder:  # one for each value
        metavars = tuple(placeholder.split(','))
        given |= {'type': kind, 'metavar': metavars, 'nargs': len(metavars)}
    else:
        given |= {'type': kind, 'metavar': placeholder}
    if count:
        given['nargs'] = int(count[1:]) if count.startswith('*') else count
    if '=' in form:
        values = [kind(each) for each in default.split(',')]
        given['default'] = values if 'nargs' in given else values[0]
    text += f' (default: {default.replace(",", " ")})' if default else ''
    action = group.add_argument(name.rstrip('!'), help=text, **given)
    if name.startswith('--chain'):
        action.completer = complete_robots  # type: ignore[attr-defined]
