# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""What a command line cannot use is told in one line."""

import json
import shutil

import pytest
from measured import TRAIN, measured, rows_of, write_csv

from calib_ros.kinematics.chain_file import dump_chain, load_chain


def bad_inputs():
    """Yield the name of a bad input, its arguments, and what the complaint must hold."""
    csv_of = ('identify', '--chain', 'ur5e', '--csv')
    bag_of = ('identify', '--chain', 'ur5e')
    good = (*csv_of, 'good.csv')
    chain_of = ('identify', '--csv', 'good.csv', '--chain')
    yield 'no input', bag_of, 'give one input: a bag, or a table'
    yield 'two inputs', (*good, 'bag'), 'give one input: a bag, or a table'
    yield 'no such table', (*csv_of, 'missing.csv'), 'missing.csv'
    yield 'a table almost of this name', (*csv_of, 'godo.csv'), 'did you mean "good.csv"'
    yield 'only the ending', (*csv_of, 'jugs.csv'), 'jugs.csv: No such file or directory\n'
    yield 'a link to nothing', (*csv_of, 'link.csv'), '(the link leads to gone.csv)\n'
    yield 'a column twice', (*csv_of, 'twice.csv'), 'are called x: rename all but one'
    yield 'our own residuals', (*csv_of, 'left.csv'), 'it holds the errors of a result: give'
    yield 'too few rows', (*csv_of, 'few.csv'), 'too few different poses: 3 measured'
    yield 'only test rows', (*csv_of, 'judging.csv'), 'the table has no rows to fit'
    swapped = 'order.csv is of other joints: q1 is elbow_joint, in the chain shoulder_pan_joint; '
    yield 'a journal of another order', (*csv_of, 'order.csv'), swapped
    yield 'no such bag', (*bag_of, 'missing'), 'no bag at missing'
    yield 'no bag folder', (*bag_of, 'folder'), '(no .mcap or .db3 file is in it, only notes)'
    yield 'a chain as table', (*bag_of, 'broken.yaml'), 'but identify takes a table or a bag'
    yield 'no such robot', (*chain_of, 'ur10x'), 'valid: abb_irb120'
    yield 'no chain', (*chain_of, 'good.csv'), 'good.csv is no chain file (.yaml) or URDF'
    yield 'another number of joints', (*chain_of, 'franka_panda'), 'q7'
    yield 'a frame is no parameter', (*good, '--fixed', 'base.x'), 'fixed: true'
    yield 'nothing left', (*good, '--fixed', '*'), 'every parameter is fixed: nothing is left to'
    for wrong in ('0', '-1', '-1e-3', 'nan', 'inf', '300'):
        yield f'tolerance {wrong}', (*good, '--tolerance', wrong), '--tolerance must be between 0'
    yield (
        'heights in mm',
        (*good, '--sigma-touch', '50'),
        'at most 1, not 50 (standard deviation of',
    )
    yield ('useless option', (*good, '--sources', '/pose'), '--sources does not apply to a table')
    yield 'new base', (*good, '--new-base'), '--new-base needs --previous'
    yield 'growth', (*good, '--growth', '30'), '--growth needs --previous'
    for alone in (('--board', 'b'), ('--places', 'p'), ('--intrinsics', 'i'), ('--lens', 'given')):
        yield f'{alone[0]} alone', (*good, *alone), f'{alone[0]} needs --detections'
    yield 'corners of nothing', (*bag_of, '--detections', 'c.csv'), '--detections needs --board\n'
    yield 'an arm of images', (*chain_of, 'flange_pose'), 'flange_pose needs --detections'
    yield 'no serial', (*good, '--history', 'h'), '--history files results by serial number: add'
    yield 'a layout of nothing', (*good, '--joints-preset', 'kuka'), ' needs --joints'
    of_bag = (*bag_of, 'folder', '--joints-preset', 'kuka')
    yield 'a layout of nothing, beside a bag', of_bag, '--joints-preset needs --joints'
    yield 'a certificate nowhere', (*good, '--pdf'), '--pdf needs --out'
    yield 'a cone to nothing', ('plan', '--chain', 'ur5e', '--cone', '30'), 'needs --tracker'
    nothing = ('workspace', 'r', '--chain', 'ur5e', '--out', 'map', '--aim', 'worst')
    yield 'nothing to place', nothing, '--aim needs --task or --joint-box'
    for useless in (('--history', 'h'), ('--model', 'auto'), ('--folds', '3')):
        given = (*good, *useless, '--previous', 'r')
        yield f'useless {useless[0]}', given, f'{useless[0]} does not apply to --previous'
    for useless in (('--delay', '0.1'), ('--mode', 'continuous'), ('--largest-loss', '1')):
        yield f'useless {useless[0]}', (*good, *useless), f'{useless[0]} does not apply to a table'
    plan = ('plan', '--chain', 'ur5e')
    for useless in (('--draw', '9'), ('--criterion', 'o2'), ('--velocity', '2')):
        told = f'{useless[0]} does not apply to --iso9283'
        yield f'tests and {useless[0]}', (*plan, '--iso9283', *useless), told
    given = (*plan, '--candidates', 'none.csv', '--draw', '9')
    yield 'nothing drawn', given, '--draw does not apply to --candidates'
    yield 'nothing in the world', (*plan, '--world'), '--world needs --box or --tracker'
    given = ('export', 'none', '--chain', 'ur5e', '--out', 'e', '--tip-link', 'tool0')
    yield 'a link of nothing', given, '--tip-link needs --urdf'
    yield 'useless session', (*bag_of, 'folder', '--session', 'A'), 'does not apply to a bag\n'
    yield 'useless side', (*bag_of, 'folder', '--eye-in-hand'), ': add eye_in_hand=true to its --'
    names = ('--joint-names', 'a,a,b,c,d,e,f')
    yield 'joint names', (*bag_of, 'folder', *names), 'wrist_3_joint; not a, a, b, c, d, e, f'
    yield 'out is a file', (*good, '--out', 'empty'), 'empty'
    yield 'out is the root', (*good, '--out', '/'), '/ is the root folder: choose'
    yield 'csv2bag, bag exists', ('csv2bag', 'good.csv', 'folder', '--chain', 'ur5e'), 'exists al'
    yield 'simulate, bag exists', ('simulate', 'folder', '--chain', 'ur5e'), 'exists already'
    yield 'simulate, in place', ('simulate', '.', '--chain', 'ur5e'), '. exists already'
    yield 'plan, no name', ('plan', '--chain', 'ur5e', '--out', ''), '. is not a file'
    yield 'simulate, no poses', ('simulate', 'b', '--chain', 'ur5e', '--poses', '-1'), 'poses'
    yield 'simulate, seed', ('simulate', 'b', '--chain', 'ur5e', '--seed', '-1'), 'seed'
    yield 'no calibration', ('compare', 'none', 'none'), 'at none: give the folder written by ide'
    book = ('plan', '--chain', 'ur5e', '--candidates', 'poses.XLSX')
    yield 'a workbook of candidates', book, 'poses.XLSX: it is a workbook, expected a table as te'
    yield 'a folder as arm', (*chain_of, 'folder'), 'folder is a folder, no arm: '
    yield 'not accepted', ('compare', 'refused', 'none'), 'refused was not accepted'
    yield (
        'not accepted, named as a file',
        ('compare', 'refused/calibration.yaml', 'none'),
        'refused was not accepted',
    )
    yield 'a folder as calibration', ('compare', 'folder', 'none'), 'folder holds no calibration.y'
    yield 'a record of its own', ('compare', 'own.yaml', 'none'), 'by calib_ros identify or, where'
    yield 'a table as calibration', ('compare', 'good.csv', 'none'), 'is a table, but compare'
    yield 'an archive', (*bag_of, 'poses.zip'), 'is an archive, but identify takes a table or a b'
    yield 'a picture as chain', (*chain_of, 'shot.png'), 'shot.png is no chain file'
    yield (
        'a program of KUKA',
        (*bag_of, 'move.dat'),
        "move.dat is a program in a robot's own language, but identify takes a table or a bag: wr",
    )
    yield (
        'a program as joint values',
        (*bag_of, 'good.csv', '--joints', 'start.dtx'),
        "start.dtx is a program in a robot's own language, but --joints takes a table: write",
    )
    yield 'a program by its beginning', (*bag_of, 'good.csv', '--joints', 'part.dat'), 'but --jo'
    for given in ('rapid.txt', 'part.csv', 'fanuc.txt', 'universal.csv'):
        yield (
            f'a program in {given}',
            (*bag_of, 'good.csv', '--joints', given),
            'but --joints takes',
        )
    yield (
        'a program of KUKA to compensate',
        ('compensate', 'move.dat', '--chain', 'ur5e', '--calibration', 'none', '--out', 'o.csv'),
        'but compensate takes a JointTrajectory or a YAML file or a table: write its joint values',
    )
    yield 'no program', ('compare', 'start.dtx', 'none'), "start.dtx is a program in a robot's own"
    yield 'images as a table', (*bag_of, 'shots'), 'shots is a folder of images, but identify tak'
    yield 'a folder of tables', (*bag_of, 'tables'), 'or verify on the tables in it (FOLDER/*.csv)'
    yield 'a result as a table', (*bag_of, 'refused/result.json'), 'is a report, but identify'
    yield 'demo, into a file', ('demo', '--out', 'empty', '--poses', '5'), 'empty'


