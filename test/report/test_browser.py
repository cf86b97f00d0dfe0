# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Pages of reports in a real Chromium: what a reader sees and can do."""

import json
import os
import re
from dataclasses import replace

import numpy as np
import plants
import pytest
from browser import browser, browser_path
from measured import measured, rows_of, write_csv
from pages import report_of

from calib_ros.apply.simulation import measure
from calib_ros.cli.main import main
from calib_ros.decision.reasons import Reason, Rule
from calib_ros.estimation.problem import Problem
from calib_ros.identification.identification import identify
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.report import explorer
from calib_ros.report.page import render
from calib_ros.shown import moment

pytestmark = pytest.mark.skipif(
    browser_path() is None and 'CI' not in os.environ,
    reason='no Chromium here: apt install chromium (in CI it is required)',
)

CONTRAST = """() => {
  const curve = (v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  const channel = (v) => curve(v / 255);
  const light = (c) => 0.2126 * channel(c[0]) + 0.7152 * channel(c[1]) + 0.0722 * channel(c[2]);
  const parts = (text) => text.match(/[\\d.]+/g).map(Number);
  const found = [];
  for (const each of document.querySelectorAll('body *')) {
    const own = [...each.childNodes].some((n) => n.nodeType === 3 && n.textContent.trim());
    if (!own || each.disabled || !each.checkVisibility()) continue;
    const style = getComputedStyle(each);
    const ink = parts(each instanceof SVGElement ? style.fill : style.color);
    let under = [255, 255, 255];
    for (let e = each; e; e = e.parentElement) {
      const c = parts(getComputedStyle(e).backgroundColor);
      if (c.length < 4 || c[3] > 0) { under = c; break; }
    }
    const [a, b] = [light(ink), light(under)].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05);
    if (ratio < 4.5) found.push([each.tagName, each.textContent.slice(0, 40), ratio]);
  }
  return found;
}"""
REACHED = """() => [...document.querySelectorAll('button, select, input, summary, .scroll, pre')]
  .filter((e) => e.checkVisibility() && !e.disabled && e.type !== 'radio')
  .map((e, k) => { e.dataset.k = k; return k; }).length"""


@pytest.fixture(scope='module')
def result(tmp_path_factory):
    """Return the folder of a result with an outlier."""
    folder = tmp_path_factory.mktemp('browser')
    rows = rows_of(measured())
    rows[3]['x'] += 0.02
    table = write_csv(folder / 'measured.csv', rows)
    out = folder / 'out'
    arguments = ['identify', '--csv', str(table), '--chain', 'ur5e', '--out', str(out)]
    assert main([*arguments, '--operator', 'A. Smith', '--tolerance', '0.5']) == 0
    return out


@pytest.fixture(scope='module')
def chromium():
    with browser() as started:
        yield started


class Seen:
    """A page, what it complained about, and what it asked the network for."""

    def __init__(self, chromium, path, width):
        self.page = chromium.new_page()
        self.page.set_viewport_size({'width': width, 'height': 800})
        self.faults, self.requests = [], []
        self.page.on('pageerror', lambda error: self.faults.append(str(error)))
        self.page.on('console', self._said)
        self.page.on('request', lambda request: self.requests.append(request.url))
        self.page.goto(path.as_uri())

    def _said(self, message):
        if message.type == 'error':
            self.faults.append(message.text)

    def drawn(self):
        """Wait for all figures, which come one by one unless they are looked at."""
        self.page.wait_for_function(
            "[...document.querySelectorAll('div.plot')].every((e) => e.querySelector('.main-svg'))"
        )

    @property
    def overflow(self):
        return self.page.evaluate('document.documentElement.scrollWidth - innerWidth')

    def end(self):
        self.page.close()
        assert self.faults == []
        assert [u for u in self.requests if not u.startswith(('file:', 'data:', 'blob:'))] == []
        assert sum(url.startswith('file:') for url in self.requests) == 1


@pytest.fixture(scope='module')
def wide(chromium, result):
    seen = Seen(chromium, result / 'report.html', 1280)
    seen.drawn()
    yield seen
    seen.end()


