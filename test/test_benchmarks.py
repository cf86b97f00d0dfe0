# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Benchmarks are not run by the tests, but all that they use is there."""

import ast
import runpy
import sys
from pathlib import Path
from types import ModuleType

import pytest

BENCHMARKS = Path(__file__).parents[1] / 'benchmarks'


@pytest.mark.parametrize('name', sorted(path.name for path in BENCHMARKS.glob('*.py')))
def test_all_that_a_benchmark_uses_is_there(name, monkeypatch):
    monkeypatch.setattr(sys, 'path', [str(BENCHMARKS), *sys.path])
    known = runpy.run_path(str(BENCHMARKS / name))
    for node in ast.walk(ast.parse((BENCHMARKS / name).read_text())):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            owner = known.get(node.value.id)
            assert not isinstance(owner, ModuleType) or hasattr(owner, node.attr), node.attr


def test_figures_are_rows_of_short_tables(monkeypatch, capsys):
    monkeypatch.setattr(sys, 'path', [str(BENCHMARKS), *sys.path])
    tell = runpy.run_path(str(BENCHMARKS / 'bench.py'))['tell']
    rows = [{'model': 'none', 'rms': 1.0}, {'model': 'auto', 'rms': 0.5, 'chosen': ['x', 'y']}]
    apart = {'speed': {'ours': 2}, 'models': rows, 'ratio': {'rms': 3}, 'steps': {'rms': 4}}
    tell(apart | {'listed': [('A', 0.12345), ('B', 6)]}, False)
    assert [' '.join(line.split()) for line in capsys.readouterr().out.splitlines()] == [
        *('listed A, 0.1235', 'listed B, 6'),
        *('ours', 'speed 2'),
        *('rms', 'ratio 3', 'steps 4'),
        *('', 'models', 'rms chosen', 'none 1 -', 'auto 0.5 x, y'),
    ]