@pytest.mark.parametrize(
    ('arguments', 'complaint'), [pytest.param(*rest, id=name) for name, *rest in bad_inputs()]
)
def test_bad_input_is_one_clear_line(run, table, tmp_path, arguments, complaint):
    rows = rows_of(measured())
    table.rename(tmp_path / 'good.csv')
    write_csv(tmp_path / 'few.csv', rows[:3])
    write_csv(tmp_path / 'judging.csv', rows[TRAIN:])
    shutil.copy(tmp_path / 'good.csv', tmp_path / 'order.csv')
    names = sorted(load_chain('ur5e').joint_names)
    (tmp_path / 'order.settings.yaml').write_text(f'# joints: {json.dumps(names)}\n')
    (tmp_path / 'twice.csv').write_text('q1,q2,q3,q4,q5,q6,x,y,z,x\n0,0,0,0,0,0,1,2,3,4\n')
    own = 'q1,q2,q3,q4,q5,q6,x,y,z,before_x,after_x\n0,0,0,0,0,0,1,2,3,4,5\n'
    (tmp_path / 'left.csv').write_text(own)
    (tmp_path / 'link.csv').symlink_to('gone.csv')
    (tmp_path / 'empty').write_text('')
    (tmp_path / 'broken.yaml').write_text('joints: [\n')
    (tmp_path / 'own.yaml').write_text(dump_chain(load_chain('ur5e'), {'source': 'x'}))
    (tmp_path / 'move.dat').write_text('&ACCESS RVP\nDEFDAT MOVE\nENDDAT\n')
    (tmp_path / 'part.dat').write_text('DEFDAT MOVE\nDECL E6AXIS XP1={A1 1.0,A2 2.0}\nENDDAT\n')
    (tmp_path / 'rapid.txt').write_text('MODULE Cal\n  CONST jointtarget p1:=[[1,2]];\n')
    (tmp_path / 'part.csv').write_text('LOCAL VAR jointtarget j1 = j:{1.5,2.5  ,0 } {EJ 0}\n')
    (tmp_path / 'fanuc.txt').write_text('/PROG  CAL\n/POS\nP[1]{\n  J1= 1.0 deg\n};\n')
    (tmp_path / 'universal.csv').write_text('def cal():\n  movej([1.0, 2.0])\nend\n')
    (tmp_path / 'start.dtx').write_text('<?xml version="1.0"?><Database/>')
    (tmp_path / 'poses.XLSX').write_bytes(b'PK\3\4\0')
    (tmp_path / 'poses.zip').write_bytes(b'PK\3\4\0')
    (tmp_path / 'shot.png').write_bytes(b'\x89PNG\xff')
    for file in ('folder/notes', 'refused/result.json', 'shots/1.pgm', 'tables/monday.csv'):
        (tmp_path / file).parent.mkdir()
        (tmp_path / file).write_text('{}')
    status, _, err = run(*arguments)
    assert status == 1
    assert err.startswith('calib_ros: ')
    assert complaint in err
    assert err.count('\n') == 1
    assert err.endswith('\n')