def test_the_numbers_are_those_of_the_result(wide, result):
    document = json.loads((result / 'result.json').read_text())
    text = wide.page.inner_text('main').replace('\xa0', ' ')
    for when in ('before', 'after'):
        assert f'{document["validation"][when]["rms_mm"]:.3f} mm (' in text
        for name in ('rms_mm', 'mean_mm', 'max_mm', 'mean_plus_3_sigma_mm', 'rms_mrad'):
            assert f'{document["validation"][when][name]:.3f}' in text


def test_all_text_can_be_read(wide):
    assert wide.page.evaluate(CONTRAST) == []
    assert wide.overflow <= 0


def test_the_switch_colours_the_points_by_the_error_before(wide):
    colours = "document.getElementById('space').data[0].marker.color"
    after = wide.page.evaluate(colours)
    wide.page.check('input[value=before]')
    before = wide.page.evaluate(colours)
    assert len(before) == len(after) == 39
    assert np.mean(before) > 5.0 * np.mean(after)
    wide.page.check('input[value=after]')
    assert wide.page.evaluate(colours) == after


def test_the_slider_scales_the_vectors(wide):
    ends = (
        "(() => { const t = document.getElementById('space').data[2]; return t.x[1] - t.x[0]; })()"
    )
    slider = wide.page.locator('#scale')
    slider.focus()
    drawn = wide.page.evaluate(ends)
    assert 0.01 < abs(drawn) < 0.3  # of an arm that reaches a metre
    slider.press('Home')
    assert wide.page.inner_text('#scale-value').startswith('1 ')
    assert 10.0 < drawn / wide.page.evaluate(ends) < 1e4  # times the error itself


def test_a_gross_error_does_not_flatten_the_figures(unsearched, chromium, tmp_path):
    rows = rows_of(measured())
    rows[3]['x'] += 8.0
    table, out = write_csv(tmp_path / 'measured.csv', rows), tmp_path / 'out'
    assert main(['identify', '--csv', str(table), '--chain', 'ur5e', '--out', str(out)]) == 0
    seen = Seen(chromium, out / 'report.html', 1280)
    seen.drawn()
    session, space = (
        seen.page.evaluate(
            f"document.getElementById('{name}').data"
            f'.map((t) => [...t.{axis}].filter(Number.isFinite))'
        )
        for name, axis in (('session', 'y'), ('space', 'x'))
    )
    good, (far,) = session[:2], session[2]
    assert max(max(good)) < far < 3.0 * max(map(max, good)) < 50.0
    assert '8000' in seen.page.evaluate("document.getElementById('session').data[2].text[0]")
    assert np.abs(np.concatenate(space)).max() < 3.0
    seen.end()


def test_a_row_picks_the_pose_and_a_point_its_row(wide, result):
    page = wide.page
    page.click('#next')
    button = page.locator('#rows tbody button').first
    assert button.inner_text() == 'line 14'
    button.focus()
    button.press('Enter')
    assert page.inner_text('#rows tr.picked button') == 'line 14'
    tip, there = page.evaluate(
        '(() => { const c = window.calibRos; const T = c.frames(12).at(-1);'
        ' return [[T[0][3], T[1][3], T[2][3]], c.position(12)]; })()'
    )
    assert tip == pytest.approx(there, abs=1e-6)  # what the page draws is the arm
    mark = page.evaluate(
        "(() => { const t = document.getElementById('space').data[7]; return [t.x, t.y, t.z]; })()"
    )
    assert np.ravel(mark) == pytest.approx(there)
    page.evaluate(
        "document.getElementById('space').emit('plotly_click',"
        ' {points: [{customdata: 3, curveNumber: 1}]})'
    )
    assert page.inner_text('#rows tr.picked button') == 'line 5'
    assert 'line 5' in page.inner_text('#picked')
    assert 'an outlier' in page.inner_text('#picked')


