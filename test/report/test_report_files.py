# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Files that commands write beside a result: pages, on paper too, and what they carry."""

import hashlib
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from measured import UR, measured, rows_of, write_csv
from pages import Page, page_of, report_of
from verified import verification_page

from calib_ros.apply.verification import verify
from calib_ros.files.export import exports
from calib_ros.identification.calibration import Calibration
from calib_ros.kinematics.chain_file import dump_chain, parse_chain, table_hash
from calib_ros.report.content import Origin
from calib_ros.report.documents import as_document
from calib_ros.report.markdown import markdown
from calib_ros.report.page import on_paper, render

IDENTIFY = ('identify', 'cell.csv', '--chain', 'ur5e')


def test_exported_files_carry_the_hash_of_the_table(solved):
    _, result = solved
    digest = table_hash(result.chain)
    assert table_hash(parse_chain(dump_chain(result.chain))) == digest
    assert digest != table_hash(UR)
    for each in exports(result.chain, UR):
        assert digest in each.content, each.name


def test_identify_writes_what_it_was_told(table, run, tmp_path):
    operator, serial = 'Å. Smith', 'Å 12'
    told = ('--operator', operator, '--device', 'tracker 7', '--serial', serial)
    told = [text.encode().decode('ascii', 'surrogateescape') for text in told]  # of a C locale
    told += ('--conditions', '21 °C, 5 kg', '--history', 'history')
    status, said, _ = run(*IDENTIFY, *told, '--out', 'out', '--tolerance', 5, '--pdf')
    assert status == 0
    assert 'Accepted and within the tolerance of 5 mm RMS' in said
    out = tmp_path / 'out'
    content = (out / 'report.pdf').read_bytes()
    assert content.startswith(b'%PDF')
    assert len(content) < 2e6
    text = (out / 'report.html').read_text()
    page = Page(text)
    shown = re.search(r'<pre[^>]*>(/\*\*:.*?)</pre>', text, re.DOTALL)[1]  # to be copied
    written = (out / 'settings.yaml').read_text()
    assert yaml.safe_load(shown.replace('&#39;', "'")) == yaml.safe_load(written)
    digest = hashlib.sha256(table.read_bytes()).hexdigest()
    told = (f'ur5e {serial}', operator, 'tracker 7', '21 °C, 5 kg', digest, 'tolerance of 5 mm')
    for text in told:
        assert text in page.text
    assert page.data['explorer']['lines']
    document = json.loads((out / 'result.json').read_text())
    assert document['origin']['operator'] == operator
    assert f"--operator '{operator}'" in document['origin']['command']
    assert document['origin']['inputs'][0]['sha256'] == digest
    assert document['tolerance_mm'] == 5.0
    shown = re.search('[0-9a-f]{64}', page.text)[0]
    assert f'table_sha256: {shown}' in (out / 'calibration.yaml').read_text()
    assert document['table_sha256'] == shown


def of_the_certificate(report, monkeypatch):
    """Return the pages of a certificate without what follows it, and its texts."""
    weasyprint = pytest.importorskip('weasyprint')
    printed, pages = weasyprint.HTML.write_pdf, []
    monkeypatch.setattr(
        weasyprint.HTML, 'write_pdf', lambda self: pages.extend(self.render().pages) or b''
    )
    origin = Origin(operator='A. Smith', serial=300 * '7')
    alone = replace(report, sections=(), origin=origin)
    on_paper(alone)
    monkeypatch.setattr(weasyprint.HTML, 'write_pdf', printed)
    return pages


def test_the_keys_of_a_result_are_documented(solved):
    told = as_document(solved[1], {})
    nested = ('fitted', 'noise_in_sigma', 'predicted_sigma_mm', 'region', 'validation')
    names = {*told, *(key for name in nested for key in told[name])}
    formats = (Path(__file__).parents[2] / 'docs/formats.md').read_text()
    assert [name for name in sorted(names) if f'`{name}`' not in formats] == []


