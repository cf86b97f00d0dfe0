# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""`identify --previous`, night after night."""

import json
from dataclasses import replace

import numpy as np
import pytest
from fits import UR10E, problem
from measured import rows_of, write_csv

from calib_ros.identification.calibration import parse_calibration


def test_the_command_writes_the_calibration_brought_up_to_date(earlier, run, tmp_path):
    true, previous = earlier
    (tmp_path / 'earlier.yaml').write_text(previous.dump())
    seen = problem(true.with_offsets({'elbow_joint.theta': 5e-4}), 8, 1).observations
    write_csv(tmp_path / 'few.csv', rows_of(seen, 0))
    given = ['identify', 'few.csv', '--chain', 'ur10e']
    given += ['--sigma-position', '5e-5', '--sigma-orientation', '2e-4', '--previous']
    status, said, _ = run(*given, 'earlier.yaml', '--out', 'out')
    assert status == 0
    assert 'elbow_joint.theta by +0.' in said
    for name in ('report.html', 'report.md'):
        page = (tmp_path / 'out' / name).read_text()
        assert 'The calibration is brought up to date'.lower() in page.lower()
        assert 'elbow' in page
        assert 'RMS position error' in page
    assert len((tmp_path / 'out' / 'residuals.csv').read_text().splitlines()) == 9
    document = json.loads((tmp_path / 'out' / 'result.json').read_text())
    assert document['changed'][0][0]['owner'] == 'elbow_joint'
    text = (tmp_path / 'out' / 'calibration.yaml').read_text()
    read = parse_calibration(text, 'c.yaml', UR10E)
    assert read.record['previous']['table_sha256'] == previous.record['table_sha256']
    assert read.record['table_sha256'] != previous.record['table_sha256']
    assert read.chain.value('elbow_joint.theta') == pytest.approx(
        previous.chain.value('elbow_joint.theta') + 5e-4, abs=1e-4
    )
    status, said, _ = run(*given, 'out', '--out', 'again')
    assert status == 3
    assert 'The calibration was fitted to these measurements' in ' '.join(said.split())
    assert not (tmp_path / 'again' / 'calibration.yaml').exists()
    assert 'fitted to these measurements' in (tmp_path / 'again' / 'report.md').read_text()
    status, _, told = run(*given, 'again')
    assert (status, 'again/report.html says why' in told) == (1, True)
    # over what it brings up to date, which is that of the next night too
    (tmp_path / 'out' / 'report.html').write_text('of what stays')
    assert run(*given, 'out', '--out', 'out', '--force')[0] == 3
    assert (tmp_path / 'out' / 'calibration.yaml').read_text() == text
    status, said, _ = run(*given, 'out', '--out', 'out', '--force')
    assert (status, said.split()[-1]) == (3, 'out/result.json')  # not the page of what stays
    assert (tmp_path / 'out' / 'report.html').read_text() == 'of what stays'
    # over that of another robot
    (tmp_path / 'again' / 'calibration.yaml').write_text('another')
    assert run(*given, 'out', '--out', 'again', '--force')[0] == 3
    assert (tmp_path / 'again' / 'calibration.previous.yaml').read_text() == 'another'
    assert not (tmp_path / 'again' / 'calibration.yaml').exists()


def test_a_bag_with_too_much_lost_updates_nothing(earlier, run, tmp_path):
    """As it gives no calibration: what is missing may be the poses that matter."""
    true, previous = earlier
    (tmp_path / 'earlier.yaml').write_text(previous.dump())
    write_csv(tmp_path / 'few.csv', rows_of(problem(true, 20, 1).observations, 0))
    assert run('csv2bag', 'few.csv', 'bag', '--chain', 'ur10e')[0] == 0
    (file,) = (tmp_path / 'bag').glob('*.mcap')
    file.write_bytes(file.read_bytes()[: int(0.6 * file.stat().st_size)])
    given = ('identify', 'bag', '--chain', 'ur10e', '--sigma-position', '5e-5')
    given += ('--sigma-orientation', '2e-4', '--previous', 'earlier.yaml')
    status, _, told = run(*given)
    assert (status, 'of the messages could not be read: accept the rest with' in told) == (1, True)
    assert run(*given, '--largest-loss', '0.5')[0] == 0


def test_no_report_of_the_earlier_calibration_stays_beside_its_update(earlier, run, tmp_path):
    true, previous = earlier
    (tmp_path / 'out').mkdir()
    (tmp_path / 'out' / 'calibration.yaml').write_text(previous.dump())
    earlier_files = ('report.html', 'report.pdf', 'residuals.csv', 'before_after.png', 'my.txt')
    for name in earlier_files:
        (tmp_path / 'out' / name).write_text('of the earlier one')
    write_csv(tmp_path / 'few.csv', rows_of(problem(true, 8, 1).observations, 0))
    given = ['identify', 'few.csv', '--chain', 'ur10e', '--sigma-position', '5e-5']
    given += ['--sigma-orientation', '2e-4', '--previous', 'out', '--out', 'out', '--force']
    assert run(*given)[0] == 0
    found = {each.name: each.read_bytes() for each in (tmp_path / 'out').iterdir()}
    assert {'calibration.yaml', 'result.json', 'report.html', 'residuals.csv'} < found.keys()
    assert [name for name, text in found.items() if text == b'of the earlier one'] == ['my.txt']


def test_the_calibration_of_another_serial_number_is_not_brought_up_to_date(
    earlier, run, tmp_path
):
    true, previous = earlier
    write_csv(tmp_path / 'few.csv', rows_of(problem(true, 8, 1).observations, 0))
    (tmp_path / 'earlier.yaml').write_text(previous.dump())
    given = ['identify', 'few.csv', '--chain', 'ur10e', '--sigma-position', '5e-5']
    given += ['--sigma-orientation', '2e-4', '--previous']
    assert run(*given, 'earlier.yaml', '--out', 'out', '--serial', '0042')[0] == 0  # none recorded
    for serial in ('0043', '42'):
        status, _, told = run(*given, 'out', '--serial', serial)
        assert status == 1
        assert f'serial "0042"; this one is "{serial}"' in told
    assert run(*given, 'out', '--out', 'again')[0] == 3  # the same poses
    for name in ('report.md', 'report.html'):
        assert '0042' in (tmp_path / 'again' / name).read_text()


@pytest.mark.parametrize(('day', 'status'), [('2025-03-01', 0), ('2025-03-09', 1)])
def test_a_calibration_by_newer_poses_is_not_brought_up_to_date(
    earlier, run, tmp_path, day, status
):
    true, previous = earlier
    measured = {**previous.record, 'measured': f'{day}T22:00:00+00:00'}
    (tmp_path / 'earlier.yaml').write_text(replace(previous, record=measured).dump())
    stamps = 1_741_000_000_000_000_000 + 10**9 * np.arange(8)  # 2025-03-03
    rows = rows_of(problem(true, 8, 1).observations, 0)
    stamped = [{**row, 'stamp_ns': stamp} for row, stamp in zip(rows, stamps, strict=True)]
    write_csv(tmp_path / 'few.csv', stamped)
    given = ('identify', 'few.csv', '--chain', 'ur10e', '--previous', 'earlier.yaml')
    found, _, told = run(*given, '--sigma-position', '5e-5', '--sigma-orientation', '2e-4')
    assert found == status
    assert ('measured on 2025-03-03, before those' in told) == bool(status)
