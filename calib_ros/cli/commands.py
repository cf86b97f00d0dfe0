# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The options of all commands; nothing here needs what the commands work with.

They are written as their help shows them: groups, and in these a line for each option. Behind its
name are `!` if it must be given and, unless it is a flag, its placeholder, from which follows the
type, or its choices `a|b`; `*3`, `+` or `?` for several values; and `=` with the default. A line
that begins with `@` adds options that are not written here.
"""

from __future__ import annotations

import argparse
import re
from dataclasses import fields
from pathlib import Path
from typing import Any

from calib_ros.cli.options import OF_BAGS, Group, add_fields, add_settings, complete_robots
from calib_ros.settings import AIMS, CRITERIA, EXCEPTION, GROWTH, MODELS, STORAGES, Limits

TYPES = {
    **dict.fromkeys(('N', 'ROWS'), int),
    **dict.fromkeys(('DEG', 'M', 'MM', 'Q', 'SHARE', 'V', 'X', 'X,Y,Z'), float),
    **dict.fromkeys(('BAG', 'FILE', 'FIRST', 'FOLDER', 'IMAGES', 'MEASURED', 'PLANT'), Path),
    **dict.fromkeys(('CALIBRATION', 'PROGRAM', 'RESULT', 'SECOND', 'TABLE'), Path),
}
"""By placeholder; of any other a text."""
FORM = re.compile(r'([^=]*?)([*]\d+|[+?]|)(?:=(.*)|)$')
"""Placeholder or choices, how many values, and the default."""
CHAIN = 'its name (calib_ros robots), a chain file, or a URDF'
EARLIER = 'calibration.yaml, or the folder of identify --out'
FORCE = 'replace what is there already'
SEED = 'of the random numbers'
HISTORY = 'file the result there as well, by --serial'
CALIBRATION = 'folder of identify --out, or calibration.yaml alone'
SIMULATION = f"""\
  --poses N=60  poses to measure
  --seed N=0  {SEED}
  --storage {'|'.join(STORAGES)}=mcap  of the bag"""
MOVED = """\
  --new-base  the measuring device stands elsewhere now
  --new-tool  the target is another one, or mounted anew"""
LAYOUT = """\
tables of other systems (docs/tables.md); what is not given is guessed
  --preset NAME=  a layout by name, or your own .yaml
  --length UNIT=  of lengths: m, cm, mm, um, in
  --angle UNIT=  unit of angles, joint values included: rad, deg
  --joint-angle UNIT=  unit of joint values where it is another one
  --euler ZYX=  rx ry rz are Euler angles; zyx: fixed axes
  --quaternion wxyz=  order of qx qy qz qw, else xyzw
  --separator NAME=  comma, semicolon, tab or space; guessed if not given
  --decimal NAME=  point or comma
  --sheet NAME=  of a workbook (.xlsx), else its first
  --joints-preset NAME=  layout of the log --joints
  @columns
  --rotation-vector  rx ry rz are a rotation vector
  --inverse  the poses are those of the device in the target
  --shift ROWS=0  joint values stand so many rows below their measurement
  --joints FILE  log of the joint values, row by row"""
COLUMNS = 'q1=A1,x={Pos X},y=-#3 ...: columns, or expressions of them; q*=A* for all joints'
REPORT = """\
for the report
  --operator NAME=  who measured
  --serial NAME=  serial number of the robot
  --device NAME=  measuring device and its serial number"""
PDF = '  --pdf  report.pdf as well, with a certificate first'
OPTIONS = f"""
# robots robots._robots
# chain robots._chain
which arm
  robot ROBOT  URDF, chain file, or a robot by its name (ur10e, ...)
  --base-link LINK  of a URDF: where the arm starts, else its root
  --tip-link LINK  of a URDF: where the arm ends, such as tool0
  --convention NAME  of the table from a URDF: standard or modified
  --out FILE  file to write instead
