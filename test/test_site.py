# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""The site: what its tutorials tell to do is done, and nothing is missing."""

import importlib.util
import re
import shlex
from pathlib import Path

import pytest
import yaml

import calib_ros
from calib_ros.cli.main import main
from calib_ros.decision.reasons import Rule
from calib_ros.report.refusals import rules

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
        for line in code.replace('\\\n', ' ').splitlines():
            program, *arguments = shlex.split(line)
            assert program == 'calib_ros'
            arguments = [each for each in arguments if each != '--pdf']  # slow; test/report does
            assert main(arguments) == 0, capsys.readouterr().err


@pytest.mark.parametrize('page', extract.PAGES, ids=lambda page: page.stem)
def test_examples_hold_what_the_tutorials_say(page):
    for path, text in extract.examples(page).items():
        assert path.read_text() == text, f'run python {extract.__file__}'


def test_every_refusal_and_every_public_name_has_its_place():
    assert {*rules()} == {*Rule}
    reference = (ROOT / 'docs/api.md').read_text()
    for name in calib_ros.__all__:
        assert f'.{name}\n' in reference


def test_lines_are_as_wide_as_those_of_the_code():
    pages = *(ROOT / 'docs').rglob('*.md'), ROOT / 'README.md', ROOT / 'CHANGELOG.rst'
    lines = (line for page in pages for line in page.read_text().splitlines())
    assert [line for line in lines if len(line) > 99 and not line.startswith('|')] == []


def test_every_page_is_in_the_site():
    site = yaml.safe_load((ROOT / 'mkdocs.yml').read_text())
    listed = re.findall(r"'([\w/]+\.md)'", str(site['nav']))
    pages = (ROOT / 'docs').rglob('*.md')
    assert sorted(listed) == sorted(str(each.relative_to(ROOT / 'docs')) for each in pages)
