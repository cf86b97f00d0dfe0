# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
from datetime import datetime, timezone
from pathlib import Path

import pytest

from calib_ros.errors import ConfigError
from calib_ros.fleet.plant import Pattern, parse_plant, read_plant
from calib_ros.fleet.source_files import sources
from calib_ros.kinematics.chain_file import dump_chain, load_chain
from calib_ros.settings import Settings

PLANT = """
groups:
  weld:
    chain: ur10e
    tolerance: 0.3
    settings: {sigma_position: 5e-5, fixed: [joint_2.a], folds: 4}
robots:
  - serial: "0042"
    group: weld
    measured: nights/0042/*.csv
    settings: {folds: 6, fixed: []}
    since: 2026-11-20
  - serial: B
    chain: own.yaml
    measured: ['s3://bags/B/*', {files: both.csv, session: A}]
    largest_loss: 0.2
"""


def test_robots_with_what_their_group_says(tmp_path):
    (tmp_path / 'own.yaml').write_text(dump_chain(load_chain('ur5e')))
    (tmp_path / 'plant.yaml').write_text(PLANT)
    first, second = read_plant(tmp_path / 'plant.yaml')
    assert (first.serial, first.chain.name, first.tolerance) == ('0042', 'ur10e', 0.3)
    assert first.settings == Settings(sigma_position=5e-5, folds=6)
    assert first.measured == (Pattern(str(tmp_path / 'nights/0042/*.csv')),)
    assert first.since == datetime(2026, 11, 20, tzinfo=timezone.utc)
    assert second.chain.name == 'ur5e'
    assert second.settings == Settings()
    assert second.measured == (Pattern('s3://bags/B/*'), Pattern(str(tmp_path / 'both.csv'), 'A'))
    assert (second.tolerance, second.largest_loss, second.since) == (None, 0.2, None)
    assert first.settings_hash != second.settings_hash


@pytest.mark.parametrize(
    ('old', 'new', 'match'),
    [
        ('measured: nights', 'mesured: nights', r'robot 1.*"mesured".*did you mean "measured"'),
        ('group: weld', 'group: wield', r'\(0042\): unknown group "wield".*did you mean "weld"'),
        ('sigma_position', 'sigma_positoin', r'robot 1 .*did you mean "sigma_position"'),
        ('tolerance: 0.3', 'tolerence: 0.3', r'group weld.*did you mean "tolerance"'),
        ('session: A', 'sesion: A', r'robot 2 \(B\).*did you mean "session"'),
        ('robots:', 'robot:', r'did you mean "robots"'),
        ('"0042"', '0042', r'robot 1: serial must be text'),
        ('serial: B', 'serial: "0042"', r'two robots with the serial 0042'),
        ('folds: 6', 'folds: 6.5', r'folds must be a whole number'),
        ('folds: 6', 'folds: 1', r'robot 1 .*folds must be at least 2'),
        ('fixed: []', 'fixed: [1]', r'fixed must be a list of strings'),
        ('group: weld', 'group: [weld]', r'robot 1 \(0042\).*"\[\'weld\'\]".*did you mean "weld"'),
        ('"0042"', '..', r'robot 1: serial must be text'),
        ('"0042"', 'ö' * 60, r'robot 1: serial is too long to name a folder'),
        ('tolerance: 0.3', 'tolerance: -1', r'tolerance must be positive'),
        ('largest_loss: 0.2', 'largest_loss: 20', r'largest_loss must be from 0 to 1'),
        ('2026-11-20', 'yesterday', r"since must be a date.*'yesterday'"),
        ('2026-11-20', '3026-11-20', r'since is in the future, .* compared: 3026-11-20'),
        ('chain: own.yaml', 'chain: 5', r'robot 2 \(B\): give chain'),
        ('measured: nights/0042/*.csv', 'measured: []', r'measured must be a pattern'),
    ],
)
def test_mistakes_are_named(tmp_path, old, new, match):
    (tmp_path / 'own.yaml').write_text(dump_chain(load_chain('ur5e')))
    assert old in PLANT
    with pytest.raises(ConfigError, match=match):
        parse_plant(PLANT.replace(old, new), tmp_path)


@pytest.mark.parametrize('text', ['', 'robots: []', 'robots: {a: 1}', '[1]', 'robots: [1]'])
def test_no_plant(text):
    with pytest.raises(ConfigError, match='must be'):
        parse_plant(text, Path())


def test_the_name_of_the_folder_is_no_pattern(tmp_path):
    folder = tmp_path / 'hall [A]'
    folder.mkdir()
    (folder / '1.csv').touch()
    (robot,) = parse_plant('robots: [{serial: a, chain: ur10e, measured: "*.csv"}]', folder)
    (found,), wrong = sources(robot)
    assert (found.url, wrong) == (str(folder / '1.csv'), {})
