# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The pages of docs/tutorials: what they tell to do is done, in a folder of its own."""

import importlib.util
import shlex
from pathlib import Path

import pytest

from calib_ros.cli.main import main

ROOT = Path(__file__).parents[1]
_SPEC = importlib.util.spec_from_file_location('extract', ROOT / 'examples/tutorials/extract.py')
extract = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(extract)


@pytest.mark.parametrize('page', extract.PAGES, ids=lambda page: page.stem)
def test_a_tutorial_does_what_it_says(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = extract.blocks(page)
    assert blocks
    for language, code in blocks:
        if language == 'python':
            exec(compile(code, f'{page.name}', 'exec'), {'__name__': '__main__'})
            continue
        for line in code.splitlines():
            program, *arguments = shlex.split(line)
            assert program == 'calib_ros'
            assert main(arguments) == 0, capsys.readouterr().err


@pytest.mark.parametrize('page', extract.PAGES, ids=lambda page: page.stem)
def test_examples_hold_what_the_tutorials_say(page):
    for path, text in extract.examples(page).items():
        assert path.read_text() == text, f'run python {extract.__file__}'
