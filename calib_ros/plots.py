# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Figures: each function draws arrays into the Axes that it is given."""

from __future__ import annotations

from io import BytesIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from calib_ros.identification import Identification
from calib_ros.se3 import FloatArray

BEFORE_COLOUR, AFTER_COLOUR = '#d95f02', '#1b9e77'


def draw_errors(axes: Axes, before_mm: FloatArray, after_mm: FloatArray) -> None:
    """Draw the position error of every pose, before and after, with the RMS as a line."""
    for name, errors, colour in (
        ('before', before_mm, BEFORE_COLOUR),
        ('after', after_mm, AFTER_COLOUR),
    ):
        rms = np.sqrt(np.mean(errors**2))
        axes.plot(errors, '.', color=colour, markersize=4, alpha=0.7, rasterized=True)
        axes.axhline(rms, color=colour, label=f'{name}: RMS {rms:.3f} mm, max {errors.max():.3f}')
    axes.set(xlabel='pose', ylabel='position error [mm]', xlim=(0, len(before_mm)))
    axes.set_ylim(bottom=0.0)
    axes.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False)


def draw_distribution(axes: Axes, before_mm: FloatArray, after_mm: FloatArray) -> None:
    """Draw the share of poses with at most a given position error, before and after."""
    for errors, colour in ((before_mm, BEFORE_COLOUR), (after_mm, AFTER_COLOUR)):
        share = 100.0 * np.arange(1, len(errors) + 1) / len(errors)
        axes.plot(np.sort(errors), share, color=colour, drawstyle='steps-post')
    axes.set(xlabel='position error [mm]', ylabel='poses with at most this error [%]')
    axes.set(xlim=(0, None), ylim=(0, 100))
    axes.grid(alpha=0.3)


def before_after_png(result: Identification) -> bytes:
    """Return the figure of position errors before and after, on poses that were not fitted."""
    comparison = result.validation or result.fitted
    before, after = (
        1e3 * np.linalg.norm(residuals.position[comparison.judged], axis=1)
        for residuals in (comparison.before, comparison.after)
    )
    figure = Figure(figsize=(10.0, 3.8), layout='constrained')
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    draw_errors(left, before, after)
    draw_distribution(right, before, after)
    figure.suptitle(f'{result.chain.name}, judged by {result.validated_by}')
    image = BytesIO()
    figure.savefig(image, format='png', dpi=120)
    return image.getvalue()