def test_a_number_is_not_parted_from_its_unit(solved):
    page, _, _ = render(report_of(*solved, tolerance=1e-3)).partition('<script')
    assert '95\xa0% interval' in page
    assert not re.search(r'\d (?:%|mm|mrad)', page)


def test_a_long_serial_number_is_a_short_title(solved):
    """At the foot of each sheet it covered the number of the page."""
    report = replace(report_of(*solved), origin=Origin(serial=300 * '7'))
    assert len(report.title) == 60
    assert report.title.startswith('ur5e 7')


def test_a_certificate_is_one_sheet(solved, monkeypatch):
    note = 'Poses measured in succession have similar errors. ' * 4
    report = report_of(*solved, warnings=(note, note), tolerance=1e-3)
    assert len(of_the_certificate(report, monkeypatch)) == 1
    refused = replace(report.verdict, state='bad')
    assert len(of_the_certificate(replace(report, verdict=refused), monkeypatch)) == 1


def test_who_signs_reads_what_is_not_given(solved):
    report = report_of(*solved)
    known = ('Serial number', '7'), ('Operator', 'A. Smith'), ('Measuring device', 'T')
    report = replace(report, identity=known)
    assert 'Not given: conditions.' in page_of(report).text
    given = replace(report, identity=(*known, ('Conditions', '21 °C')))
    assert 'Not given' not in page_of(given).text


def test_the_figures_of_the_standard_are_on_the_certificate(solved, monkeypatch):
    _, result = solved
    chosen = np.tile(np.arange(20), 3)
    sets = (measured(count=20, seed=8).select(chosen),)
    found = verify(Calibration.of(result), sets, 1e-3, commanded=sets[0].joints[:20])
    report = verification_page(result.chain, sets, found)
    assert found.by_program
    assert report.picture.head[2:] == ('AP before', 'AP after', 'RP')
    assert len(report.picture.rows) == 20
    text = page_of(report).text
    assert text.index('AP before') < text.index('Identity') < text.index('Share of')
    assert '| P5 |' in markdown(report, {})
    assert len(of_the_certificate(report, monkeypatch)) == 1


@pytest.mark.usefixtures('table')
def test_without_its_extra_the_other_files_are_written(run, tmp_path, monkeypatch):
    for name in ('jinja2', 'weasyprint'):
        monkeypatch.setitem(sys.modules, name, None)
    status, told, said = run(*IDENTIFY, '--out', 'out', '--pdf')
    assert status == 0
    assert told.endswith('wrote out\n')  # nothing to open
    assert said.count('\n') == 2
    assert 'calib_ros[report]' in said
    assert 'calib_ros[pdf]' in said
    names = {path.name for path in (tmp_path / 'out').iterdir()}
    assert not {'report.html', 'report.pdf'} & names
    assert {'calibration.yaml', 'residuals.csv', 'report.md'} <= names


def test_the_other_commands_write_their_pages(solved, run, tmp_path):
    (tmp_path / 'calibration.yaml').write_text(Calibration.of(solved[1]).dump())
    write_csv(tmp_path / 'new.csv', rows_of(measured(seed=8, count=12), held_out=0))
    judged = ('--calibration', 'calibration.yaml', '--tolerance', 1, '--out', 'verified')
    status, told, _ = run('verify', 'new.csv', '--chain', 'ur5e', *judged)
    assert (status, told.splitlines()[-1][:14]) == (0, 'wrote verified')
    assert 'PASS' in Page((tmp_path / 'verified' / 'report.html').read_text()).text
    assert (tmp_path / 'verified' / 'residuals.csv').read_text().count('\n') == 13
    planned = ('plan', '--chain', 'ur5e', '--poses', 12, '--draw', 60, '--out', 'plan.csv')
    assert run(*planned)[0] == 0
    page = Page((tmp_path / 'plan.report.html').read_text())
    assert 'Poses to measure 12 poses. Predicted' in ' '.join(page.text.split())
    *_, last = page.data['figures']['promise']['data'][0]['y']
    assert f'RMS position error: {last:.3f} mm' in page.text
    assert run(*planned)[0] == 1
