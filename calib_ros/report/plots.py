# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Figures by matplotlib."""

from __future__ import annotations

from io import BytesIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from calib_ros.apply.placement import Placements
from calib_ros.apply.workspace import Survey, rms_map
from calib_ros.decision.result import Identification
from calib_ros.kinematics.se3 import FloatArray
from calib_ros.report.drawing import blank_figure, png_of
from calib_ros.report.figures import AFTER, BEFORE
from calib_ros.shown import rounded
from calib_ros.texts import one_line

MARGIN = 0.01  # free margin around a board [m]; a convention


def before_after_png(result: Identification) -> bytes:
    """Return the figure of held-out position errors before and after."""
    comparison = result.comparison
    before, after = (
        1e3 * np.linalg.norm(residuals.position[comparison.deciding], axis=1)
        for residuals in (comparison.before, comparison.after)
    )
    figure = blank_figure(10.0, 3.8)
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    for name, errors, colour in (('before', before, BEFORE), ('after', after, AFTER)):
        rms = np.sqrt(np.mean(errors**2))
        left.plot(errors, '.', color=colour, markersize=4, alpha=0.7, rasterized=True)
        label = f'{name}: RMS {rounded(rms)} mm, max {rounded(errors.max())}'
        left.axhline(rms, color=colour, label=label)
        share = 100.0 * np.arange(1, len(errors) + 1) / len(errors)
        right.plot(np.sort(errors), share, color=colour, drawstyle='steps-post')
    thing = 'measurement' if result.images else 'pose'  # a corner, or one of both
    left.set(xlabel=thing, ylabel='position error [mm]', xlim=(0, len(before)))
    left.set_ylim(bottom=0.0)
    beside = {'ncols': 2, 'fontsize': 'small', 'columnspacing': 1.0}
    left.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0), frameon=False, **beside)
    right.set(xlabel='position error [mm]', ylabel=f'{thing}s with at most this error [%]')
    right.set(xlim=(0, None), ylim=(0, 100))
    right.grid(alpha=0.3)
    judged = 'held-out' if result.validation else 'fitted'
    figure.suptitle(f'{one_line(result.chain.name)}, {judged} {thing}s', parse_math=False)
    return png_of(figure)


def workspace_png(survey: Survey) -> bytes:
    """Return the figure of a survey: removed and, if known, remaining errors."""
    rows = list(survey.parts.items())[:2]
    x, y, z = survey.positions.T
    low, high = np.quantile(z, [0.4, 0.6])
    level = (low <= z) & (z <= high)
    figure = blank_figure(13.0, 4.0 * len(rows))
    grid = figure.subplots(len(rows), 3, squeeze=False)
    for axes, (label, errors) in zip(grid, rows, strict=True):
        axes[0].hist(1e3 * errors, bins=60, color=AFTER, alpha=0.7)
        for share, style in ((0.5, '-'), (0.95, '--')):
            value = 1e3 * float(np.quantile(errors, share))
            name = f'{100.0 * share:.0f} %: {rounded(value)} mm'
            axes[0].axvline(value, color='black', linestyle=style, label=name)
        axes[0].set(xlabel=f'{label} [mm]', yticks=[], xlim=(0.0, None))
        axes[0].locator_params(axis='x', nbins=6)
        axes[0].legend(loc='lower left', bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False)
        axes[1].set_title('all directions')
        axes[2].set_title(f'height {low:.2f} to {high:.2f} m')
        for place, pair, part, labels in (
            (axes[1], (np.hypot(x, y), z), 1e3 * errors, ('radius', 'height')),
            (axes[2], (x[level], y[level]), 1e3 * errors[level], ('x', 'y')),
        ):
            first, second, rms = rms_map(*pair, part)
            mesh = place.pcolormesh(first, second, rms.T, cmap='viridis_r', rasterized=True)
            figure.colorbar(mesh, ax=place, label='RMS [mm]')
            _in_metres(place, *labels)
    return png_of(figure)


def placements_png(placements: Placements) -> bytes:
    """Return the map of a task's placements from above and from two sides."""
    reached = np.flatnonzero(~np.isnan(placements.errors))
    reached = reached[np.argsort(-placements.errors[reached])]  # the least in front
    errors = 1e3 * placements.errors
    figure = blank_figure(15.0, 4.5)
    for axes, pair in zip(figure.subplots(1, 3), ((0, 1), (0, 2), (1, 2)), strict=True):
        x, y = placements.positions[:, pair].T
        colours = {'c': errors[reached], 's': 60, 'cmap': 'viridis_r', 'rasterized': True}
        dots = axes.scatter(x[reached], y[reached], **colours)
        figure.colorbar(dots, ax=axes, label='expected error [mm]')
        for name, k, shape in (('best', placements.best, '*'), ('centre', placements.centre, 'X')):
            label, look = f'{name}: {rounded(errors[k])} mm', {'markersize': 11, 'mec': 'white'}
            axes.plot(x[k], y[k], shape, color='red', label=label, **look)
        _in_metres(axes, 'xyz'[pair[0]], 'xyz'[pair[1]])
        axes.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0), frameon=False)
    return png_of(figure)


def _in_metres(axes: Axes, first: str, second: str) -> None:
    axes.set(xlabel=f'{first} [m]', ylabel=f'{second} [m]', aspect='equal')


def board_pdf(rectangles: FloatArray, size: tuple[float, float], words: str) -> bytes:
    """Return a page with black rectangles (K, 4) [m], to scale: left, top, width, height."""
    from matplotlib.backends.backend_pdf import FigureCanvasPdf
    from matplotlib.collections import PatchCollection
    from matplotlib.patches import Rectangle

    width, height = size[0] + 2.0 * MARGIN, size[1] + 2.0 * MARGIN
    figure = Figure(figsize=(width / 0.0254, height / 0.0254))  # inches
    FigureCanvasPdf(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(-MARGIN, width - MARGIN), ylim=(height - MARGIN, -MARGIN))
    axes.axis('off')
    patches = [Rectangle((x, y), w, h) for x, y, w, h in rectangles.tolist()]
    axes.add_collection(PatchCollection(patches, facecolor='black', edgecolor='none', linewidth=0))
    axes.text(0.0, size[1] + 0.5 * MARGIN, words, fontsize=7, va='center', parse_math=False)
    buffer = BytesIO()
    figure.savefig(buffer, format='pdf', metadata={'CreationDate': None})
    return buffer.getvalue()
