# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A table that is longer each night."""

import plants
import pytest
from distributed import LocalCluster

from calib_ros.files.history import History
from calib_ros.fleet.plant import read_plant
from calib_ros.fleet.run import Cluster, run
from calib_ros.fleet.status import statuses


@pytest.mark.parametrize('upgraded', [False, True])
def test_each_pose_of_a_table_that_grows_counts_in_one_night(tmp_path, monkeypatch, upgraded):
    path = plants.write_plant(tmp_path, ('A',), 5, bumps={'A': (3, {'elbow_joint.d': 3e-4})})
    place = tmp_path / 'nights/A'
    nights = [(place / f'{k:03}.csv') for k in range(5)]
    texts = [night.read_text() for night in nights]
    for night in nights:
        night.unlink()
    plant, history, out = read_plant(path), History(tmp_path / 'history'), tmp_path / 'report'
    with LocalCluster(1, threads_per_worker=1, processes=False, dashboard_address=None) as local:
        for k, text in enumerate(texts):
            with (place / 'all.csv').open('a') as file:
                file.write(text.partition('\n')[2] if k else text)
            if upgraded and k == 4:
                monkeypatch.setattr('calib_ros.__version__', '9.9.9')
            found = run(plant, history, Cluster(local.scheduler_address), out)
        pages = {each.name: each for each in out.glob('robots/*/*.html')}
        (page,) = pages.values()
        content = page.read_text()
        page.unlink()
        run(plant, history, Cluster(local.scheduler_address), out)
        for text in (content, page.read_text()):
            assert 'were counted before: 30 others are used' in text
    rows = history.rows('A')
    assert [(row.time, row.poses) for row in rows] == [(plants.when(k), 30) for k in range(5)]
    assert rows[0].remarks == () != rows[1].remarks
    told = 'its poses up to 2025-10-09 08:53 UTC were counted before: 30 others are used'
    assert rows[1].remarks[0] == told
    (status,) = statuses(plant, history, found, 100.0)
    (change,) = status.watched.changes
    assert (change.time, change.pair) == (plants.when(3), ())
    assert 'elbow_joint.d' in str(change)