# demo simulate._demo
what to simulate
  --chain ROBOT=ur10e  {CHAIN}
  --out FOLDER=demo  what it writes
  --force  {FORCE}
{SIMULATION}
# simulate simulate._run
what to simulate
  bag BAG  folder of the bag to write
  --chain! ROBOT  {CHAIN}
{SIMULATION}
# board camera._board
the board
  type charuco|markers  markers: a grid of them
  --columns! N  squares or markers across
  --rows! N  squares or markers down
  --square! M  from one to the next
  --marker! M  side of a marker
  --dictionary NAME=DICT_5X5_250  DICT_APRILTAG_36h11, ...
  --out! FILE  PDF; its YAML is put beside it
  --force  {FORCE}
# images camera._images
what to look at
  images IMAGES  folder of images, or a bag
  --board! FILE  YAML of the board
  --topic NAME=  of the images in a bag, if there are several
  --fewest N=6  corners that an image must show
  --out! FILE  table: image, corner, u, v
  --force  {FORCE}
# plan plan._run
what is wanted
  --chain! ROBOT  {CHAIN}
  --poses N  how many; 25, or what --accuracy needs
  --accuracy MM  wanted RMS position error at the task poses
  --iso9283  the five test poses of ISO 9283 instead
  --task FILE  CSV q1..qn of where the arm will work; random poses if not given
  --taken FILE  CSV q1..qn of poses measured already
  --out FILE  CSV q1..qn to write, and its report beside it
  --force  {FORCE}
poses to choose from
  --candidates FILE  CSV q1..qn of poses to choose from
  --draw N=2000  random candidates without a file
  --criterion {'|'.join(CRITERIA)}=d  determinant, index, or task error
  --apart X=0.001  least move of a joint between poses [rad, m]
  --velocity V+=1  of the joints [rad/s, m/s]
  --seed N=0  {SEED}
what the device sees
  --measured pose|position=pose  at each pose
  --box M*6  measurable region: lower, upper corner
  --tracker M*3  where the device stands
  --axis X*3=0,0,1  of the target, to face it
  --cone DEG=45  between axis and line of sight
  --world  box and tracker are in the world, not in the base
@settings sigma_position sigma_orientation priors model fixed
{REPORT}
# fleet fleet._run_fleet
what to look after
  plant PLANT  plant.yaml: the robots (docs/fleet.md)
  --history! DIR  where results are filed; also a URL
  --out FOLDER  the report: index.html, a page of each robot
  --metrics FILE  for Prometheus' text collector
who does the work
  --scheduler ADDRESS=  of a dask cluster: tcp://host:8786
  --workers N=0  processes here; 0: one a core
  --memory SIZE=2GiB  of each of these, at most
alarms
  --years N=100.0  between two false alarms of a robot that is measured every night
# history fleet._run_history
what to list
  history DIR  folder or URL of a history
  --robot SERIAL  this robot only
# identify identify._run
what to read
  measured MEASURED?  a table of measured poses, or a bag: folder, .mcap or .db3
  --csv FILE  the same for a table of any name
  --chain! ROBOT  {CHAIN}
  --session NAME  only rows with this name in the column session; several joined by commas
  --eye-in-hand  the poses are those of a fixed target in a camera on the flange
  --largest-loss SHARE={EXCEPTION}  of the messages of a bag, beyond which the result is not \
accepted; 1: any
  --sigma-touch M  of heights over touched planes, 1e-4 if not given
what to write
  --out FOLDER  calibration, result and report
  --force  {FORCE}
  --history DIR  {HISTORY}
  --json  print the result as JSON
  --tolerance MM  wanted RMS position error
what a camera saw (docs/images.md)
  --detections FILE  corners of a board, by calib_ros images
  --board FILE  YAML of that board
  --places FILE  table of the arm at each image: image and q1 ... qn; with --chain flange_pose \
x y z qx qy qz qw of the flange
  --intrinsics FILE  camera_info, by camera_calibration
  --lens given|fitted  fit the intrinsics as well; else given
@settings
{LAYOUT}
{REPORT}
{PDF}
an earlier calibration (docs/history.md)
  --previous CALIBRATION  bring this one up to date by a few poses, and say what has changed since
  --growth MM={1e3 * GROWTH}  by which lengths wander in a year; angles by twice as many mrad
{MOVED}
# verify verify._run
what to judge
  measured MEASURED  new measurements: a bag, or a table with q1..qn as reported, x y z ...
  --chain! ROBOT  {CHAIN}
  --calibration! RESULT  {CALIBRATION}
  --commanded FILE  the program before its correction, q1..qn: judge against the poses that it \
