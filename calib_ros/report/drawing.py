# SPDX-FileCopyrightText: calib_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""A figure of the report, drawn by matplotlib for paper."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator


def blank_figure(width: float, height: float) -> Figure:
    """Return an empty figure, sizes in inches."""
    figure = Figure(figsize=(width, height), layout='constrained', dpi=120)
    FigureCanvasAgg(figure)
    return figure


def png_of(figure: Figure) -> bytes:
    """Return such a figure as PNG; `savefig` would lay it out twice."""
    image = BytesIO()
    FigureCanvasAgg(figure).print_png(image)  # type: ignore[no-untyped-call]
    return image.getvalue()


def drawing(figure: Mapping[str, Any] | None, height: int, width: int = 810) -> str | None:
    """Return a plotly figure as PNG in base64, sizes in pixels; None for one in space.

    It supports the figures of reports with a PDF: curves, dots with intervals, and heat maps.
    """
    data = [] if figure is None else figure['data']
    if figure is None or any(each['type'] == 'scatter3d' for each in data):
        return None
    layout = figure['layout']
    count = layout.get('grid', {}).get('columns', 1)
    paper = blank_figure(width / 90.0, height / 90.0)
    titles = [each['text'] for each in layout.get('annotations', ())] or ['']
    panels = paper.subplots(1, count, squeeze=False)[0]
    for end, title, axes in zip(('', '2'), titles, panels, strict=False):
        axes.set_title(title)
        for each in data:
            if each.get('xaxis', 'x') == f'x{end}':
                (_draw_colours if each['type'] == 'heatmap' else _draw_curve)(axes, each)
        _draw_axes(axes, layout[f'xaxis{end}'], layout[f'yaxis{end}'])
        for line in layout.get('shapes', ()):
            style = {'color': line['line']['color'], 'linestyle': '--', 'linewidth': 1}
            axes.axvline(line['x0'], **style)
        if any(each['type'] == 'scatter' for each in data):
            axes.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0), ncols=4, frameon=False)
    return base64.b64encode(png_of(paper)).decode()


def _draw_curve(axes: Axes, curve: Mapping[str, Any]) -> None:
    style = {'dash': '--', 'dot': ':', 'solid': '-'}
    look = curve.get('line') or curve['marker']
    line = style[look.get('dash', 'solid')] if 'lines' in curve['mode'] else ''
    mark = {'diamond': 'D'}.get(curve.get('marker', {}).get('symbol', ''), 'o')
    error = curve.get('error_x', {}).get('array')
    marks = {'marker': mark if 'markers' in curve['mode'] else '', 'markersize': 4}
    shown = {'color': look['color'], 'linestyle': line, 'label': curve['name'], **marks}
    shown['drawstyle'] = 'steps-post' if look.get('shape') == 'hv' else 'default'
    axes.errorbar(curve['x'], _plain(curve['y']), xerr=error, **shown)


def _draw_colours(axes: Axes, mesh: Mapping[str, Any]) -> None:
    values = np.array(mesh['z'], dtype=float)
    colours = 'viridis_r' if mesh['colorscale'] == 'Viridis' else 'RdBu'  # plotly's, reversed
    x, y = (
        np.arange(len(each)) if isinstance(each[0], str) else np.array(each)
        for each in (mesh['x'], mesh['y'])
    )
    drawn = axes.pcolormesh(x, y, values, shading='nearest', cmap=colours, rasterized=True)
    drawn.set_clim(mesh.get('zmin'), mesh.get('zmax'))
    if mesh.get('showscale', True):
        bar = mesh['colorbar']
        ticks, label = bar.get('dtick') and MultipleLocator(bar['dtick']), bar['title']['text']
        axes.figure.colorbar(drawn, ax=axes.figure.axes, label=label, ticks=ticks)
    for name, ticks in (('x', mesh['x']), ('y', mesh['y'])):
        if isinstance(ticks[0], str):
            turned = {'rotation': 90} if name == 'x' else {}
            getattr(axes, f'set_{name}ticks')(range(len(ticks)), _plain(ticks), **turned)


def _draw_axes(axes: Axes, x: Mapping[str, Any], y: Mapping[str, Any]) -> None:
    for name, axis in (('x', x), ('y', y)):
        axes.set(**{f'{name}label': axis.get('title', {}).get('text', '')})
        if 'range' in axis:
            axes.set(**{f'{name}lim': axis['range']})
    axes.tick_params(labelleft=y.get('showticklabels', True))
    if y.get('autorange') == 'reversed':
        axes.invert_yaxis()


def _plain(names: Sequence[Any]) -> list[Any]:
    return [
        html.unescape(x.replace('<br>', '\n')).replace('$', r'\$') if isinstance(x, str) else x
        for x in names
    ]
