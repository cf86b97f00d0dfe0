# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Pages of reports: how long they take to make and to open, how large they are; pictures of them.

    python benchmarks/report.py                                          # 500 to 500,000 poses
    CALIB_ROS_DATA=FOLDER python benchmarks/report.py --screenshots docs # make screenshots

Needs Chromium. Opening is timed until the verdict can be read and all that is in view is drawn.
Pictures show a result that is accepted (UR10, session B) and one that is refused (positioner).
"""

import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

import bench
import numpy as np

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / 'test' / 'report')]

from browser import browser

from calib_ros.apply import simulation
from calib_ros.cli.main import main as calib_ros
from calib_ros.estimation.problem import Problem
from calib_ros.files.loading import Loaded
from calib_ros.identification.identification import identify
from calib_ros.kinematics.chain_file import load_chain
from calib_ros.report.content import Origin
from calib_ros.report.page import render
from calib_ros.report.reports import identification_report

SIZES = (500, 20_000, 500_000)
SCREENS = {'': (1280, 800), '_phone': (400, 800)}
FIGURES = {
    'cumulated': 'Share of poses within an error',
    'angles': 'Angles found',
    'gauges': 'What the poses determine',
    'correlations': 'Correlated parameters',
}
"""Sections by their titles, of which pictures stand in docs/."""
UR10 = ('ur10_ipa_leica', '--session', 'B', '--tolerance', '0.5', '--device', 'Leica T-Mac')
RESULTS = {'accepted': UR10, 'refused': ('positioner_2axis_pose',)}


def page_of(count: int) -> tuple[str, float, float]:
    """Return the page of so many poses, and the CPU times [s] of the fit and of the page."""
    rng = np.random.default_rng(0)
    chain = load_chain('ur5e')
    true = simulation.faulty(chain, simulation.Cell(), rng)
    rows = simulation.measure(true, chain.random_joints(count, rng), rng, 5e-5, 2e-4)
    last = np.arange(count) >= 0.9 * count
    problem = Problem(chain, rows.select(~last), rows.select(last))
    start = time.process_time()
    result = identify(problem)
    middle = time.process_time()
    report = identification_report(Loaded(problem, {}), result, Origin())
    text = render(report) or ''
    return text, middle - start, time.process_time() - middle


def opening(page, path: Path) -> float:
    """Return the time [s] until a page is there and what is in view is drawn."""
    start = time.monotonic()
    page.goto(path.as_uri())
    page.evaluate('() => new Promise((done) => requestAnimationFrame(() => setTimeout(done)))')
    return time.monotonic() - start


def sizes() -> None:
    """Print what pages of many poses cost."""
    print('   poses   fit [s CPU]   page [s CPU]   size [MB]   opening [s]')
    with tempfile.TemporaryDirectory() as folder, browser() as started:
        for count in SIZES:
            text, fit, made = page_of(count)
            path = Path(folder) / 'report.html'
            path.write_text(text)
            page = started.new_page()
            opened = min(opening(page, path) for _ in range(3))
            size = len(text.encode()) / 1e6
            print(f'{count:8,} {fit:13.2f} {made:14.2f} {size:11.2f} {opened:13.2f}')
            page.close()


def screenshots(folder: Path, data: Path) -> None:
    """Write pictures of an accepted and of a refused result."""
    with tempfile.TemporaryDirectory() as work, browser() as started:
        for name, (robot, *more) in RESULTS.items():
            out = Path(work) / name
            for file in ('uniform.csv', 'chain.yaml'):
                shutil.copy(data / robot / file, work)
            os.chdir(work)  # the page shows the command
            given = ['uniform.csv', '--chain', 'chain.yaml', '--out', name, *more]
            calib_ros(['identify', *given])
            for ending, (width, height) in SCREENS.items():
                if ending and name == 'accepted':
                    continue  # no page shows it
                page = started.new_page()
                page.set_viewport_size({'width': width, 'height': height})
                page.goto((out / 'report.html').as_uri())
                save(page, folder / f'report_{name}{ending}.jpg')
                if name == 'accepted':
                    page.evaluate(
                        "document.getElementById('space').parentElement.scrollIntoView()"
                    )
                    page.wait_for_selector('#space canvas')
                    page.wait_for_timeout(2000)  # it turns up bit by bit
                    save(page, folder / 'report_space.jpg')
                    for figure, title in FIGURES.items():
                        section = page.locator(
                            'section', has=page.get_by_role('heading', name=title)
                        )
                        section.scroll_into_view_if_needed()
                        page.wait_for_timeout(1000)  # drawn when it comes into view
                        save(section, folder / f'report_{figure}.jpg')
                page.close()


def save(part, path: Path) -> None:
    """Write what is in view of a page, or a part of it."""
    part.screenshot(path=path, type='jpeg', quality=80)
    print(f'wrote {path}: {path.stat().st_size / 1e3:.0f} kB')


def main() -> None:
    """Print the table, or write the pictures."""
    place = {'type': Path, 'metavar': 'FOLDER'}
    folder = bench.options(__doc__, screenshots=(place, 'write pictures there')).screenshots
    if folder is None:
        sizes()
    elif bench.measured(RESULTS):
        screenshots(folder.resolve(), bench.DATA.resolve())


if __name__ == '__main__':
    main()