means
  --session NAME  only rows with this name in the column session
{MOVED}
how to judge
  --tolerance MM  wanted RMS position error; if not given: does the calibration still hold?
  --confidence SHARE=0.95  of the verdict
  --out FOLDER  the report and the residuals
  --force  {FORCE}
  --history DIR  {HISTORY}
@settings {' '.join(OF_BAGS)}
{LAYOUT}
{REPORT}
{PDF}
# compare calibrated._compare
what to compare
  first FIRST  the earlier one: {EARLIER}
  second SECOND  the later one: {EARLIER}
  --json  print the difference as JSON
# compensate calibrated._compensate
what to correct
  program PROGRAM  .csv with q1 ... qn, or .yaml with a JointTrajectory
  --chain! ROBOT  {CHAIN}
  --calibration! RESULT  {CALIBRATION}
  --out! FILE  the corrected program
  --force  {FORCE}
limits
  --tool X,Y,Z=0,0,0  point in the flange frame whose position counts [m]
  @limits
# export calibrated._export
what to export
  calibration CALIBRATION  calibration.yaml of identify --out
  --chain! ROBOT  {CHAIN}
  --out! FOLDER  all forms
  --force  {FORCE}
  --measured FILE  table with q1 ... qn where tables that cannot be exact are to be best; if not \
given, the whole joint range
for URDF and drivers
  --urdf FILE  nominal URDF of the robot, to correct as well
  --base-link LINK  of the URDF: where the arm starts
  --tip-link LINK  of the URDF: where the arm ends
  --ur-hash calib_...=  checksum that the driver of Universal Robots prints at its start, for \
ur_kinematics.yaml
# workspace workspace._run
what to map
  result RESULT  folder of identify --out, or a calibrated chain file alone
  --chain! ROBOT  {CHAIN}
  --out! FOLDER  tables, words and figures
  --force  {FORCE}
  --poses N=20000  random poses of the survey
  --model {'|'.join(MODELS)}=corrected  by which the arm is commanded
  --seed N=0  {SEED}
a task to place
  --task FILE  CSV x y z qx qy qz qw in the frame of a task
  --joint-box Q+  task: lower, then upper values
  --aim {'|'.join(AIMS)}=mean  error over the poses of the task
  --region M*6  for the task, lower, upper corner
  --cells N=9  placements along each axis
  --turns N=1  turns about the vertical to try
{REPORT}
# bag2csv convert._bag2csv
what to convert
  bag BAG  rosbag2 folder, .mcap or .db3 file
  csv TABLE  CSV to write
  --force  {FORCE}
  --chain! ROBOT  {CHAIN}
@settings {' '.join(OF_BAGS)}
# csv2bag convert._csv2bag
what to convert
  csv TABLE  the table
  bag BAG  folder of the bag to write
  --chain! ROBOT  {CHAIN}
  --session NAME  only rows with this name in the column session
  --storage {'|'.join(STORAGES)}=mcap  of the bag
# import convert._convert
what to convert
  table TABLE  CSV, text in columns, or .xlsx
  --chain ROBOT  {CHAIN}
  --out! FILE  CSV to write
  --force  {FORCE}
{LAYOUT}
"""
"""Of each command by its name, behind MODULE.FUNCTION, which is imported when it runs."""
COMMANDS = dict(part.split(' ', 1) for part in OPTIONS.split('\n# ')[1:])
"""By name: MODULE.FUNCTION and, in the lines below, the options."""
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


def add_options(parser: argparse.ArgumentParser, written: str) -> None:
    """Add options to a parser, as they are written in OPTIONS."""
    group: Group = parser
    for line in filter(None, written.splitlines()):
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
    kind = TYPES.get(placeholder, str)
    if kind is int and '.' in default:
        kind = float
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
    action = group.add_argument(name.rstrip('!'), help=text, **given)
    if name.startswith('--chain'):
        action.completer = complete_robots  # type: ignore[attr-defined]


def examples_of(name: str) -> list[str]:
    """Return whole commands of a name."""
    return [line for line in EXAMPLES.splitlines() if line.split()[:1] == [name]]