def test_the_hand_of_a_palletiser_is_drawn_level(chromium, tmp_path):
    """It was drawn at the values reported of coupled joints, a third of a metre off."""
    arm = load_chain('kuka_youbot')
    hand = replace(arm.joints[3], lower=0.0, upper=0.0)
    coupled = (('arm_joint_4.coupling_arm_joint_2', -1.0),)
    arm = replace(arm, joints=(*arm.joints[:3], hand, *arm.joints[4:]), effects=coupled)
    rows = measure(arm, arm.random_joints(40, np.random.default_rng(1)), np.random.default_rng(2))
    problem = Problem(arm, rows)
    path = tmp_path / 'report.html'
    path.write_text(render(report_of(problem, identify(problem))))
    seen = Seen(chromium, path, 1280)
    tips = '[...Array(40).keys()].map((i) => c.frames(i).at(-1).slice(0, 3).map((row) => row[3]))'
    drawn, there = seen.page.evaluate(
        f'(() => {{ const c = window.calibRos; return [{tips},'
        ' [...Array(40).keys()].map((i) => c.position(i))]; })()'
    )
    np.testing.assert_allclose(drawn, there, rtol=0, atol=1e-6)
    seen.end()


@pytest.mark.parametrize('way', ['left', 'right', 'up', 'down'])
def test_the_arrows_turn_the_view(wide, way):
    eye = "Object.values(document.getElementById('space').layout.scene.camera.eye)"
    before = wide.page.evaluate(eye)
    wide.page.click(f'[data-turn={way}]')
    after = wide.page.evaluate(eye)
    assert np.linalg.norm(np.subtract(after, before)) > 0.1
    assert np.linalg.norm(after) == pytest.approx(np.linalg.norm(before))


def test_the_list_shows_the_largest_errors_first_and_outliers_alone(wide):
    page = wide.page
    page.select_option('#sort', 'after')
    assert page.inner_text('#rows tbody tr:first-child button') == 'line 5'
    shown = [float(cell) for cell in page.locator('#rows tbody td:nth-child(3)').all_inner_texts()]
    assert shown == sorted(shown, reverse=True)
    page.check('#only')
    assert page.locator('#rows tbody tr').count() == 1
    page.uncheck('#only')


def test_the_components_are_chosen(wide):
    page = wide.page
    page.select_option('#component', 'angle')
    page.wait_for_function(
        "document.getElementById('session').layout.yaxis.title.text.includes('mrad')"
    )
    texts = page.locator('#joints .xtitle').all_text_contents()
    assert 'shoulder_pan_joint' in ' '.join(texts)
    page.check('#alone')
    for figure in ('session', 'joints'):
        names = page.evaluate(f"document.getElementById('{figure}').data.map((t) => t.name)")
        assert set(names) == {'after', 'outliers'}
    page.uncheck('#alone')


def test_the_keyboard_reaches_everything(wide):
    page = wide.page
    page.evaluate('document.activeElement.blur(); window.scrollTo(0, 0)')
    wanted = page.evaluate(REACHED)
    reached = set()
    for _ in range(2 * wanted):
        page.keyboard.press('Tab')
        found = page.evaluate('document.activeElement.dataset.k')
        reached.add(found)
        if len(reached - {None}) == wanted:
            break
    assert len(reached - {None}) == wanted


def printed_height(page):
    """Return how much of a sheet the certificate takes; the page stays as printed."""
    page.emulate_media(media='print')
    page.set_viewport_size({'width': 688, 'height': 1000})  # A4 without its margins
    return page.evaluate("document.querySelector('.certificate').offsetHeight")


def test_the_first_printed_page_is_the_certificate(wide):
    page = wide.page
    height = printed_height(page)
    assert page.is_visible('.signatures')
    assert not page.is_visible('.controls')
    text = page.inner_text('.certificate')
    assert 'A. Smith' in text
    assert re.search('[0-9a-f]{64}', text)
    page.emulate_media(media='screen')
    page.set_viewport_size({'width': 1280, 'height': 800})
    assert height < 1016


WIDTHS = """[...document.querySelectorAll('div.plot')].filter((e) => e.checkVisibility())
    .map((e) => e.querySelector('.main-svg')?.getBoundingClientRect().right ?? 0)"""


def printed_widths(page):
    """Return how far the figures of a page reach [px]; the page stays as printed."""
    page.emulate_media(media='print')
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    return page.evaluate(WIDTHS)


def test_printed_figures_are_whole(chromium, result):
    """They were as wide as on the screen, and cut: dots were missing."""
    seen = Seen(chromium, result / 'report.html', 1280)
    seen.drawn()
    page = seen.page
    printed = printed_widths(page)
    assert len(printed) > 5
    assert max(printed) <= 688
    assert not page.is_visible('#space')  # empty on paper, and nothing to pick
    page.emulate_media(media='screen')
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    assert max(page.evaluate(WIDTHS)) > 1000
    seen.end()


def test_a_printed_fleet_is_whole(chromium, tmp_path):
    plant = plants.write_plant(tmp_path, [60 * '7'], 2, poses=12)
    out = tmp_path / 'out'
    given = ['--history', str(tmp_path / 'history'), '--out', str(out), '--workers', '1']
    main(['fleet', str(plant), *given])
    seen = Seen(chromium, out / 'index.html', 1280)
    seen.page.wait_for_function(f'Math.max(...{WIDTHS}) > 700')
    printed = printed_widths(seen.page)
    assert len(printed) == 2
    assert max(printed) <= 688
    assert 'RMS of 777' in seen.page.inner_text('#nights')  # its choice is not printed
    seen.page.close()
    seen = Seen(chromium, out / 'index.html', 400)
    assert seen.overflow <= 0
    state = seen.page.locator('tbody td').nth(1).bounding_box()
    assert state['x'] + state['width'] < 400.0
    seen.page.close()


def test_a_printed_plan_is_no_certificate(chromium, tmp_path):
    """Its first sheet held nothing else, and one heading had no figure."""
    plan = tmp_path / 'plan.csv'
    arguments = ('--poses', '12', '--draw', '60', '--out', str(plan))
    assert main(['plan', '--chain', 'ur5e', *arguments]) == 0
    seen = Seen(chromium, tmp_path / 'plan.report.html', 1280)
    seen.drawn()
    page = seen.page
    assert page.is_visible('text=Where the target will be')
    printed_widths(page)
    assert page.is_visible('text=Then identify')
    for hidden in ('.certificate', 'text=Where the target will be', 'summary', 'footer'):
        assert not page.is_visible(hidden)
    seen.end()


def test_columns_and_maps_are_within_a_telephone(chromium, result):
    seen = Seen(chromium, result / 'report.html', 400)
    used = "document.querySelectorAll('#rows th')[3]"
    assert seen.page.evaluate(f'{used}.textContent') == 'used'
    assert seen.page.evaluate(f'{used}.getBoundingClientRect().right') < 400
    seen.drawn()
    assert seen.page.locator('#map .ytick text').count() > 0
    assert seen.page.locator('#map .y2tick text').count() == 0  # they covered the map beside
    seen.end()


def test_many_refused_poses_on_a_telephone(unsearched, chromium, tmp_path, monkeypatch):
    """They are shown as cells and bands; a long option among the steps is broken."""
    monkeypatch.setattr(explorer, 'SINGLE', 30)
    rows = measured(chain=load_chain('ur5e'), count=40)
    noise = np.random.default_rng(3).normal(0, 1e-3, (40, 3))
    stamps = 1_760_432_012_034_500_000 + rows.stamps_ns
    rows = replace(rows, positions=rows.positions + noise, stamps_ns=stamps)
    problem = Problem(load_chain('ur5e'), rows)
    found = identify(problem)
    assert not found.accepted
    found = replace(found, refusals=(Reason(Rule.EXCITATION, 'wrist_2_joint stood still'),))
    path = tmp_path / 'report.html'
    path.write_text(render(report_of(problem, found)))
    seen = Seen(chromium, path, 400)
    page = seen.page
    seen.drawn()
    assert seen.overflow <= 0
    assert page.evaluate(CONTRAST) == []
    assert 'Not accepted' in page.inner_text('.verdict')
    box = page.locator('text=What to do:').first.bounding_box()
    assert box['y'] < 800.0  # without scrolling
    cells = page.evaluate("document.getElementById('space').data[0].marker.color")
    assert 0 < len(cells) <= 40
    bands = page.evaluate("document.getElementById('session').data.map((t) => t.fill)")
    assert bands.count('tonexty') == 2
    shown = page.inner_text('#rows tbody tr:first-child td:nth-child(1)')
    assert shown in map(moment, stamps.tolist())
    page.locator('#rows tbody button').last.click()
    assert 'Picked' in page.inner_text('#picked')
    assert printed_height(page) < 1016
    seen.end()
